"""`textocvp play` without a browser: what the page asks for, and every mistake as a sentence."""

from __future__ import annotations

import base64
import io
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import EntryPoint
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.request import Request as URLRequest
from urllib.request import urlopen

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pybullet
import pytest
from PIL import Image

from envs.cater import Table
from envs.splits import SPLITS
from experiments.study.cater import CaterScene
from planning import AppearanceGrounder, PinholeCamera, Thing
from textocvp import WorldModel, cli
from textocvp.film_page import told_apart

TestClient = pytest.importorskip("fastapi.testclient", exc_type=ImportError).TestClient

from experiments.play import __main__ as command  # noqa: E402
from experiments.play import server  # noqa: E402
from experiments.play.links import Link, Refused  # noqa: E402
from experiments.play.session import FILMS, Session, heard  # noqa: E402
from experiments.play.worlds import WORLDS  # noqa: E402

HORIZON = 24
TABLE = Table(64).camera
OCCUPIED = "seed=0&family=occupied"  # a brown block lies in the cyan bowl
ASKED = "put the red block in the cyan bowl"
YELLOW = {Thing("yellow", "bowl"): Thing("mauve", "bowl")}  # taken for another


@pytest.fixture(scope="module")
def world_model() -> WorldModel:
    return WorldModel.from_pretrained()


class Page:
    """An open page, as its script asks."""

    def __init__(self, client: Any, query: str = "") -> None:
        self.client = client
        opened = client.post("/api/open", json={"query": query})
        assert opened.status_code == 200, opened.text
        self.name, self.opened = opened.json()["page"], opened.json()

    def ask(self, verb: str, **body: Any) -> Any:
        answer = self.client.post(f"/api/{self.name}/{verb}", json=body)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def refused(self, verb: str, **body: Any) -> str:
        """The sentence that a wrong wish gets."""
        answer = self.client.post(f"/api/{self.name}/{verb}", json=body)
        assert 400 <= answer.status_code < 500 and "Traceback" not in answer.text
        return answer.json()["error"]

    @property
    def scene(self) -> dict[str, Any]:
        return self.client.app.state.sessions.get(self.name).view()


@pytest.fixture
def open_page(world_model: WorldModel) -> Iterator[Callable[..., Page]]:
    with TestClient(server.create_app(world_model, WORLDS["rearrange"])) as client:
        yield lambda query="": Page(client, query)


def pixels(url: str) -> np.ndarray:
    """The picture (H, W, 3) of a data URL."""
    return iio.imread(base64.b64decode(url.removeprefix("data:image/png;base64,")))


def test_a_film_shows_what_the_model_imagines(open_page, world_model) -> None:
    page = open_page(OCCUPIED)
    texts = [ASKED, "put the red block in the gray bowl"]
    films = page.ask("imagine", texts=texts)["films"]
    env = gym.make("RearrangeBlocks-v0", control="primitive")
    observation, _ = env.reset(seed=0, options={"family": "occupied"})
    expected = world_model.rollout(observation, texts, horizon=HORIZON, attention=True)
    assert expected.attention is not None
    for row, film in enumerate(films):
        frames = expected.frames[row].permute(0, 2, 3, 1).mul(255).round().byte().numpy()
        assert np.array_equal(pixels(film["frames"]).reshape(frames.shape), frames)
        labels = np.repeat(film["runs"][::2], film["runs"][1::2]).reshape(frames.shape[:3])
        assert np.array_equal(labels, expected.masks[row].argmax(1).numpy())
        assert film["words"] == texts[row].split()
        attention = expected.attention[row].mean((1, 2)).numpy() * 100
        assert np.abs(np.array(film["attention"])[1:] - attention).max() <= 0.51
        assert {one["name"] for one in film["slots"]} == {
            "arm", "red block", "brown block", "cyan bowl", "gray bowl", "white bowl", "yellow bowl"
        }  # fmt: skip


def test_things_of_one_colour_are_shown_in_several() -> None:
    colors = np.array([[150, 150, 150], [200, 40, 40], [195, 45, 40], [40, 40, 200], [205, 40, 35]])
    shown = told_apart(colors, [1, 2, 3, 4])
    assert np.array_equal(shown[[0, 1, 3]], colors[[0, 1, 3]])
    apart = np.abs(shown[:, None] - shown[None]).max(-1)[np.triu_indices(5, 1)]
    assert apart.min() >= 40


