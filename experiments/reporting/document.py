"""`report.html`: one file with everything in it, which opens offline on a phone and on a desktop."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from experiments.reporting.results import Results
from experiments.reporting.table import DASH, Table


@dataclass(frozen=True)
class Card:
    """One headline figure.

    Attributes:
        label, value: what it is, and the figure as text.
        detail: a line below it: the interval, the number of scenes.
        compare: what to read it against, as `paper .83` or `must be near 0`.
        share: 0..1 for the small bar below the figure; None for no bar.
        control: a control row: its bar is drawn in grey, because long is not good there.
    """

    label: str
    value: str
    detail: str = ""
    compare: str = ""
    share: float | None = None
    control: bool = False


@dataclass(frozen=True)
class Figure:
    """A plot, drawn once for light and once for dark pages.

    Attributes:
        name: file name of the saved PNG.
        light, dark: PNG files.
        alt: what a reader who cannot see it needs to know. caption: a line below it.
        wide: of many small panels, which need the width of the page.
    """

    name: str
    light: bytes
    dark: bytes
    alt: str
    caption: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Clip:
    """One animation of panels in a grid.

    Attributes:
        name: file name of the saved GIF.
        gif: its bytes.
        panels: what the columns of equal width show, from left to right.
        title, caption: a heading, and a line of details.
        badge: a short label; `tone` is its colour.
    """

    name: str
    gif: bytes
    panels: Sequence[str]
    title: str
    caption: str = ""
    badge: str = ""
    tone: Literal["good", "bad", "plain"] = "plain"


@dataclass(frozen=True)
class Clips:
    """Animations in a grid."""

    clips: Sequence[Clip]


@dataclass(frozen=True)
class Section:
    """A heading, a few plain sentences, and tables, figures and clips in order."""

    title: str
    text: str = ""
    blocks: Sequence[Table | Figure | Clips] = field(default_factory=list)


@dataclass(frozen=True)
class Report:
    """A whole report.

    Attributes:
        title: the study.
        question: one sentence: what the study asks.
        results: its figures; they give the versions, the seeds and the checkpoint's hash.
        cards: headline figures.
        sections: the rest.
        command: what to type to get the same figures again.
        again: how far they will be the same.
    """

    title: str
    question: str
    results: Results
    cards: Sequence[Card]
    sections: Sequence[Section]
    command: str
    again: str = (
        "The seed fixes scenes, instructions and slots: "
        "everything in results.json but the seconds comes out the same."
    )

    def to_html(self) -> str:
        """The page, with every image inside it."""
        return (
            environment()
            .get_template("report.html.j2")
            .render(report=self, results=self.results, uri=_data_uri, kind=_kind, seeds=_seed_text)
        )

    def write(self, folder: Path) -> None:
        """Write `results.json`, `report.html`, the plots as PNG and the clips as GIF into a folder."""
        (folder / "results.json").write_text(self.results.to_json(), encoding="utf-8")
        (folder / "report.html").write_text(self.to_html(), encoding="utf-8")
        for section in self.sections:
            for block in section.blocks:
                if isinstance(block, Figure):
                    _save(folder / "plots" / block.name, block.light)
                elif isinstance(block, Clips):
                    for clip in block.clips:
                        _save(folder / "clips" / clip.name, clip.gif)


def _save(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _kind(block: Table | Figure | Clips) -> str:
    return type(block).__name__.lower()


def _data_uri(data: bytes, mime: str) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


def _seed_text(seeds: Sequence[int]) -> str:
    """`0–99` for a run of consecutive seeds, else the list; long lists are cut in the middle."""
    values = list(seeds)
    if len(values) > 2 and values == list(range(values[0], values[0] + len(values))):
        return f"{values[0]}{DASH}{values[-1]}"
    if len(values) > 12:
        return (
            ", ".join(map(str, values[:6])) + " … " + ", ".join(map(str, values[-3:])) + f" ({len(values)})"
        )
    return ", ".join(map(str, values))


@cache
def environment() -> Environment:
    """Where the templates of the pages are found; everything that is put into them is escaped."""
    return Environment(
        loader=PackageLoader("experiments.report", "templates"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
