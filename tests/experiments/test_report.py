import html.parser
import io
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from experiments.reporting import Cell, Row, StudyProgress, Table, TableRow
from experiments.reporting.clips import BACKGROUND, PALETTE, UNMATCHED, gif, slot_colors
from tests.experiments import examples

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Resources(html.parser.HTMLParser):
    """Every address that a browser would load."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = re.findall(r"url\((.*?)\)", page) + re.findall(r"@import (\S+)", page)
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.found += [
            value or "" for name, value in attrs if name in ("src", "srcset", "href", "data", "poster")
        ]


def test_the_page_opens_offline() -> None:
    page = Resources(examples.report().to_html())
    assert len(page.found) >= 5  # two plots in light and dark, one clip
    assert [address[:40] for address in page.found if not address.startswith("data:image/")] == []
    assert not {"script", "link", "iframe"} & set(page.tags)


def test_the_page_says_what_it_is() -> None:
    page = examples.report(quick=True).to_html()
    assert "Quick run" in page
    assert "Quick run" not in examples.report(quick=False).to_html()
    for text in (
        "ab" * 32,
        "torch 2.3",
        "50\u201369",
        "python experiments/controllability.py --seed 0",
        "0.80\u20130.95",
    ):
        assert text in page
    assert "put &lt;b&gt;it&lt;/b&gt; there" in page
    assert "put <b>it</b> there" not in page


def test_all_files_are_written(tmp_path: Path) -> None:
    examples.report().write(tmp_path)
    written = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.*"))
    assert written == ["clips/a.gif", "plots/h.png", "plots/p.png", "report.html", "results.json"]
    assert Image.open(tmp_path / "plots" / "p.png").size[0] > 600


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
@pytest.mark.parametrize("width", [500, 1200])
def test_a_browser_shows_it(tmp_path: Path, width: int) -> None:
    """Every picture loads, and the page is not wider than the window (500 is the narrowest that Chromium opens)."""
    probe = (
        "<script>addEventListener('load', () => { document.body.dataset.probe = ["
        "document.documentElement.scrollWidth - innerWidth, document.images.length,"
        "[...document.images].filter(i => !i.naturalWidth).length].join(' '); });</script>"
    )
    page = tmp_path / "report.html"
    page.write_text(examples.report().to_html().replace("</body>", probe + "</body>"), encoding="utf-8")
    assert CHROMIUM is not None
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
    flags += [
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--hide-scrollbars",
    ]
    command = [
        CHROMIUM,
        *flags,
        f"--user-data-dir={tmp_path / 'profile'}",
        f"--window-size={width},900",
        "--dump-dom",
    ]
    shown = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, timeout=120)
    found = re.search(r'data-probe="(-?\d+) (\d+) (\d+)"', shown.stdout)
    assert found, shown.stderr[-500:]
    too_wide, images, broken = map(int, found.groups())
    assert too_wide <= 0
    assert (images, broken) == (3, 0)


def test_a_table_needs_a_cell_a_column() -> None:
    with pytest.raises(ValueError, match="1 cells, the table 2 columns"):
        Table("t", ["a", "b"], [TableRow("ours", [Cell("1")])])


def test_the_terminal_shows_figures_and_intervals() -> None:
    table = Table("Success", ["original"], [TableRow("ours", [Cell.of(examples.row())])])
    console = Console(file=io.StringIO(), width=100)
    console.print(table.to_rich())
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
    console.print(alike.to_rich(), mixed.to_rich())
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "0.40\u20130.60, n = 20" in shown and shown.count("n = 60") == 2


def test_progress_in_a_file_is_plain_lines() -> None:
    console = Console(file=io.StringIO())
    with StudyProgress({"one": (5, 1.0), "two": (2, 3.0)}, console) as progress:
        assert list(progress.track("one", iter(range(5)))) == [0, 1, 2, 3, 4]
        progress.expect("two", 1)
        list(progress.track("two", ["unit"]))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert lines[-1].startswith("two: 1/1") and "about 0 s left" in lines[-1]
    assert not any("\x1b" in line for line in lines)


def test_a_clip_plays_at_the_length_of_its_longest_panel() -> None:
    short = np.zeros((2, 8, 8, 3), np.uint8)
    long = np.stack([np.full((8, 8, 3), 40 * t, np.uint8) for t in range(6)])
    film = Image.open(io.BytesIO(gif([[short, long]], scale=2, gap=2)))
    assert film.size == (2 * (8 + 2 + 8), 2 * 8)
    assert film.n_frames == 6
    film.seek(5)
    assert film.convert("RGB").getpixel((30, 4)) == (200, 200, 200)


def test_a_clip_needs_panels_that_fit() -> None:
    with pytest.raises(ValueError, match="at least one"):
        gif([[]])
    with pytest.raises(ValueError, match="differ in size"):
        gif([[np.zeros((2, 8, 8, 3), np.uint8), np.zeros((2, 9, 8, 3), np.uint8)]])


def test_slots_take_the_colour_of_what_they_cover() -> None:
    segmentation = np.zeros((8, 8), int)
    segmentation[:4, :4] = 2
    segmentation[4:, 4:] = 3
    slots = np.where(segmentation == 2, 5, np.where(segmentation == 3, 1, 0))
    slots[0, 7] = 4  # a slot in the background
    colors = slot_colors(slots, segmentation, slots=7, objects=2)
    assert (colors[5] == PALETTE[0]).all() and (colors[1] == PALETTE[1]).all()
    assert (colors[0] == BACKGROUND).all()
    assert (colors[6] == UNMATCHED).all()  # covers nothing