def test_an_act_is_shown_beside_what_was_imagined_and_a_link_brings_all_of_it_back(open_page) -> None:
    page = open_page(OCCUPIED)
    before = pixels(page.opened["scene"]["picture"])
    answer = page.ask("do", text="Please place the brown cube into the yellow bowl!")
    real, imagined = (pixels(answer["film"][name]).reshape(-1, 64, 64, 3) for name in ("real", "frames"))
    assert np.array_equal(real[0], before) and np.array_equal(real[-1], pixels(answer["scene"]["picture"]))
    apart = np.abs(real.astype(int) - imagined).mean((1, 2, 3)) / 2.55
    assert np.abs(apart - answer["film"]["apart_percent"]).max() < 0.051
    assert np.abs(real[-1].astype(int) - real[0]).max() > 50  # something moved
    again = open_page(answer["scene"]["link"]).opened["scene"]
    assert again == answer["scene"]
    # The same after things were moved, added and removed.
    white = next(one for one in answer["scene"]["things"] if one["name"] == "white bowl")
    page.ask("move", thing=white["id"], x=white["at"][0] + 2, y=white["at"][1] + 2)
    page.ask("remove", thing=next(one["id"] for one in page.scene["things"] if one["name"] == "gray bowl"))
    scene = page.ask("add", kind="block", color="pink")["scene"]
    names = {one["name"] for one in scene["things"]}
    assert "pink block" in names and "gray bowl" not in names
    assert open_page(scene["link"]).opened["scene"] == scene


def test_a_plan_goes_where_the_obvious_sentence_does_not(open_page) -> None:
    page = open_page(OCCUPIED)
    plan = page.ask("plan", text=ASKED)
    assert plan["obvious"]["wrong"] == ["the red block is imagined to end on the brown block, not in the cyan bowl"]
    assert plan["reaches"] and len(plan["sentences"]) == len(plan["films"]) == 2
    chosen = [node for node in plan["tree"] if node["chosen"]]
    assert [node["text"] for node in chosen] == plan["sentences"] and chosen[-1]["reaches"]
    # Depths are those of a tree that is written from its root.
    depths = [node["depth"] for node in plan["tree"]]
    assert depths[0] == 1 and all(after <= before + 1 for before, after in pairwise(depths))
    for text in plan["sentences"]:
        answer = page.ask("do", text=text)
    assert answer["reached"] == {"seen": True, "true": True}
    assert page.ask("plan", text=ASKED)["done"]


def test_a_goal_is_arranged_and_planned_for(open_page) -> None:
    page = open_page("seed=3&family=plain")
    start = page.scene
    assert page.ask("goal", what="begin")["scene"]["arranging"]
    at = {one["name"]: one for one in start["things"]}
    block, bowl = (next(name for name in at if kind in name) for kind in ("block", "bowl"))
    page.ask("move", thing=at[block]["id"], x=at[bowl]["at"][0], y=at[bowl]["at"][1])
    assert "being arranged" in page.refused("plan", text="")
    assert page.ask("goal", what="use")["scene"] == start
    plan = page.ask("plan", text="")
    assert plan["obvious"] is None and plan["sentences"] == [f"put the {block} in the {bowl}"]
    assert page.ask("do", text=plan["sentences"][0])["reached"] == {"seen": True, "true": True}


def test_an_arranged_goal_is_reached_whatever_numbers_its_things_had(open_page) -> None:
    page = open_page("seed=3&family=plain")
    at = {one["name"]: one for one in page.scene["things"]}
    block, bowl = (next(name for name in at if kind in name) for kind in ("block", "bowl"))
    page.ask("goal", what="begin")
    page.ask("remove", thing=at[bowl]["id"])
    added = page.ask("add", kind="bowl", color=bowl.split()[0])["scene"]["things"]
    assert added[-1]["name"] == bowl and at[bowl]["id"] != added[-1]["id"]
    place = page.ask("move", thing=added[-1]["id"], x=at[bowl]["at"][0], y=at[bowl]["at"][1])["scene"]["things"][-1][
        "at"
    ]
    number = next(one["id"] for one in added if one["name"] == block)
    page.ask("move", thing=number, x=place[0], y=place[1])
    page.ask("goal", what="use")
    assert page.ask("do", text=f"put the {block} in the {bowl}")["reached"] == {"seen": True, "true": True}


def test_a_bowl_is_moved_with_what_lies_in_it(open_page) -> None:
    page = open_page(OCCUPIED)
    names = {one["name"]: one for one in page.scene["things"]}
    page.ask("remove", thing=names["white bowl"]["id"])
    before = {one["name"]: np.array(one["at"]) for one in page.scene["things"]}
    bowl = next(one["id"] for one in page.scene["things"] if one["name"] == "cyan bowl")
    page.ask("move", thing=bowl, x=22.0, y=20.0)
    after = {one["name"]: np.array(one["at"]) for one in page.scene["things"]}
    assert np.abs(after["cyan bowl"] - (22, 20)).max() < 2
    shift = {name: after[name] - before[name] for name in before}
    assert np.abs(shift["brown block"] - shift["cyan bowl"]).max() < 1.5
    assert all(np.abs(shift[name]).max() < 0.2 for name in ("red block", "gray bowl", "yellow bowl"))


