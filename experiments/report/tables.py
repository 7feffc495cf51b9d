"""Tables of figures. One `TableSpec` gives the table in the terminal, in HTML and in Markdown, and its plot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rich import box
from rich.table import Table as RichTable

from experiments.report.rows import Row, by_key

DASH = "\u2013"
Kind = Literal["ours", "baseline", "control", "ceiling", "paper"]
_STYLES: dict[Kind, str] = {
    "ours": "bold", "baseline": "", "control": "dim", "ceiling": "", "paper": "italic cyan",
}  # fmt: skip
LABEL = 24  # letters of a line's label in the terminal, before it is wrapped
TERMINAL = 80  # columns of a terminal that does not say how wide it is


@dataclass(frozen=True)
class Cell:
    """One figure."""

    text: str  # the figure
    interval: str = ""  # of 95 %, empty when there is none
    n: int | None = None  # how many scenes it is from; None where nothing was measured

    @classmethod
    def of(cls, row: Row | None, digits: int | None = 2, percent: bool = False) -> Cell:
        """The cell of a row, with three digits in all without `digits`; a dash while there is none yet."""
        if row is None:
            return cls(DASH)
        if percent:
            low, high = (round(100 * end) + 0 for end in (row.low, row.high))
            value, interval = as_percent(row.value), f"{low} to {high} %"
        else:
            between = " to " if row.low < 0 else DASH  # a dash beside a minus sign cannot be read
            value, first, last = (
                f"{end:.{2 - (end >= 10) - (end >= 100) if digits is None else digits}f}"
                for end in (row.value, row.low, row.high)
            )
            interval = f"{first}{between}{last}"
        # A single scene has no interval.
        return cls(value, "" if row.n < 2 else interval, row.n)

    def small(self, with_n: bool) -> tuple[str, ...]:
        """The small lines below the figure: its interval, and on demand its n."""
        n = f"n = {self.n}" if with_n and self.n else ""
        return tuple(part for part in (self.interval, n) if part)


def as_percent(share: float) -> str:
    """`6.4 %` for 0.064."""
    return f"{round(100 * share, 1) + 0.0:.1f} %"  # + 0 turns a negative zero round


@dataclass(frozen=True)
class TableRow:
    """One line of a table: its label, its cells, its part in the argument, and how it was measured."""

    label: str
    cells: Sequence[Cell]
    kind: Kind = "ours"
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Title, columns and rows. Every row has one cell a column.

    Raises:
        ValueError: if a row has more or fewer.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[TableRow] = field(default_factory=list)
    caption: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.cells) != len(self.columns):
                raise ValueError(f"row {row.label!r} has {len(row.cells)} cells, the table {len(self.columns)} columns")

    @property
    def counts(self) -> tuple[int, ...]:
        """Every n of its figures, sorted. With one only, the caption says it; otherwise each figure does."""
        return tuple(sorted({cell.n for row in self.rows for cell in row.cells if cell.n}))

    @property
    def full_caption(self) -> str:
        """The caption, with the n of all figures where that is the same."""
        n = f"n = {self.counts[0]}." if len(self.counts) == 1 else ""
        return " ".join(part for part in (self.caption, n) if part)

    def measured(self, columns: Sequence[int] | None = None) -> tuple[list[int], list[int]]:
        """Columns (of the given ones) with a figure that is not the paper's, and rows with any figure in them."""

        def there(r: int, c: int) -> bool:
            return self.rows[r].cells[c].text not in (DASH, "")

        rows = range(len(self.rows))
        columns = range(len(self.columns)) if columns is None else columns
        used = [c for c in columns if any(there(r, c) and self.rows[r].kind != "paper" for r in rows)]
        return used, [r for r in rows if any(there(r, c) for c in used)]

    def to_terminal(self, width: int = TERMINAL, intervals: bool = True) -> list[RichTable]:
        """For a terminal that is `width` letters wide, `intervals` below the figures.

        Columns for which a line is too narrow follow below, so that no figure is cut off.
        """
        used = self.measured()[0] or list(range(len(self.columns)))
        label = min(LABEL, max((len(row.label) for row in self.rows), default=1))
        # A column is followed by two letters, and the table has one at each side.
        room = width - (label + 2) - 2
        shown = {c: self._column(c, intervals) for c in used}
        blocks: list[list[int]] = [[]]
        for c in used:
            if blocks[-1] and sum(shown[k][1] + 2 for k in [*blocks[-1], c]) > room:
                blocks.append([])
            blocks[-1].append(c)
        tables = []
        for some in blocks:
            table = RichTable(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), title_justify="left", title_style="bold")
            table.title = self.title if some is blocks[0] else None
            table.caption, table.caption_justify, table.caption_style = None, "left", "dim"
            if some is blocks[-1] and self.full_caption:
                table.caption = self.full_caption
            whole = {c: max(shown[c][1], len(self.columns[c])) for c in some}
            roomy = sum(wanted + 2 for wanted in whole.values()) <= room
            table.add_column("", width=label)
            for c in some:
                table.add_column(shown[c][0], justify="right", width=whole[c] if roomy else shown[c][1])
            for r in self.measured(some)[1] or range(len(self.rows)):
                row = self.rows[r]
                table.add_row(row.label, *(shown[c][2][r] for c in some), style=_STYLES[row.kind])
            tables.append(table)
        return tables

    def _column(self, c: int, intervals: bool) -> tuple[str, int, list[str]]:
        """Heading of a column, the letters that it needs, and its cells; titles may be wrapped between words."""
        counts = {n for row in self.rows if (n := row.cells[c].n)}
        alike = len(counts) == 1
        small = [row.cells[c].small(len(self.counts) > 1 and not alike) if intervals else () for row in self.rows]
        heading = self.columns[c]
        letters = [*heading.split(), *(row.cells[c].text for row in self.rows)]
        letters += [text for texts in small for text in texts]
        if intervals and alike and len(self.counts) > 1:
            heading += f"\nn = {min(counts)}"
            letters.append(f"n = {min(counts)}")
        cells = [
            "\n".join([row.cells[c].text, *(f"[dim not bold not italic]{text}[/]" for text in texts)])
            for row, texts in zip(self.rows, small, strict=True)
        ]
        return heading, max(map(len, letters)), cells

    def to_markdown(self) -> str:
        """For a page of text: lines and columns in which anything was measured."""
        used, measured = self.measured()
        with_n = len(self.counts) > 1
        title = self.title if with_n or not self.counts else f"{self.title}, n = {self.counts[0]}"
        lines = [f"| {' | '.join([title, *(self.columns[c] for c in used)])} |"]
        lines.append("|---" * (len(used) + 1) + "|")
        for row in (self.rows[r] for r in measured):
            cells = []
            for c in used:
                small = ", ".join(row.cells[c].small(with_n)).replace(DASH, " to ")
                cells.append(row.cells[c].text + (f" ({small})" if small else ""))
            label = row.label.replace("|", "/")  # a bar would end the cell
            lines.append(f"| {' | '.join([label, *cells])} |")
        return "\n".join(lines)


