import html.parser
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from experiments.report.page import CardSpec
from experiments.report.tables import Column, Line, Paper
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
        self.found += [value or "" for name, value in attrs if name in ("src", "srcset", "href", "data", "poster")]


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
    flags += ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars"]
    command = [CHROMIUM, *flags, f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900", "--dump-dom"]
    shown = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, timeout=120)
    found = re.search(r'data-probe="(-?\d+) (\d+) (\d+)"', shown.stdout)
    assert found, shown.stderr[-500:]
    too_wide, images, broken = map(int, found.groups())
    assert too_wide <= 0
    assert (images, broken) == (3, 0)


def test_a_card_is_filled_from_a_row() -> None:
    line = Line(key="ours", paper=Paper("paper", {("controllability", "original", "predicted_success"): 0.83}))
    column = Column("", "controllability", "original", "predicted_success")
    card = CardSpec("Predicted", line, column).fill(examples.results())
    assert (card.value, card.detail, card.compare) == ("0.90", "0.80\u20130.95, 20 scenes", "paper 0.83")
    assert card.share == 0.9 and not card.control
    absent = CardSpec("Predicted", replace(line, key="MAGE", kind="control"), column, "must be near 0")
    assert absent.fill(examples.results()).value == "\u2013"