@pytest.mark.parametrize(
    ("verb", "body", "said"),
    [
        ("scene", {"query": "seed=-1"}, "whole number"),
        ("scene", {"query": "seed=1e3"}, "whole number"),
        ("scene", {"query": "seed=" + "9" * 30}, "20 digits"),
        ("scene", {"query": "family=nothing"}, "plain"),
        ("scene", {"query": "layout=block,red"}, "damaged"),
        ("scene", {"query": "layout=block,red,0.5,0,nan,0;bowl,blue,0.4,inf,0,0"}, "workspace"),
        ("scene", {"query": "acts=1,2,3"}, "damaged"),
        ("scene", {"query": "acts=1,2,3,nan"}, "damaged"),
        ("scene", {"query": "acts=" + "0,0,0,0;" * 101}, "at most 100"),
        ("imagine", {"texts": []}, "1 to 12"),
        ("imagine", {"texts": ["x y"] * 13}, "1 to 12"),
        ("imagine", {"texts": [" "]}, "empty"),
        ("imagine", {"texts": ["do not put the red block in the cyan bowl"]}, "not"),
        ("imagine", {"texts": [3]}, "string"),
        ("imagine", {}, "texts"),
        ("do", {"text": "sing a song"}, "cannot read"),
        ("do", {"text": "put the blue block in the cyan bowl"}, "no blue block"),
        ("plan", {"text": ""}, "say what the goal is"),
        ("plan", {"text": "world peace"}, "cannot read"),
        ("plan", {"text": "put the blue block in the cyan bowl"}, "no blue block"),
        ("goal", {"what": "use"}, "no goal is being arranged"),
        ("move", {"thing": 17, "x": 1, "y": 1}, "no thing number 17"),
        ("move", {"thing": 0, "x": 1e9, "y": 1}, "workspace"),
        ("add", {"kind": "block", "color": "red"}, "share a colour"),
        ("add", {"kind": "cup", "color": "blue"}, "no blue cup"),
    ],
)
def test_a_wrong_wish_gets_a_sentence_and_changes_nothing(open_page, verb, body, said) -> None:
    page = open_page(OCCUPIED)
    before = page.scene
    assert said in page.refused(verb, **body)
    assert page.scene == before


def test_what_is_no_json_and_no_text_gets_a_sentence(open_page) -> None:
    page = open_page(OCCUPIED)

    def send(verb: str, body: bytes) -> str:
        url, kind = f"/api/{page.name}/{verb}", {"Content-Type": "application/json"}
        answer = page.client.post(url, content=body, headers=kind)
        assert 400 <= answer.status_code < 500
        return answer.json()["error"]

    assert all(send("imagine", body) for body in (b"[" * 100_000, b"{", b"\xff"))
    half = rb'"put the red block \ud800"'  # JSON may hold half a character
    assert "texts.0: Value error, it holds half a character" in send("imagine", b'{"texts": [%s]}' % half)
    assert "text: Value error, it holds half a character" in send("do", b'{"text": %s}' % half)
    assert page.client.get("/api/nowhere").json() == {"error": "Not Found"}


def test_a_wrong_link_is_said_and_another_scene_is_shown(open_page) -> None:
    opened = open_page("?seed=abc&say=hello").opened
    assert "not 'abc'" in opened["problems"][0] and opened["scene"]["link"] == "world=rearrange&seed=0"


def blank(width: int, height: int) -> bytes:
    """A picture file that is small however large the picture is."""
    Image.new("1", (width, height)).save(buffer := io.BytesIO(), "PNG")
    return buffer.getvalue()


def upload(page: Page, data: bytes) -> Any:
    return page.client.post(f"/api/{page.name}/picture", content=data)


def test_a_link_of_another_world_is_not_taken(open_page) -> None:
    page = open_page("world=cater&seed=3")
    assert page.opened["problems"] == ["this link is of the world 'cater', and here is 'rearrange' (--world)"]
    assert page.opened["scene"]["seed"] == "0"
    own = open_page(open_page("seed=3").opened["scene"]["link"])
    assert own.opened["problems"] == [] and own.opened["scene"]["seed"] == "3"