@dataclass(frozen=True)
class Paper:
    """A line that the paper has."""

    label: str  # of the line
    figures: Mapping[tuple[str, str, str], float]  # (split, variant, metric) -> the paper's figure
    note: str = "CLIPort at 336x336, another camera"  # where it was measured


def quoted(split: str, variants: Iterable[str], **figures: Sequence[float]) -> dict[tuple[str, str, str], float]:
    """Figures of a split as `Paper` takes them: metric -> its figures, for the variants or the first of them."""
    pairs = {metric: zip(variants, values, strict=False) for metric, values in figures.items()}
    return {(split, variant, metric): value for metric, its in pairs.items() for variant, value in its}


@dataclass(frozen=True, kw_only=True)
class Line:
    """What a line of a table shows."""

    key: str  # `method` of the rows that it shows
    kind: Kind = "ours"  # `ours`, a `baseline`, a `control` that must be low, a `ceiling`, or the `paper`'s own figures
    note: str = ""  # how it was measured, in a few words
    hue: int = 0  # colour in every plot, an index into the themes' series
    label: str = ""  # its name; the key if empty
    metric: str = ""  # shows this metric instead of the columns' own
    digits: int | None = None  # with so many digits instead of the columns' own
    paper: Paper | None = None  # the paper's figures of the same, for a line below it

    @property
    def name(self) -> str:
        """How it is called in tables and plots."""
        return self.label or self.key


