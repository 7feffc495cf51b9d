"""Tables: filled from rows by a spec, and shown in a terminal, in Markdown and as a plot."""

import io

import pytest
from rich.console import Console

from experiments import (
    ablations,
    controllability,
    interpretability,
    long_horizon,
    objects,
    prediction,
    robustness,
    runtime,
)
from experiments.report.plots import plot_table
from experiments.report.rows import Row
from experiments.report.tables import DASH, Cell, Column, Line, Paper, Table, TableRow, TableSpec, columns
from tests.experiments import examples

SPEC = TableSpec(
    "SSIM",
    [
        *columns("ssim", {"9 frames": ("test", "9 frames"), "19 frames": ("test", "19 frames")}, digits=3),
        Column("drop", "unseen_colors", "9 frames", "ssim_drop", percent=True),
        Column("24 frames", "test", "24 frames", "ssim", 3),
    ],
    [
        Line(key="ours", note="imagined", paper=Paper("paper, TextOCVP", {("test", "9 frames", "ssim"): 0.95})),
        Line(key="MAGE", kind="baseline", hue=3),
        Line(key="OCVP-Seq", kind="baseline"),
    ],
)
ROWS = [
    Row("ours", "test", "9 frames", "ssim", 0.9512, 0.94, 0.96, 60),
    Row("MAGE", "test", "9 frames", "ssim", 0.9, 0.9, 0.9, 60),
    Row("ours", "test", "19 frames", "ssim", 0.93, 0.92, 0.94, 55),
    Row("ours", "unseen_colors", "9 frames", "ssim_drop", -0.064, -0.1, 0.02, 60),
]


def shown(table: Table, width: int) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(*table.to_terminal(width))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_table_needs_a_cell_a_column() -> None:
    with pytest.raises(ValueError, match="1 cells, the table 2 columns"):
        Table("t", ["a", "b"], [TableRow("ours", [Cell("1")])])


def test_the_terminal_shows_figures_and_intervals() -> None:
    table = Table("Success", ["original"], [TableRow("ours", [Cell.of(examples.row())])])
    console = Console(file=io.StringIO(), width=100)
    console.print(*table.to_terminal(100))
    assert "0.90" in console.file.getvalue() and "0.80\u20130.95" in console.file.getvalue()  # type: ignore[attr-defined]
    assert Cell.of(None).text == "\u2013"
    assert Cell.of(Row("a", "b", "c", "d", 0.5, 0.5, 0.5, 1)).interval == ""  # one scene
    assert Cell.of(Row("a", "b", "c", "d", 0.5, 0.5, 0.5, 2)).interval == "0.50\u20130.50"
    assert Cell.of(Row("a", "b", "c", "d", -0.5, -0.6, -0.4, 9)).interval == "-0.60 to -0.40"


def test_every_figure_says_how_many_scenes_it_is_from() -> None:
    rows = [Row("ours", "test", name, "d", 0.5, 0.4, 0.6, n) for name, n in (("a", 60), ("b", 20))]
    alike = Table("t", ["a"], [TableRow("ours", [Cell.of(rows[0])]), TableRow("paper", [Cell("0.8")])])
    assert alike.full_caption == "n = 60."
    mixed = Table("t", ["a", "b"], [TableRow("ours", [Cell.of(row) for row in rows])], "Of the test split.")
    assert mixed.full_caption == "Of the test split."
    console = Console(file=io.StringIO(), width=120)
    console.print(*alike.to_terminal(120), *mixed.to_terminal(120))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "n = 20" in shown and shown.count("n = 60") == 2


def test_a_spec_is_filled_from_rows_and_the_paper_stands_below_its_line() -> None:
    table = SPEC.table(ROWS, missing=["MAGE"])
    assert [row.label for row in table.rows] == ["ours", "paper, TextOCVP", "MAGE", "OCVP-Seq"]
    assert [cell.text for cell in table.rows[0].cells] == ["0.951", "0.930", "-6.4 %", DASH]
    assert table.rows[0].cells[2].interval == "-10 to 2 %"
    assert [cell.text for cell in table.rows[1].cells] == ["0.950", DASH, DASH, DASH]
    assert table.rows[1].kind == "paper" and table.rows[0].note == "imagined"
    assert "absent" in table.rows[2].note


def test_a_line_may_show_another_metric() -> None:
    spec = TableSpec("", columns("", {"test": ("test", "9 frames")}), [Line(key="ours", metric="ssim", digits=1)])
    assert spec.table(ROWS).rows[0].cells[0].text == "1.0"


def test_markdown_leaves_out_what_has_no_figure() -> None:
    assert SPEC.table(ROWS).to_markdown().splitlines() == [
        "| SSIM | 9 frames | 19 frames | drop |",
        "|---|---|---|---|",
        "| ours | 0.951 (0.940 to 0.960, n = 60) | 0.930 (0.920 to 0.940, n = 55) | -6.4 % (-10 to 2 %, n = 60) |",
        f"| paper, TextOCVP | 0.950 | {DASH} | {DASH} |",
        f"| MAGE | 0.900 (0.900 to 0.900, n = 60) | {DASH} | {DASH} |",
    ]
    one = TableSpec("SSIM", SPEC.columns[:1], SPEC.lines).table(ROWS).to_markdown()
    assert one.splitlines()[0] == "| SSIM, n = 60 | 9 frames |"


def test_the_plot_has_the_paper_as_rings_and_nobody_who_was_not_measured() -> None:
    plot = plot_table("p.png", SPEC, ROWS, label="SSIM", limits=None)
    assert "ours: 9 frames 0.95, 19 frames 0.93, drop -6.40" in plot.alt and "paper, TextOCVP: " in plot.alt
    assert "OCVP-Seq" not in plot.alt and "Rings are the paper's" in plot.caption
    assert plot.light[:8] == plot.dark[:8] == b"\x89PNG\r\n\x1a\n"


def every_row(spec: TableSpec) -> list[Row]:
    """Figures as wide as they come, of different numbers of scenes."""
    return [
        Row(line.key, c.split, c.variant, line.metric or c.metric, -0.123456, -0.98765, 0.98765, 100 + i)
        for i, line in enumerate(spec.lines)
        for c in spec.columns
    ]


STUDIES = (ablations, controllability, interpretability, long_horizon, objects, prediction, robustness, runtime)


@pytest.mark.parametrize("spec", [spec for study in STUDIES for spec in study.STUDY.tables], ids=lambda s: s.title)
@pytest.mark.parametrize("width", [80, 120])
def test_no_figure_is_cut_off(spec: TableSpec, width: int) -> None:
    table = spec.table(every_row(spec))
    text = shown(table, width)
    assert "\u2026" not in text and max(map(len, text.splitlines())) <= width
    figures = [cell.text for row in table.rows for cell in row.cells]
    intervals = [cell.interval for row in table.rows for cell in row.cells if cell.interval]
    for figure in set(figures) - {DASH}:
        assert text.count(figure) >= figures.count(figure)
    for interval in set(intervals):
        assert text.count(interval) == intervals.count(interval)
