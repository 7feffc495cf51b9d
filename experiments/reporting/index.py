"""`index.html`: one page that links every report of a folder of results. It opens offline and on a phone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from experiments.reporting.document import environment
from experiments.reporting.results import Checkpoint


@dataclass(frozen=True)
class Entry:
    """One study on the page.

    Attributes:
        title, question: of the study.
        state: a word or two, as `done` or `failed`; `tone` is its colour.
        detail: a line below: how long it took, how many figures it has.
        figures: a few headline figures, (name, value as text).
        report: where its page is, relative to the index; empty if there is none.
        problem: what went wrong, or empty.
    """

    title: str
    question: str
    state: str
    tone: Literal["good", "bad", "plain"]
    detail: str = ""
    figures: Sequence[tuple[str, str]] = ()
    report: str = ""
    problem: str = ""


@dataclass(frozen=True)
class Index:
    """The page.

    Attributes:
        title, text: its heading, and a sentence below.
        entries: the studies, in order.
        checkpoint: that they measured.
        command: what to type to get them again.
        quick: whether these were quick runs.
    """

    title: str
    text: str
    entries: Sequence[Entry]
    checkpoint: Checkpoint
    command: str
    quick: bool

    def to_html(self) -> str:
        """The page; only the links to the reports lead out of it."""
        return environment().get_template("index.html.j2").render(index=self)