@dataclass(frozen=True)
class Column:
    """What a column of a table shows: rows of one split, variant and metric."""

    title: str  # at its head
    split: str  # see `Row`
    variant: str  # see `Row`
    metric: str  # see `Row`
    digits: int | None = 2  # after the point; None for three in all
    percent: bool = False  # shown as `6.4 %`
    paper: str = ""  # metric of the paper's figures, where that is another

    @property
    def scale(self) -> int:
        """What a figure is multiplied by in a plot."""
        return 100 if self.percent else 1


def columns(metric: str, places: Mapping[str, tuple[str, str]], digits: int = 2) -> tuple[Column, ...]:
    """A column for each place, all of one metric. Places: title -> (split, variant)."""
    return tuple(Column(title, *place, metric, digits) for title, place in places.items())


@dataclass(frozen=True)
class TableSpec:
    """A table that is filled from rows."""

    title: str  # of the table
    columns: Sequence[Column]  # from left to right
    lines: Sequence[Line]  # from top to bottom
    caption: str = ""  # a sentence below

    def table(self, rows: Iterable[Row], missing: Iterable[str] = ()) -> Table:
        """The table, with a dash for what was not measured (yet); lines of `missing` methods say so."""
        found, missing = by_key(rows), set(missing)
        lines = []
        for line in self.lines:
            note = "absent; the last section says why" if line.key in missing else line.note
            cells = [
                Cell.of(found.get(_key(line, c)), c.digits if line.digits is None else line.digits, c.percent)
                for c in self.columns
            ]
            lines.append(TableRow(line.name, cells, line.kind, note))
            quoted = [self._quoted(line, column) for column in self.columns]
            if line.paper is not None and any(value is not None for value in quoted):
                cells = [
                    Cell(DASH if v is None else as_percent(v) if c.percent else f"{v:.{c.digits}f}")
                    for v, c in zip(quoted, self.columns, strict=True)
                ]
                lines.append(TableRow(line.paper.label, cells, "paper", line.paper.note))
        return Table(self.title, [column.title for column in self.columns], lines, self.caption)

    def points(self, rows: Iterable[Row], line: Line) -> list[tuple[float, float, float] | None]:
        """(value, low, high) of a line at each column, in percent where the column is; None without a row."""
        found = by_key(rows)
        return [
            (c.scale * row.value, c.scale * row.low, c.scale * row.high) if (row := found.get(_key(line, c))) else None
            for c in self.columns
        ]

    def paper_points(self, line: Line) -> list[tuple[float, float, float] | None]:
        """The same for the paper's figures, which have no interval."""
        return [
            None if (v := self._quoted(line, c)) is None else (c.scale * v,) * 3  # type: ignore[misc]
            for c in self.columns
        ]

    @staticmethod
    def _quoted(line: Line, column: Column) -> float | None:
        """The paper's figure, where it has one."""
        metric = column.paper or line.metric or column.metric
        return line.paper.figures.get((column.split, column.variant, metric)) if line.paper else None


def _key(line: Line, column: Column) -> tuple[str, str, str, str]:
    return line.key, column.split, column.variant, line.metric or column.metric
