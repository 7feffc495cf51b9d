"""A table of figures, drawn the same way in the terminal, in HTML and in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from rich import box
from rich.table import Table as RichTable

from experiments.reporting.results import Row

DASH = "\u2013"
Kind = Literal["ours", "control", "ceiling", "paper"]

_STYLES: dict[Kind, str] = {"ours": "bold", "control": "dim", "ceiling": "", "paper": "italic cyan"}


@dataclass(frozen=True)
class Cell:
    """One figure.

    Attributes:
        text: the figure.
        interval: of 95 %, empty when there is none.
        n: how many scenes it is from; None where nothing was measured.
    """

    text: str
    interval: str = ""
    n: int | None = None

    def below(self, with_n: bool) -> str:
        """What stands below the figure: its interval, and on demand its n."""
        return ", ".join(
            part for part in (self.interval, f"n = {self.n}" if with_n and self.n else "") if part
        )

    @classmethod
    def of(cls, row: Row | None, digits: int = 2) -> Cell:
        """The cell of a row; a dash while there is none yet."""
        if row is None:
            return cls(DASH)
        between = " to " if row.low < 0 else DASH  # a dash beside a minus sign cannot be read
        interval = f"{row.low:.{digits}f}{between}{row.high:.{digits}f}"
        # A single scene has no interval.
        return cls(f"{row.value:.{digits}f}", "" if row.n < 2 else interval, row.n)


@dataclass(frozen=True)
class TableRow:
    """One line: its label, its cells, and its part in the argument.

    Attributes:
        kind: `ours`, a `control` that must be low, a `ceiling` above all, or the `paper`'s own figures.
        note: one sentence that says how the line was measured.
    """

    label: str
    cells: Sequence[Cell]
    kind: Kind = "ours"
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Title, columns and rows. Every row has one cell a column."""

    title: str
    columns: Sequence[str]
    rows: Sequence[TableRow] = field(default_factory=list)
    caption: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.cells) != len(self.columns):
                raise ValueError(
                    f"row {row.label!r} has {len(row.cells)} cells, the table {len(self.columns)} columns"
                )

    @property
    def counts(self) -> tuple[int, ...]:
        """Every n of its figures, sorted. With one only, the caption says it; otherwise each figure does."""
        return tuple(sorted({cell.n for row in self.rows for cell in row.cells if cell.n}))

    @property
    def full_caption(self) -> str:
        """The caption, with the n of all figures where that is the same."""
        n = f"n = {self.counts[0]}." if len(self.counts) == 1 else ""
        return " ".join(part for part in (self.caption, n) if part)

    def to_rich(self, intervals: bool = True) -> RichTable:
        """For the terminal."""
        table = RichTable(title=self.title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
        table.caption, table.caption_justify, table.caption_style = self.full_caption or None, "left", "dim"
        table.add_column("")
        for column in self.columns:
            table.add_column(column, justify="right", no_wrap=len(column) < 9)
        for row in self.rows:
            below = [cell.below(len(self.counts) > 1) if intervals else "" for cell in row.cells]
            cells = [
                f"{cell.text}\n[dim not bold not italic]{small}[/]" if small else cell.text
                for cell, small in zip(row.cells, below, strict=True)
            ]
            table.add_row(row.label, *cells, style=_STYLES[row.kind])
        return table