def test_an_endless_sentence_is_not_repeated(open_page) -> None:
    page = open_page()
    for verb, body in (("imagine", {"texts": [2000 * "word "]}), ("do", {"text": 2000 * "word "})):
        assert "10000 characters, and at most 600" in page.refused(verb, **body)
    assert len(page.refused("scene", query="seed=" + 3000 * "z")) < 650


def test_in_a_world_without_towers_nothing_is_said_of_them(world_model) -> None:
    with TestClient(server.create_app(world_model, WORLDS["tabletop"], horizon=3)) as client:
        page = Page(client, "seed=100")
        blocks = [one["name"] for one in page.opened["scene"]["things"] if one["name"].endswith("block")]
        stacked = f"put the {blocks[0]} on the {blocks[1]}"
        assert "in this world nothing is put on a block" in page.refused("do", text=stacked)
        plan = page.ask("plan", text=page.opened["scene"]["task"])
        said = [node["text"] for node in plan["tree"]]
        assert said and all(" in the " in one for one in said)


def test_slots_are_called_what_they_show(world_model, monkeypatch) -> None:
    """Whatever the planner takes things for; and where it is wrong, that is told."""
    ground = AppearanceGrounder.__call__

    def wrongly(self: AppearanceGrounder, parsed: Any) -> Any:
        found = ground(self, parsed)
        return replace(found, things={YELLOW.get(one, one): slots for one, slots in found.things.items()})

    monkeypatch.setattr(AppearanceGrounder, "__call__", wrongly)
    with TestClient(server.create_app(world_model, WORLDS["rearrange"], horizon=3)) as client:
        page = Page(client, OCCUPIED)
        there = {one["name"] for one in page.opened["scene"]["things"]}
        film = page.ask("imagine", texts=[ASKED])["films"][0]
        assert {one["name"] for one in film["slots"]} - {"arm", "table"} == there
        plan = page.ask("plan", text=ASKED)
        assert "the planner sees a mauve bowl, which is not there" in plan["warnings"]


def test_a_picture_is_taken_as_the_project_takes_pictures(open_page) -> None:
    page = open_page(OCCUPIED)
    large = Image.fromarray(pixels(page.scene["picture"])).resize((128, 128), Image.Resampling.NEAREST)
    buffer = io.BytesIO()
    large.save(buffer, "PNG")
    answer = upload(page, buffer.getvalue()).json()
    assert answer["done"] == ["brought it from 128x128 to 64x64 pixels"] and not answer["warnings"]
    assert answer["scene"]["own_picture"] and ASKED in answer["scene"]["sentences"]
    assert len(page.ask("imagine", texts=[ASKED])["films"]) == 1
    for verb, body in (("do", {"text": ASKED}), ("move", {"thing": 0, "x": 3, "y": 3}), ("plan", {"text": ASKED})):
        assert page.refused(verb, **body)
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 60, 3), np.uint8))
    noise.save(buffer := io.BytesIO(), "JPEG")
    assert "does not look like those" in upload(page, buffer.getvalue()).json()["warnings"][0]
    assert not page.ask("scene", query=OCCUPIED)["scene"]["own_picture"]


def test_no_picture_is_taken_while_a_goal_is_arranged(open_page) -> None:
    page = open_page(OCCUPIED)
    Image.fromarray(pixels(page.scene["picture"])).save(buffer := io.BytesIO(), "PNG")
    page.ask("goal", what="begin")
    assert "being arranged" in upload(page, buffer.getvalue()).json()["error"]
    assert page.ask("goal", what="cancel")["scene"] == page.opened["scene"]


def test_a_wrong_picture_is_refused_in_a_sentence(open_page) -> None:
    page = open_page(OCCUPIED)
    before = page.scene
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)).save(
        buffer := io.BytesIO(), "PNG"
    )
    for data, said in (
        (b"", "no picture"),
        (b"Dear sir or madam", "it is of no known kind"),
        (blank(8000, 8000), "too many pixels: more than 50 million"),
        (blank(20000, 10000), "too many pixels: more than 50 million"),
        (buffer.getvalue()[:3000], "no picture"),
        (bytes(50 * 2**20), "50 MB; at most 20 MB"),
    ):
        answer = upload(page, data)
        assert answer.status_code == 400 and said in answer.json()["error"]
    assert page.scene == before


