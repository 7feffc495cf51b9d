"""The page of `textocvp play` in headless Chromium, as a person uses it. Skipped where there is no Chromium."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from textocvp import WorldModel
from textocvp.film_page import film_data, save_page

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright, of the extra [dev]")
pytest.importorskip("fastapi", reason="needs fastapi, of the extra [play]")
pytest.importorskip("uvicorn", reason="needs uvicorn, of the extra [play]")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")

ROOT = Path(__file__).resolve().parents[2]
ASKED, FIRST = "put the red block in the cyan bowl", "put the brown block in the yellow bowl"
OCCUPIED = "?seed=0&family=occupied"  # the brown block lies in the cyan bowl
WAIT = 20_000  # milliseconds, for machines that are busy


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a server in a process of its own, which ends at Ctrl-C without a traceback."""
    with subprocess.Popen(
        [sys.executable, "-m", "experiments.play", "--no-browser", "--port", "0", "--most-pages", "3"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as server:
        assert server.stdout is not None
        found = (re.search(r"http://\S+", line) for line in server.stdout)
        yield next(match[0] for match in found if match)
        server.send_signal(signal.SIGINT)
        _, said = server.communicate(timeout=20)
        assert server.returncode == 0 and "Traceback" not in said


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def visit(browser: Any, address: str) -> Iterator[Callable[..., Any]]:
    """Open the page; at the end it must have asked no other host for anything, and its script had no error."""
    contexts, wrong = [], []

    def visit(query: str = OCCUPIED, **options: Any) -> Any:
        contexts.append(browser.new_context(**options))
        page = contexts[-1].new_page()
        page.set_default_timeout(WAIT)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on(
            "request", lambda one: one.url.startswith((address, "data:", "blob:")) or wrong.append(one.url)
        )
        page.goto(address + query)
        expect(page.locator("#message")).not_to_contain_text("Opening")
        return page

    yield visit
    for context in contexts:
        for page in context.pages:
            if page.url != "about:blank":
                page.evaluate("page && post('close')")
        context.close()
    assert not wrong


def expect(locator: Any) -> Any:
    playwright.expect.set_options(timeout=WAIT)
    return playwright.expect(locator)


def press(page: Any, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def drawn(page: Any, caption: str) -> np.ndarray:
    """The pixels (H, W, 4) of the first canvas of that name."""
    canvas = page.locator(f"canvas[aria-label^='{caption}']").first
    width, values = canvas.evaluate(
        "c => [c.width, [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]]"
    )
    return np.array(values, np.uint8).reshape(-1, width, 4)


def test_type_imagine_do_and_plan(visit) -> None:
    page = visit()
    expect(page.locator("#message")).to_contain_text("Ready")
    assert page.get_by_label("sentence").input_value() == ASKED
    assert page.locator("#possible option").count() == 10
    page.get_by_label("sentence").fill("put the red block in the gray bowl")
    press(page, "another sentence")
    press(page, "imagine")
    expect(page.locator(".film")).to_have_count(2)
    page.get_by_label("moment").fill("24")
    assert (
        drawn(page, "imagined").std() > 20
        and len(np.unique(drawn(page, "slots").reshape(-1, 4), axis=0)) >= 7
    )
    # Pointing at a picture names the thing.
    block = page.get_by_role("button", name="red block").last
    block.hover()
    expect(page.locator("figcaption").nth(3)).to_have_text("slots: red block")
    page.get_by_label("sentence").first.fill("put the pink elephant in the sky")
    press(page, "do it")
    expect(page.locator("#message.bad")).to_contain_text("Cannot read")
    press(page, "plan")
    expect(page.get_by_text("imagined to end on the brown block, not in the cyan bowl")).to_be_visible()
    expect(page.get_by_text("It is imagined to reach the goal.")).to_be_visible()
    press(page, "carry the plan out")
    expect(page.locator("#message")).to_have_text(
        "The goal is seen to be reached after 2. The simulator says so, too."
    )
    assert drawn(page, "what happened").shape == drawn(page, "difference").shape == (64, 64, 4)
    # The address brings the scene back as it is now.
    scene = page.locator("#scene").get_attribute("src")
    assert visit("?" + page.url.split("?")[1]).locator("#scene").get_attribute("src") == scene


def test_pictures_good_and_bad(visit, tmp_path: Path) -> None:
    page = visit()
    message = page.locator("#message")
    good = np.random.default_rng(0).integers(0, 255, (100, 80, 3), np.uint8)
    Image.fromarray(good).save(tmp_path / "good.png")
    data = (tmp_path / "good.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[:2000])
    (tmp_path / "letter.png").write_text("Dear sir or madam")
    (tmp_path / "large.png").write_bytes(bytes(50 * 2**20))
    for name, said in (("cut", "no picture"), ("letter", "no picture"), ("large", "at most 20 MB")):
        page.locator("#file").set_input_files(tmp_path / f"{name}.png")
        expect(page.locator("#message.bad")).to_contain_text(said)
        press(page, "show")
        expect(message).to_contain_text("Done")
    page.locator("#file").set_input_files(tmp_path / "good.png")
    expect(message).to_contain_text("Added a border and brought it from 80x100 to 64x64 pixels")
    expect(message).to_contain_text("Warning: The picture does not look like those")
    assert page.get_by_role("button", name="do it").is_disabled()
    press(page, "imagine")
    expect(page.locator(".film")).to_have_count(1)
    press(page, "back to the scene")
    expect(page.get_by_role("heading", name="The scene")).to_be_visible()


def test_two_tabs_at_once_and_one_too_many(visit) -> None:
    first, second = visit(), visit("?seed=5")
    for page in (first, second):
        expect(page.locator("#message")).to_contain_text("Ready")
        press(page, "imagine")
    for page in (first, second):
        expect(page.locator(".film")).to_have_count(1)
    assert first.locator("#scene").get_attribute("src") != second.locator("#scene").get_attribute("src")
    visit()
    expect(visit().locator("#message.bad")).to_contain_text("--most-pages 3")
    first.goto("about:blank")  # a tab that is left makes room, a moment later
    last = visit("?seed=abc")
    for _ in range(20):
        if "--most-pages" not in last.locator("#message").inner_text():
            break
        last.wait_for_timeout(100)
        last.reload()
        expect(last.locator("#message.bad")).not_to_be_empty()
    expect(last.locator("#message.bad")).to_contain_text("must be a whole number")


def test_the_first_sentence_of_any_scene_can_be_done(visit) -> None:
    page = visit("?seed=3&family=swap")  # its goal are two sentences
    expect(page.locator("#message")).to_contain_text("Ready")
    assert " and " in page.get_by_label("goal", exact=True).input_value()
    for family in ("swap", "picture"):
        page.locator("#family").select_option(family)
        press(page, "show")
        expect(page.locator("#message")).to_contain_text("Done")
        press(page, "do it")
        expect(page.get_by_text("what happened", exact=True)).to_have_count(1)


def test_the_keyboard_is_enough(visit) -> None:
    page = visit()
    at = page.locator("#stage span").first.evaluate("one => parseFloat(one.style.left)")
    page.get_by_role("button", name="yellow bowl").focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#message")).to_contain_text("Done")
    moved = page.locator("#stage span[title='yellow bowl']").evaluate("one => parseFloat(one.style.left)")
    assert moved > 15 and at != moved
    expect(page.get_by_role("button", name="yellow bowl")).to_be_focused()
    # A block leaves the bowl that it lies in when the key is pressed again and again.
    brown = page.locator("#stage span[title='brown block']")
    at = brown.evaluate("one => parseFloat(one.style.left)")
    page.get_by_role("button", name="brown block").focus()
    for _ in range(8):
        page.keyboard.press("ArrowLeft")
        expect(page.locator("#message.busy")).to_have_count(0)
        if brown.evaluate("one => parseFloat(one.style.left)") < at - 5:
            break
    else:
        raise AssertionError("the block is still in the bowl")
    page.get_by_role("button", name="yellow bowl").focus()
    page.keyboard.press("Delete")
    expect(page.get_by_role("button", name="yellow bowl")).to_have_count(0)
    page.get_by_label("sentence").focus()
    page.keyboard.press("Enter")
    expect(page.locator(".film")).to_have_count(1)
    # Everything that can be pressed is reached by Tab.
    wanted = set(
        page.locator("button:visible:enabled").evaluate_all("all => all.map(one => one.textContent)")
    )
    page.locator("h1").click()
    reached = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.textContent"))
    assert wanted <= reached


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_shows_all_of_it(visit, scheme) -> None:
    page = visit(viewport={"width": 375, "height": 700}, color_scheme=scheme, has_touch=True)
    press(page, "imagine")
    expect(page.locator(".film")).to_have_count(1)
    assert page.evaluate("document.documentElement.scrollWidth") <= 375
    light = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (min(light) > 200) == (scheme == "light")


def test_dragging_asks_the_environment(visit) -> None:
    page = visit()
    box = page.locator("#scene").bounding_box()
    spot = page.locator("#stage span[title='red block']")

    def drag(to: str, by: float) -> None:
        target = page.locator(f"#stage span[title='{to}']").bounding_box()
        spot.hover()
        page.mouse.down()
        page.mouse.move(target["x"] + target["width"] / 2 + by, target["y"] + target["height"] / 2, steps=4)
        page.mouse.up()

    before = page.locator("#scene").get_attribute("src")
    drag("white bowl", box["width"] * 0.13)  # half over its rim
    expect(page.locator("#message.bad")).to_contain_text("overlap")
    assert page.locator("#scene").get_attribute("src") == before
    drag("white bowl", 0)
    expect(page.locator("#message")).to_contain_text("Done")
    assert page.locator("#scene").get_attribute("src") != before


def test_a_goal_is_arranged(visit) -> None:
    page = visit("?seed=3&family=plain")
    use = page.get_by_role("button", name="this is the goal")
    expect(use).not_to_be_visible()
    before = page.locator("#scene").get_attribute("src")
    press(page, "arrange the goal")
    expect(use).to_be_visible()
    assert page.get_by_role("button", name="plan", exact=True).is_disabled()
    names = page.locator("#things button").all_inner_texts()
    block, bowl = (next(name for name in names if kind in name) for kind in ("block", "bowl"))
    page.locator(f"#stage span[title='{block}']").drag_to(page.locator(f"#stage span[title='{bowl}']"))
    expect(page.locator("#message")).to_contain_text("Done")
    assert page.locator("#scene").get_attribute("src") != before
    use.click()
    expect(page.locator("#message")).to_contain_text("press plan")
    assert page.locator("#scene").get_attribute("src") == before
    press(page, "plan")
    expect(page.get_by_text(f"the {block} in the {bowl}. It is imagined to reach the goal.")).to_be_visible()


def test_a_page_that_was_sent_opens_offline(browser, tmp_path: Path) -> None:
    world_model = WorldModel.from_pretrained()
    picture = np.full((64, 64, 3), 47, np.uint8)
    picture[20:30, 30:40] = (255, 87, 89)
    with pytest.warns(UserWarning, match="nothing seen is 'cyan'"):
        rollout = world_model.rollout(picture, [ASKED], horizon=3, attention=True)
    path = save_page(tmp_path / "what-if.html", "scene.png", [film_data(rollout, world_model.words(ASKED))])
    context = browser.new_context(offline=True)
    page, wrong = context.new_page(), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(path.as_uri())
    expect(page.get_by_role("heading", name=ASKED)).to_be_visible()
    expect(page.locator(".attention td").nth(5)).not_to_be_empty()
    page.get_by_role("button", name="pause").click()
    assert drawn(page, "imagined")[..., :3].std() > 5 and drawn(page, "slots").any()
    context.close()
    assert not wrong
