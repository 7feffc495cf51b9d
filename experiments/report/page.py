"""`report.html` and `index.html`: each one file with everything in it, which opens offline, on a phone too."""

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from experiments.report.results import Results
from experiments.report.tables import DASH, Cell, Column, Line, Table

AGAIN = "The seed fixes scenes, instructions and slots: everything in results.json but the seconds comes out the same."
Tone = Literal["good", "bad", "plain"]


@dataclass(frozen=True)
class Card:
    """One headline figure."""

    label: str  # what it is, and the figure as text
    value: str
    detail: str = ""  # a line below it: the interval, the number of scenes
    compare: str = ""  # what to read it against, as `paper .83` or `must be near 0`
    share: float | None = None  # 0..1 for the small bar below the figure; None for no bar
    control: bool = False  # a control row: its bar is drawn in grey, because long is not good there


@dataclass(frozen=True)
class CardSpec:
    """A card that is filled from the rows."""

    label: str  # what the figure is
    line: Line  # whose figure
    column: Column  # which figure
    # what to read it against: words, or what makes them of the results. By default the paper's figure.
    compare: str | Callable[[Results], str] = ""
    bar: bool = True  # whether a share is drawn as a small bar
    each: str = "scenes"  # what was counted

    def fill(self, results: Results) -> Card:
        """The card, with a dash where nothing was measured."""
        line, column = self.line, self.column
        row = results.find(line.key, column.variant, column.metric, column.split)
        cell = Cell.of(row, column.digits, column.percent)
        compare = self.compare if isinstance(self.compare, str) else self.compare(results)
        quoted = line.paper and line.paper.figures.get((column.split, column.variant, column.metric))
        if not compare and quoted is not None:
            compare = f"paper {quoted:.{column.digits}f}"
        if row is None:
            return Card(self.label, DASH, compare=compare)
        detail = ", ".join(part for part in (cell.interval, f"{row.n} {self.each}") if part)
        share = row.value if self.bar and not column.percent and 0 <= row.value <= 1 else None
        return Card(self.label, cell.text, detail, compare, share, line.kind in ("control", "baseline"))


@dataclass(frozen=True)
class Figure:
    """A plot, drawn once for light and once for dark pages."""

    name: str  # file name of the saved PNG
    light: bytes  # PNG files
    dark: bytes
    alt: str  # what a reader who cannot see it needs to know
    caption: str = ""  # a line below it
    wide: bool = False  # of many small panels, which need the width of the page


@dataclass(frozen=True)
class Clip:
    """One animation of panels in a grid."""

    name: str  # file name of the saved GIF
    gif: bytes  # its bytes
    panels: Sequence[str]  # what the columns of equal width show, from left to right
    title: str  # a heading, and a line of details
    caption: str = ""
    badge: str = ""  # a short label; `tone` is its colour
    tone: Tone = "plain"


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
    """A whole report."""

    title: str  # the study
    question: str  # one sentence: what the study asks
    results: Results  # its figures; they give the versions, the seeds and the checkpoint's hash
    cards: Sequence[Card]  # headline figures
    sections: Sequence[Section]  # the rest
    command: str  # what to type to get the same figures again
    again: str = AGAIN  # how far they will be the same

    def to_html(self) -> str:
        """The page, with every image inside it."""
        page = environment().get_template("report.html.j2")
        return page.render(report=self, results=self.results, uri=_data_uri, kind=_kind, seeds=_seed_text)

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


@dataclass(frozen=True)
class Entry:
    """One study on the index page."""

    title: str  # of the study
    question: str  # of the study
    state: str  # a word or two, as `done` or `failed`
    tone: Tone  # colour of the state
    detail: str = ""  # a line below: how long it took, how many figures it has
    figures: Sequence[tuple[str, str]] = ()  # a few headline figures, (name, value as text)
    report: str = ""  # where its page is, relative to the index; empty if there is none
    problem: str = ""  # what went wrong, or empty


def _save(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _kind(block: Table | Figure | Clips) -> str:
    return type(block).__name__.lower()


def _data_uri(data: bytes, mime: str) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"


def _seed_text(seeds: Sequence[int]) -> str:
    """`0–99` for a run of consecutive seeds, else the list; long lists are cut in the middle."""
    values, shown = list(seeds), [str(seed) for seed in seeds]
    if len(values) > 2 and values == list(range(values[0], values[0] + len(values))):
        return f"{values[0]}{DASH}{values[-1]}"
    if len(values) > 12:
        return f"{', '.join(shown[:6])} … {', '.join(shown[-3:])} ({len(values)})"
    return ", ".join(shown)


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