def test_films_can_be_downloaded(open_page, tmp_path: Path) -> None:
    page = open_page(OCCUPIED)
    assert "nothing has been imagined" in page.client.get(f"/api/{page.name}/film.gif").json()["error"]
    page.ask("imagine", texts=[ASKED])
    for kind in ("gif", "mp4"):
        (tmp_path / f"film.{kind}").write_bytes(page.client.get(f"/api/{page.name}/film.{kind}").content)
        assert len(iio.imread(tmp_path / f"film.{kind}")) == HORIZON + 1
    sent = page.client.get(f"/api/{page.name}/film.html").text
    assert ASKED in sent and "red block" in sent
    # Acts that the page shows beside each other are one film, and one page.
    for more in (False, True):
        page.ask("plan", text=ASKED)  # as the page does before each act of a plan that is carried out
        page.ask("do", text=("put the brown block in the gray bowl", ASKED)[more], more=more)
    film = iio.imread(page.client.get(f"/api/{page.name}/film.gif").content, extension=".gif")
    assert len(film) == 2 * (HORIZON + 1) and film.shape[2] > 3 * 256
    assert page.client.get(f"/api/{page.name}/film.html").text.count('"real"') == 2
    assert page.client.get(f"/api/{page.name}/film.gif.html").headers["content-type"].startswith("text/html")
    assert "not '.exe'" in page.client.get(f"/api/{page.name}/film.exe").json()["error"]


def test_pages_are_counted_and_closed(world_model) -> None:
    with TestClient(server.create_app(world_model, WORLDS["tabletop"], most_pages=2)) as client:
        first, second = Page(client), Page(client)
        full = client.post("/api/open", json={"query": ""})
        assert full.status_code == 400 and "--most-pages 2" in full.json()["error"]
        sessions = client.app.state.sessions
        env = sessions.get(first.name).world.env
        assert client.post(f"/api/{first.name}/close").status_code == 200
        with pytest.raises(gym.error.ClosedEnvironmentError):
            env.reset()
        gone = client.post(f"/api/{first.name}/imagine", json={"texts": [ASKED]})
        assert gone.status_code == 410 and "load it again" in gone.json()["error"]
        Page(client)
        # A tab that vanished without a word.
        sessions.idle_seconds = 0.0
        sessions.sweep()
        assert not sessions.open
        assert client.post(f"/api/{second.name}/alive").status_code == 410
        Page(client)
    assert not sessions.open  # the end of the server closes all


def test_one_page_does_not_wait_for_another(open_page, monkeypatch) -> None:
    slow, quick = open_page(OCCUPIED), open_page("seed=1")
    session = slow.client.app.state.sessions.get(slow.name)
    begun, may_end = threading.Event(), threading.Event()

    def imagine(texts: list[str]) -> list[Any]:
        begun.set()
        assert may_end.wait(20)
        warnings.warn("of the slow one", UserWarning, stacklevel=1)
        return []

    monkeypatch.setattr(session, "imagine", imagine)
    answers: list[Any] = []
    thread = threading.Thread(target=lambda: answers.append(slow.ask("imagine", texts=[ASKED])))
    thread.start()
    assert begun.wait(20)
    other = quick.ask("imagine", texts=["put the mauve block in the blue bowl"])
    may_end.set()
    thread.join(20)
    # Neither hears the warnings of the other.
    assert len(other["films"]) == 1 and answers[0]["warnings"] == ["of the slow one"]
    assert other["warnings"] and "of the slow one" not in other["warnings"]


def test_nobody_waits_for_a_page_that_is_opened(world_model) -> None:
    """A link may repeat many acts."""
    sessions = server.Sessions(lambda link: Session(world_model, WORLDS["tabletop"], link, 2), most=2)
    make, begun, may_end = sessions.make, threading.Event(), threading.Event()
    name, _ = sessions.add(Link())

    def slowly(link: Link) -> Session:
        begun.set()
        assert may_end.wait(20)
        return make(link)

    sessions.make = slowly
    opening = threading.Thread(target=lambda: sessions.add(Link(1)))
    opening.start()
    assert begun.wait(20)
    asked = threading.Thread(target=lambda: sessions.get(name), daemon=True)
    asked.start()
    asked.join(5)
    assert not asked.is_alive()
    with pytest.raises(Refused, match="no more pages may be open than 2"):  # the one that is being opened has its place
        sessions.add(Link(2))
    may_end.set()
    opening.join(20)
    assert len(sessions.open) == 2
    sessions.make = lambda link: (_ for _ in ()).throw(Refused("no such scene"))
    for one in list(sessions.open):
        sessions.close(one)
    for _ in range(3):  # what cannot be opened takes no place
        with pytest.raises(Refused, match="no such scene"):
            sessions.add(Link())


def test_memory_does_not_grow(world_model) -> None:
    def resident() -> int:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * 4096

    with TestClient(server.create_app(world_model, WORLDS["rearrange"], horizon=2)) as client:
        for turn in range(90):
            if turn == 20:
                before = resident()
            page = Page(client, f"seed={turn}")
            page.ask("imagine", texts=page.opened["scene"]["sentences"][:1])
            client.post(f"/api/{page.name}/close")
        assert resident() - before < 8 * 2**20  # after 210 requests


