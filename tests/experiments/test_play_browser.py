"""The page of `textocvp play` in headless Chromium, as a person uses it. Skipped where there is no Chromium."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
WAIT = 60_000  # milliseconds, for machines that have other work, too


@contextmanager
def served(*arguments: str) -> Iterator[str]:
    """The address of a server in a process of its own, which ends at Ctrl-C without a traceback."""
    with subprocess.Popen(
        [sys.executable, "-m", "experiments.play", "--no-browser", "--port", "0", *arguments],
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
def address() -> Iterator[str]:
    with served("--most-pages", "3") as url:
        yield url


@pytest.fixture(scope="module")
def cater() -> Iterator[str]:
    with served("--world", "cater") as url:
        yield url


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

    def visit(query: str = OCCUPIED, address: str = address, **options: Any) -> Any:
        contexts.append(browser.new_context(**options))
        page = contexts[-1].new_page()
        page.set_default_timeout(WAIT)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda one: one.url.startswith((address, "data:", "blob:")) or wrong.append(one.url))
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
    assert drawn(page, "imagined").std() > 20 and len(np.unique(drawn(page, "slots").reshape(-1, 4), axis=0)) >= 7
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
    expect(page.locator("#message")).to_have_text("The goal is seen to be reached after 2. The simulator says so, too.")
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
    wanted = set(page.locator("button:visible:enabled").evaluate_all("all => all.map(one => one.textContent)"))
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
    # However much there is to say, it leaves room for the page.
    page.evaluate("say(Array(200).fill('Warning: something.').join('\\n'), 'bad')")
    assert page.locator("#message").bounding_box()["height"] <= 0.3 * 700 + 1


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


def names(page: Any) -> list[str]:
    """Of the things in the scene, when nothing is waited for."""
    expect(page.locator("#message.busy")).to_have_count(0)
    return page.locator("#things button").all_inner_texts()


def middle(page: Any, name: str) -> tuple[float, float]:
    """Where a thing is on the screen."""
    box = page.locator(f"#stage span[title='{name}']").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_what_is_dragged_out_of_the_picture_is_taken_away(visit) -> None:
    page = visit()
    before, box = names(page), page.locator("#scene").bounding_box()
    page.mouse.move(*middle(page, "white bowl"))
    page.mouse.down()
    # At the edge it is still moved, and the environment's checks answer.
    page.mouse.move(box["x"] + 0.97 * box["width"], box["y"] + 1.02 * box["height"], steps=4)
    expect(page.locator("#stage span.leaving")).to_have_count(0)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 1.3 * box["height"], steps=4)
    expect(page.locator("#stage span.leaving")).to_have_count(1)
    page.mouse.up()
    expect(page.locator("#stage span")).to_have_count(5)
    assert names(page) == [one for one in before if one != "white bowl"]
    expect(page.locator("#stage span.leaving")).to_have_count(0)
    # What lies in a bowl is grasped, not the bowl.
    page.mouse.move(*middle(page, "brown block"))
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 1.3 * box["height"], steps=4)
    page.mouse.up()
    expect(page.locator("#stage span")).to_have_count(4)
    assert "brown block" not in names(page) and "cyan bowl" in names(page)


def test_a_second_click_takes_nothing_else_away(visit) -> None:
    page = visit()
    names = page.locator("#things button")
    before = names.all_inner_texts()
    names.nth(0).focus()
    page.locator("#remove").dblclick()
    expect(page.locator("#message")).to_contain_text("gone already")
    assert names.all_inner_texts() == before[1:]


def test_a_finger_moves_things_and_takes_them_away(visit) -> None:
    page = visit(viewport={"width": 390, "height": 800}, has_touch=True, is_mobile=True)
    finger = page.context.new_cdp_session(page)

    def drag(name: str, x: float, y: float) -> None:
        at = middle(page, name)
        points = [(at[0] + (x - at[0]) * k / 5, at[1] + (y - at[1]) * k / 5) for k in range(6)]
        for kind, point in zip(["touchStart"] + 5 * ["touchMove"], points, strict=True):
            touch = {"type": kind, "touchPoints": [dict(zip("xy", point, strict=True))]}
            finger.send("Input.dispatchTouchEvent", touch)
        finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        expect(page.locator("#message")).to_contain_text("Done")

    before, box = names(page), page.locator("#scene").bounding_box()
    drag("white bowl", box["x"] + box["width"] / 2, box["y"] + box["height"] + 60)
    expect(page.locator("#stage span")).to_have_count(5)
    x, y = box["x"] + 0.3 * box["width"], box["y"] + 0.4 * box["height"]
    drag("red block", x, y)
    at = middle(page, "red block")
    assert abs(at[0] - x) < 12 and abs(at[1] - y) < 12 and page.evaluate("scrollY") == 0
    # Tapped, and taken away with the button: one only, even if it is tapped twice.
    page.locator("#stage span[title='yellow bowl']").tap()
    away = page.get_by_role("button", name="take away")
    away.tap()
    expect(page.locator("#stage span")).to_have_count(4)
    away.tap()
    expect(page.locator("#message.bad")).to_contain_text("Choose a thing first")
    assert names(page) == [one for one in before if one not in ("white bowl", "yellow bowl")]


def test_sentences_about_what_is_gone_are_replaced_and_others_stay(visit) -> None:
    own = "please put the red cube in the gray bowl"
    page = visit(OCCUPIED + "&say=put+the+red+block+in+the+white+bowl&say=" + own.replace(" ", "+"))
    first, second = page.get_by_label("sentence").all()
    assert [first.input_value(), second.input_value()] == ["put the red block in the white bowl", own]
    page.get_by_role("button", name="white bowl").focus()
    page.keyboard.press("Delete")
    expect(page.locator("#stage span")).to_have_count(5)
    possible = page.locator("#possible option").evaluate_all("all => all.map(one => one.value)")
    assert first.input_value() in possible and second.input_value() == own
    # The next thing is chosen, so that the keyboard can go on.
    expect(page.get_by_role("button", name="gray bowl")).to_be_focused()


def test_cater_shows_scenes_and_captions_and_nothing_to_arrange(visit, cater) -> None:
    page = visit("?seed=3", cater)
    for gone in ("plan", "add", "take away", "arrange the goal"):
        expect(page.get_by_role("button", name=gone, exact=True)).not_to_be_visible()
    captions = page.locator("#possible option").evaluate_all("all => all.map(one => one.value)")
    assert len(captions) > 5 and page.get_by_label("sentence").input_value() == captions[0]
    # Dragging and keys move nothing.
    page.get_by_role("button", name="small blue metal sphere").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Delete")
    page.mouse.move(*middle(page, "small blue metal sphere"))
    page.mouse.down()
    page.mouse.move(10, 10, steps=3)
    page.mouse.up()
    expect(page.locator("#message")).to_contain_text("Ready")
    assert len(names(page)) == 4
    press(page, "another sentence")
    press(page, "imagine")
    expect(page.locator(".film")).to_have_count(2)
    expect(page.get_by_role("button", name="medium brown metal sphere 2")).to_have_count(3)  # of two alike
    page.get_by_label("sentence").first.fill("the blue sphere is sliding to (-1, 2)")
    press(page, "do it")
    expect(page.get_by_text("what happened", exact=True)).to_have_count(1)
    page.get_by_label("moment").fill("29")
    assert drawn(page, "difference")[..., :3].any() and drawn(page, "what happened").shape == (64, 64, 4)
    # The address brings scene and sentence back.
    again = visit("?" + page.url.split("?")[1], cater)
    assert again.locator("#scene").get_attribute("src") == page.locator("#scene").get_attribute("src")
    assert again.get_by_label("sentence").first.input_value() == "the blue sphere is sliding to (-1, 2)"
    assert "goal" not in page.url
    # Another scene has captions of its own.
    press(page, "another")
    expect(page.locator("#message")).to_contain_text("Done")
    now = page.locator("#possible option").evaluate_all("all => all.map(one => one.value)")
    assert now != captions and page.get_by_label("sentence").nth(1).input_value() in now
    page.locator("#seed").fill("1e9")
    press(page, "show")
    expect(page.locator("#message.bad")).to_contain_text("must be a whole number")


def test_films_of_cater_can_be_downloaded(visit, cater) -> None:
    page = visit("?seed=4", cater, viewport={"width": 390, "height": 800}, has_touch=True)
    assert page.locator(".whole").inner_text() == page.get_by_label("sentence").input_value()  # too long for its field
    press(page, "do it")
    expect(page.locator(".film")).to_have_count(1)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for kind, starts in (("GIF", b"GIF8"), ("MP4", b"ftyp"), ("page to send", b"<!doctype html>")):
        with page.expect_download() as download:
            press(page, kind)
        data = Path(download.value.path()).read_bytes()
        assert starts in data[:20] and len(data) > 5000


def test_a_goal_is_arranged(visit) -> None:
    page = visit("?seed=3&family=plain")
    use = page.get_by_role("button", name="this is the goal")
    expect(use).not_to_be_visible()
    before = page.locator("#scene").get_attribute("src")
    press(page, "arrange the goal")
    expect(use).to_be_visible()
    expect(page.locator("#things button").first).to_be_focused()
    assert page.get_by_role("button", name="plan", exact=True).is_disabled()
    names = page.locator("#things button").all_inner_texts()
    block, bowl = (next(name for name in names if kind in name) for kind in ("block", "bowl"))
    page.locator(f"#stage span[title='{block}']").drag_to(page.locator(f"#stage span[title='{bowl}']"))
    expect(page.locator("#message")).to_contain_text("Done")
    assert page.locator("#scene").get_attribute("src") != before
    use.click()
    expect(page.locator("#message")).to_contain_text("press plan")
    expect(page.get_by_label("goal", exact=True)).to_be_focused()
    assert page.locator("#scene").get_attribute("src") == before
    page.locator("#seed").fill("abc")  # which is refused, and changes nothing
    press(page, "show")
    expect(page.locator("#message")).to_contain_text("must be a whole number")
    press(page, "plan")
    expect(page.get_by_text(f"the {block} in the {bowl}. It is imagined to reach the goal.")).to_be_visible()


def test_a_refused_link_stays_in_the_address_until_something_else_is_wished_for(visit) -> None:
    query = "?world=cater&seed=3&say=the+cone+is+rotating"
    page = visit(query)
    expect(page.locator("#message")).to_contain_text("of the world 'cater'")
    expect(page.locator("#message")).to_contain_text("Another scene is shown")
    assert page.url.endswith(query) and "cone" not in page.get_by_label("sentence").first.input_value()
    press(page, "imagine")
    expect(page.locator(".film")).to_have_count(1)
    press(page, "another sentence")
    assert "world=rearrange" in page.url
    press(page, "remove")
    expect(page.get_by_label("sentence").first).to_be_focused()


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