def test_a_model_without_foresight_plans_by_films(monkeypatch: pytest.MonkeyPatch) -> None:
    model, films = WorldModel.from_pretrained("tabletop-small-40"), list[int]()
    rollout = model.rollout
    monkeypatch.setattr(model, "rollout", lambda obs, text, **how: films.append(len(text)) or rollout(obs, text, **how))
    with TestClient(server.create_app(model, WORLDS["tabletop"], horizon=3)) as client:
        page = Page(client)
        sentence = page.opened["scene"]["sentences"][0]
        assert page.ask("imagine", texts=[sentence])["films"][0]["count"] == 4
        films.clear()
        answer = page.ask("plan", text=sentence)
        assert len(answer["sentences"]) == 1 and all(node["depth"] == 1 for node in answer["tree"])
        assert len(page.opened["scene"]["sentences"]) <= sum(films) <= 2 * FILMS
        assert "no families" in page.refused("scene", query="family=plain")


def test_links_say_what_they_hold() -> None:
    link = Link(7, "swap", (("block", "red", 0.5, -0.1, 0.03, 1.5),), ((0.4, 0.0, 0.5, 0.1),))
    assert Link.parse("?" + link.query() + "&say=put") == link
    with pytest.raises(Refused):
        Link.parse("acts=a,b,c,d")


def test_the_page_needs_no_other_host(open_page) -> None:
    answer = open_page().client.get("/")
    assert not re.findall(r"(?:https?:)?//[\w.-]+\.\w+", re.sub(r"(?m)^\s*//.*$", "", answer.text))
    assert "/*film" not in answer.text and "default-src 'self'" in answer.headers["content-security-policy"]


def test_warnings_outside_are_not_kept() -> None:
    with heard() as sentences:
        warnings.warn("one", UserWarning, stacklevel=1)
        warnings.warn("one", UserWarning, stacklevel=1)
    warnings.warn("two", UserWarning, stacklevel=1)
    assert sentences == ["one", "one"]


# ---- CATER's world


@pytest.fixture(scope="module")
def cater_model() -> WorldModel:
    return WorldModel.from_pretrained("cater")


@pytest.fixture
def open_cater(cater_model: WorldModel) -> Iterator[Callable[..., Page]]:
    with TestClient(server.create_app(cater_model, WORLDS["cater"])) as client:
        yield lambda query="": Page(client, query)


def test_a_scene_of_cater_is_imagined_and_done_as_its_simulator_draws_it(open_cater, cater_model) -> None:
    page = open_cater("seed=3")
    about, scene = page.opened["about"], page.opened["scene"]
    assert not about["edits"] and not about["families"]
    truth = CaterScene("test", SPLITS["test"].seed(3))
    frames, _ = truth.watch(64)
    own = truth.clip().instruction
    assert np.array_equal(pixels(scene["picture"]), frames[0])
    assert scene["sentences"][0] == scene["task"] == own and len(set(scene["sentences"])) > 5
    names = [one["name"] for one in scene["things"]]
    assert len(set(names)) == len(names) == len(truth.clip().things)
    assert all(0 < v < 64 for one in scene["things"] for v in one["at"])
    # The thing stands where the page says: the pixel there is not the floor.
    for one in scene["things"]:
        x, y = map(int, one["at"])
        assert np.ptp(frames[0][y, x].astype(int)) > 20, one
    films = page.ask("imagine", texts=scene["sentences"][:2])["films"]
    expected = cater_model.rollout(frames[0], scene["sentences"][:2], horizon=29, attention=True)
    for row, film in enumerate(films):
        imagined = expected.frames[row].permute(0, 2, 3, 1).mul(255).round().byte().numpy()
        assert np.array_equal(pixels(film["frames"]).reshape(imagined.shape), imagined)
        assert {one["name"] for one in film["slots"]} == {*names, "table"}
        assert len(film["attention"][0][0]) == len(film["words"])
    answer = page.ask("do", text=own.upper())
    assert np.array_equal(pixels(answer["film"]["real"]).reshape(frames.shape), frames)
    # Every caption begins from the same scene, and a link brings it back.
    assert answer["scene"] == scene == open_cater(scene["link"]).opened["scene"]


def test_a_caption_of_ones_own_is_done_and_the_same_again(open_cater) -> None:
    page = open_cater("seed=3")
    text = "The blue sphere is picked up and placed to (-1, 2)."
    assert text not in page.scene["sentences"]
    one, again = (page.ask("do", text=text)["film"]["real"] for _ in range(2))
    assert one == again
    real = pixels(one).reshape(-1, 64, 64, 3).astype(int)
    blue = [np.argwhere(frame[..., 2] - frame[..., 0] > 60).mean(0) for frame in real]
    goal = PinholeCamera(TABLE.intrinsics, TABLE.extrinsics).project(np.array([-0.5, 1.5, 0.25]))
    assert np.hypot(*(blue[-1][::-1] - goal)) < 5  # a cell is about 9 pixels wide
    assert min(y for y, _ in blue) < min(blue[0][0], blue[-1][0]) - 3  # it was lifted


@pytest.mark.parametrize(
    ("verb", "body", "said"),
    [
        ("scene", {"query": "seed=-1"}, "whole number"),
        ("scene", {"query": "seed=10000000"}, "less than 10000000"),
        ("scene", {"query": "family=plain"}, "a seed"),
        ("scene", {"query": "layout=block,red,0.5,0,0.03,0"}, "a seed"),
        ("scene", {"query": "acts=0.4,0,0.5,0"}, "a seed"),
        ("do", {"text": "put the red block in the cyan bowl"}, "captions are like"),
        ("do", {"text": "the pink cone is rotating."}, "no pink cone is here; here are: medium brown"),
        ("do", {"text": "the blue sphere is sliding to (0, 9)"}, "without 0"),
        ("move", {"thing": 0, "x": 1, "y": 1}, "stay as they are drawn"),
        ("remove", {"thing": 0}, "stay as they are drawn"),
        ("add", {"kind": "block", "color": "red"}, "stay as they are drawn"),
        ("goal", {"what": "begin"}, "stay as they are drawn"),
        ("plan", {"text": "put the red block in the cyan bowl"}, "no plans are made"),
    ],
)
def test_what_makes_no_sense_in_cater_gets_a_sentence(open_cater, verb, body, said) -> None:
    page = open_cater("seed=3")
    before = page.scene
    assert said in page.refused(verb, **body)
    assert page.scene == before


def test_a_picture_of_ones_own_in_cater_has_slots_with_numbers(open_cater) -> None:
    page = open_cater("seed=3")
    Image.fromarray(pixels(page.scene["picture"])).save(buffer := io.BytesIO(), "PNG")
    own = page.scene["task"]
    answer = upload(page, buffer.getvalue()).json()
    assert not answer["warnings"] and answer["scene"]["own_picture"] and not answer["scene"]["sentences"]
    (film,) = page.ask("imagine", texts=[own])["films"]
    assert len(film["slots"]) == 5 and all(re.fullmatch(r"table|slot \d+", one["name"]) for one in film["slots"])
    assert "no simulator behind it" in page.refused("do", text=own)


def test_what_was_imagined_keeps_its_names_when_another_scene_is_shown(open_cater) -> None:
    page = open_cater("seed=3")
    page.ask("imagine", texts=[page.scene["task"]])
    page.ask("scene", query="seed=4")
    sent = page.client.get(f"/api/{page.name}/film.html").text
    (data,) = re.findall(r"const page = (.*);\n", sent)
    assert "small blue metal sphere" in {one["name"] for one in json.loads(data)["films"][0]["slots"]}


def test_a_closed_page_of_cater_frees_its_simulator(cater_model) -> None:
    with TestClient(server.create_app(cater_model, WORLDS["cater"])) as client:
        page = Page(client)
        bullet = client.app.state.sessions.get(page.name).world.table.bullet.client
        assert pybullet.isConnected(bullet)
        client.post(f"/api/{page.name}/close")
        assert not pybullet.isConnected(bullet)


# ---- the command


def test_where_it_cannot_listen_it_says_why(capsys) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for arguments, said in (
            (["--port", str(port)], f"port {port}: Address already in use"),
            (["--port", "70000"], "0 to 65535"),
            (["--host", "no.such.host.invalid"], "no such address"),
            (["--host", "a..b"], "no such address"),
            (["--most-pages", "0"], "at least 1"),
            (["--port", "0", "--checkpoint", "nothing"], "nothing"),
        ):
            assert command.main(["--no-browser", *arguments]) == 1
            printed = capsys.readouterr().err
            assert printed.startswith("textocvp: ") and said in printed and "Traceback" not in printed


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_server_that_is_stopped_while_it_plans_says_so_and_no_more(how: signal.Signals) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    line = [sys.executable, "-m", "textocvp.cli", "play", "--no-browser", "--port", str(port)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        assert run.stdout is not None
        while "(Ctrl-C ends it)" not in run.stdout.readline():
            assert run.poll() is None

        def ask(verb: str, **body: Any) -> Any:
            data, kind = json.dumps(body).encode(), {"Content-Type": "application/json"}
            return json.load(urlopen(URLRequest(f"http://127.0.0.1:{port}/api/{verb}", data, kind), timeout=60))

        name = ask("open", query=OCCUPIED)["page"]

        def plan() -> None:
            with suppress(OSError):  # the server goes away
                for _ in range(9):
                    ask(f"{name}/imagine", texts=12 * [ASKED])

        busy = threading.Thread(target=plan)
        busy.start()
        time.sleep(0.3)
        run.send_signal(how)
        said = run.stdout.read()
        busy.join()
    assert run.returncode == 0
    assert "textocvp: stopped" in said and "Traceback" not in said and "ERROR" not in said


@pytest.mark.parametrize(
    ("checkpoint", "lacks"), [("non-oc-small", "slots of things"), ("ocvp-seq-small", "sentences")]
)
def test_a_model_that_cannot_be_played_with_is_refused(capsys, checkpoint: str, lacks: str) -> None:
    assert command.main(["--no-browser", "--port", "0", "--checkpoint", checkpoint]) == 1
    assert f"--checkpoint {checkpoint}: this model knows no {lacks}" in capsys.readouterr().err


def test_a_model_of_another_world_is_told(capsys, monkeypatch) -> None:
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: None)
    assert command.main(["--no-browser", "--port", "0", "--world", "tabletop", "--checkpoint", "cliport"]) == 0
    assert "cliport was trained on another world (cliport)" in capsys.readouterr().err
    assert command.main(["--no-browser", "--port", "0", "--world", "tabletop", "--checkpoint", "tabletop-small"]) == 0
    assert "another world" not in capsys.readouterr().err


def test_the_address_says_who_can_reach_it() -> None:
    assert command.is_loopback("127.0.0.1") and command.is_loopback("::1")
    assert not command.is_loopback("0.0.0.0") and not command.is_loopback("::")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_page_of_this_machine_alone_answers_to_its_own_names_only(host, monkeypatch) -> None:
    served: list[Any] = []
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: served.append(self.config.app))
    if host == "::1" and not Path("/proc/net/if_inet6").exists():
        pytest.skip("this machine has no IPv6")
    assert command.main(["--no-browser", "--port", "0", "--host", host]) == 0
    own = f"[{host}]" if ":" in host else host
    client = TestClient(served[0])
    for name, status in ((own, 200), (f"{own}:7860", 200), ("localhost:7860", 200), ("another.example", 400)):
        assert client.get("/", headers={"host": name}).status_code == status, name


def test_who_opens_the_page_to_the_network_is_told(capsys, monkeypatch) -> None:
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: None)
    assert command.main(["--no-browser", "--port", "0", "--host", "0.0.0.0"]) == 0
    assert "everyone who reaches this machine" in capsys.readouterr().err
    assert command.main(["--no-browser", "--port", "0"]) == 0
    assert "everyone" not in capsys.readouterr().err


def test_the_command_line_finds_the_page(capsys, monkeypatch) -> None:
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    (target,) = re.findall(r'\[project\.entry-points\."textocvp\.commands"\]\nplay = "(.*)"', text)
    announced = EntryPoint("play", target, "textocvp.commands")
    assert announced.load() is command.main
    monkeypatch.setattr(cli, "entry_points", lambda **_: [announced])
    assert cli.main(["play", "--no-browser", "--port", "-1"]) == 1
    assert "0 to 65535" in capsys.readouterr().err
    monkeypatch.setattr(cli, "entry_points", lambda **_: [])
    assert cli.main(["play"]) == 1
    assert "pip install" in capsys.readouterr().err


def test_a_rollout_becomes_one_page_to_send(capsys, tmp_path: Path) -> None:
    env = gym.make("RearrangeBlocks-v0", control="primitive")
    iio.imwrite(tmp_path / "scene.png", env.reset(seed=0, options={"family": "occupied"})[0]["rgb"])
    arguments = ["rollout", str(tmp_path / "scene.png"), ASKED, "put the red block in the </script> bowl"]
    page = tmp_path / "sent" / "what-if.html"
    assert cli.main([*arguments, "--horizon", "3", "--out", str(tmp_path / "a.gif"), "--html", str(page)]) == 0
    assert str(page) in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=|https?://", text) and text.count("</script>") == 1
    (data,) = re.findall(r"const page = (.*);\n", text)
    films = json.loads(data)["films"]
    assert [film["count"] for film in films] == [4, 4] and films[0]["words"] == ASKED.split()
    assert sum(one["name"] != "table" for one in films[0]["slots"]) == 7  # six things and the arm
