"""What one open page plays with: a scene in its own simulator, and the model that all pages share."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch

from envs.colors import COLORS
from envs.tabletop import TabletopEnv
from experiments.play.links import MOST_ACTS, Link, Refused
from experiments.play.plans import plan_data
from planning import (
    RELATIONS,
    AppearanceGrounder,
    Foresees,
    Goal,
    Grounding,
    Instruction,
    LiteralController,
    PictureGoal,
    PinholeCamera,
    SearchPlanner,
    Thing,
)
from planning.controller import RESTING_HEIGHTS
from planning.search import HORIZON
from textocvp import Rollout, WorldModel
from textocvp.film_page import film_data, picture_url, save_page
from textocvp.pictures import SUFFIXES, read_picture, save_film

MOST_SENTENCES = 12  # side by side


@dataclass(frozen=True)
class World:
    """An environment to play in, and the checkpoint that knows it."""

    env_id: str
    checkpoint: str
    options: Mapping[str, Any]

    def make(self, image_size: int) -> gym.Env[Any, Any]:
        """The environment, which acts by pick-and-place and keeps all frames."""
        options = {"image_size": image_size, "max_steps": 10**6, **self.options}
        return gym.make(self.env_id, control="primitive", record_frames=True, **cast(Any, options))


WORLDS = {
    "tabletop": World("envs:PutBlockInBowl-v0", "tabletop-small", {}),
    "rearrange": World("envs:RearrangeBlocks-v0", "tabletop-small", {}),
    "cliport": World("envs:PutBlockInBowl-v0", "cliport", {"scene": "cliport"}),
}
Shown = tuple[Rollout, np.ndarray | None]  # imagined, and what happened (T, H, W, 3) where it was carried out

_heard = threading.local()


@contextmanager
def heard() -> Iterator[list[str]]:
    """The warnings of this thread, as sentences. `warnings.catch_warnings` would take those of other threads, too."""
    if warnings.showwarning is not _keep:
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = _keep
    _heard.sentences = []
    try:
        yield _heard.sentences
    finally:
        del _heard.sentences


def _keep(message: Warning | str, *_: Any, **__: Any) -> None:
    if hasattr(_heard, "sentences"):
        _heard.sentences.append(str(message))


class Session:
    """One page's scene. Its methods are called by one thread at a time; `lock` sees to that.

    Raises:
        Refused, ValueError, GroundingError: from every method that takes wishes, with a sentence for the page.
    """

    def __init__(self, world_model: WorldModel, world: World, link: Link, horizon: int = HORIZON) -> None:
        self.world_model, self.world = world_model, world
        self.horizon = min(horizon, world_model.longest_horizon or horizon)
        self.lock = threading.Lock()
        self.env = world.make(world_model.image_size[0])
        self.base = cast(TabletopEnv, self.env.unwrapped)
        self.link = Link()
        self.picture: np.ndarray | None = None  # a person's own, instead of the scene
        self.goal: Goal | PictureGoal | None = None
        self.before_goal: Link | None = None  # the scene, while the goal is arranged
        self.goal_supports: tuple[int, ...] = ()  # of a goal that was arranged
        self.shown: list[Shown] = []  # what may be downloaded, in the order of the page
        try:
            self.show(link)
        except BaseException:
            self.env.close()
            raise

    def close(self) -> None:
        """Give the simulator back."""
        self.env.close()

    # -- the scene ---------------------------------------------------------------------------------------------

    def show(self, link: Link) -> None:
        """Build the scene of a link; a scene that cannot be is refused and the last one stays."""
        options: dict[str, Any] = {"family": link.family} if link.family else {}
        if link.family and not self.base.task.stacks:
            raise Refused(f"this world has no families of scenes, such as {link.family!r}")
        if link.layout:
            options = {"layout": [_as_item(item) for item in link.layout]}
        observation, info = self.env.reset(seed=link.seed, options=options)
        for act in link.acts:
            observation, *_, info = self.env.step(self._within_reach(act))
        self.link, self.rgb, self.info, self.picture = link, observation["rgb"], info, None

    def new_scene(self, link: Link) -> None:
        """Another scene, with no goal yet."""
        self.show(link)
        self.goal = self.before_goal = None

    def _within_reach(self, act: Sequence[float]) -> np.ndarray:
        space = cast(gym.spaces.Box, self.env.action_space)
        return np.clip(np.asarray(act, np.float32), space.low, space.high)

    def view(self) -> dict[str, Any]:
        """The scene as the page shows it."""
        seen = self.rgb if self.picture is None else self.picture
        return {
            "picture": picture_url(seen),
            "size": [seen.shape[1], seen.shape[0]],
            "own_picture": self.picture is not None,
            "link": self.link.query(),
            "seed": str(self.link.seed),
            "family": self.link.family,
            "task": self.info["instruction"],
            "sentences": self.sentences(),
            "things": [] if self.picture is not None else self._things(),
            "arranging": self.before_goal is not None,
        }

    def _things(self) -> list[dict[str, Any]]:
        camera, colors = PinholeCamera.from_info(self.info["camera"]), self.info["palette"]["colors"]
        return [
            {
                "id": number,
                "name": f"{item['color']} {item['kind']}",
                "color": [int(value) for value in colors[item["color"]]],
                "at": camera.project(item["position"]).tolist(),
            }
            for number, item in enumerate(self.info["objects"])
        ]

    def sentences(self) -> list[str]:
        """Every sentence of one step about what is there; of a person's own picture about what is seen."""
        if self.picture is None:
            named = {Thing(item["color"], item["kind"]): () for item in self.info["objects"]}
            grounding = Grounding((), (), named)
        else:
            grounding = self._grounder(self.world_model.parse(self.picture[None]))
        relations = [one.name for one in self.base.task.relations if one.name in RELATIONS]
        return [one.text for one in grounding.instructions(*relations)]

    @property
    def _grounder(self) -> AppearanceGrounder:
        return AppearanceGrounder.from_info(self.info)

    def _layout(self) -> list[list[Any]]:
        """What is there now; numbers are rounded as links have them."""
        rows = []
        for item in self.info["objects"]:
            qx, qy, qz, qw = map(float, item["orientation"])
            yaw = float(np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))
            numbers = [round(float(value), 4) for value in (*item["position"], yaw)]
            rows.append([item["kind"], item["color"], *numbers])
        return rows

    def _put_down(self, kind: str, x: float, y: float, others: Sequence[Sequence[Any]]) -> list[Any]:
        """Where a thing comes to stand that is let go at a pixel: a block over the middle of what is under it."""
        camera, sizes = PinholeCamera.from_info(self.info["camera"]), self.base.setup.sizes
        place, height = camera.unproject_to_plane((x, y), RESTING_HEIGHTS[kind])[:2], sizes.block / 2
        reach = {"bowl": sizes.bowl_floor_radius, "block": sizes.block / 2 if self.base.task.stacks else 0.0}
        for other, _, *its, z, _ in sorted(others, key=lambda row: row[4]) if kind == "block" else ():
            if np.hypot(*(place - its)) < reach[other]:
                place, height = np.array(its), (z + sizes.block if other == "block" else height)
        return [*place, height]

    def _rearrange(self, rows: Sequence[Sequence[Any]]) -> None:
        if self.picture is not None:
            raise Refused("this is your own picture, in which nothing can be moved; go back to the scene")
        self.show(Link(self.link.seed, "", tuple(tuple(row) for row in rows)))

    def move(self, thing: int, x: float, y: float) -> None:
        """Put a thing, with what it carries, down at a pixel."""
        self._check(thing)
        rows, supports = self._layout(), self.info["supports"]
        moved = {thing}
        for _ in rows:  # as high as towers can be
            moved |= {number for number, support in enumerate(supports) if support in moved}
        others = [row for number, row in enumerate(rows) if number not in moved]
        before = np.array(rows[thing][2:5])
        by = np.array(self._put_down(rows[thing][0], x, y, others)) - before
        for number in moved:
            rows[number][2:5] = [round(float(value), 4) for value in np.add(rows[number][2:5], by)]
        self._rearrange(rows)

    def remove(self, thing: int) -> None:
        """Take a thing away."""
        self._check(thing)
        self._rearrange([row for number, row in enumerate(self._layout()) if number != thing])

    def add(self, kind: str, color: str) -> None:
        """Add a thing at the first free place."""
        if kind not in RESTING_HEIGHTS or color not in COLORS:
            raise Refused(f"there are blocks and bowls in {', '.join(COLORS)}, but no {color} {kind}")
        rows, problem = self._layout(), "there is no room for it"
        for x in np.linspace(*self.base.setup.spawn.x, 8):
            for y in np.linspace(*self.base.setup.spawn.y, 8):
                new = [kind, color, round(float(x), 4), round(float(y), 4), 0.03, 0.0]
                try:
                    return self._rearrange([*rows, new])
                except ValueError as error:
                    problem = str(error)
        raise Refused(f"no {color} {kind} can be added: {problem}")

    def _check(self, thing: int) -> None:
        if not 0 <= thing < len(self.info["objects"]):
            raise Refused(f"there is no thing number {thing}")

    def upload(self, data: bytes) -> list[str]:
        """Take a picture file instead of the scene; what was done to it."""
        try:
            picture, done = read_picture(BytesIO(data), self.world_model.image_size, resize=True)
        except (OSError, ValueError) as error:  # what no picture can be read from is an OSError, too
            raise Refused(f"this is no picture that can be read: {error}") from None
        except Exception as error:  # a picture of too many pixels, or one damaged in a way of its own
            raise Refused(f"this picture cannot be taken: {error}") from None
        self.world_model.parse(picture[None])  # which warns of a foreign picture
        self.picture = picture
        return done

    # -- imagining and doing -----------------------------------------------------------------------------------

    def imagine(self, texts: Sequence[str]) -> list[dict[str, Any]]:
        """One film a sentence."""
        if not 1 <= len(texts) <= MOST_SENTENCES:
            raise Refused(f"give 1 to {MOST_SENTENCES} sentences, not {len(texts)}")
        rollout = self._imagined(texts)
        self.shown = [(rollout, None)]
        return self.films(rollout)

    def _imagined(self, texts: Sequence[str]) -> Rollout:
        seen = self.rgb if self.picture is None else self.picture
        return self.world_model.rollout(seen, list(texts), horizon=self.horizon, attention=True)

    def films(self, rollout: Rollout, real: np.ndarray | None = None) -> list[dict[str, Any]]:
        """Films with the names of their things."""
        names = _names(self._grounder(rollout.select(0)))
        words = [self.world_model.words(text) for text in rollout.texts]
        return [film_data(rollout, words[row], names, row=row, real=real) for row in range(len(rollout))]

    def do(self, text: str, more: bool = False) -> dict[str, Any]:
        """Carry a sentence out: the imagined film beside what happened, and whether the goal is reached.

        Args:
            more: whether the page shows it beside what was done before.
        """
        self._check_scene()
        if len(self.link.acts) >= MOST_ACTS:
            raise Refused(f"{MOST_ACTS} acts were carried out in this scene; take a new one")
        instruction = self._read(text)
        rollout = self._imagined([text])
        grounding = self._grounder(rollout.select(0)).with_kinds(instruction.things)
        camera = PinholeCamera.from_info(self.info["camera"])
        action = LiteralController(camera).act(rollout, grounding, instruction).to_action()
        act = tuple(round(float(value), 4) for value in action)  # as a link repeats it
        film_THW3 = [self.rgb]
        observation, *_, self.info = self.env.step(self._within_reach(act))
        film_THW3 += list(self.info["frames"])
        self.rgb = observation["rgb"]
        self.link = Link(self.link.seed, self.link.family, self.link.layout, (*self.link.acts, act))
        real = np.stack(film_THW3)
        self.shown = [*(self.shown if more else ()), (rollout, real)]
        return {"film": self.films(rollout, real)[0], **self.goal_state()}

    def save(self, path: Path) -> None:
        """What the page shows as a GIF, MP4 or PNG, or as a page of its own; acts and plans one after another."""
        if not self.shown:
            raise Refused("nothing has been imagined yet")
        if path.suffix == ".html":
            films = [film for rollout, real in self.shown for film in self.films(rollout, real)]
            save_page(path, "; ".join(film["text"] for film in films), films)
        elif path.suffix in SUFFIXES:
            frames, masks = (
                torch.cat([getattr(rollout, name) for rollout, _ in self.shown], dim=1).cpu().numpy()
                for name in ("frames", "masks")
            )
            rows = zip(*(rollout.texts for rollout, _ in self.shown), strict=True)
            texts = [", then ".join(parts) for parts in rows]
            # A real film is as long as the imagined one, so that both stay in step.
            reals = [real[: one.slots.shape[1]] for one, real in self.shown if real is not None]
            save_film(path, frames, masks, texts, beside=np.concatenate(reals) if reals else None)
        else:
            raise Refused(f"films are {', '.join(SUFFIXES)} and .html, not {path.suffix!r}")

    def _read(self, text: str) -> Instruction:
        """A sentence of any wording that the model understands."""
        try:
            return Instruction.parse(text)
        except ValueError:
            with suppress(ValueError):
                return Instruction.parse(self.world_model.reads(text))
            raise

    # -- goals and plans ---------------------------------------------------------------------------------------

    def arrange_goal(self, what: str) -> None:
        """Begin to arrange the scene as it shall be; `use` that as the goal, or `cancel`: both bring the scene back."""
        if what == "begin":
            self._check_scene()
            self.before_goal = self.link
            self._rearrange(self._layout())  # which stands still as it is after acts
            return
        if self.before_goal is None:
            raise Refused("no goal is being arranged")
        if what == "use":
            self.goal, self.goal_supports = PictureGoal(self.rgb), tuple(self.info["supports"])
        before, self.before_goal = self.before_goal, None
        self.show(before)

    def goal_state(self) -> dict[str, Any]:
        """Whether the goal is seen to be reached, and whether the simulator says so; nothing without a goal."""
        if self.goal is None:
            return {}
        true = False
        with suppress(ValueError):  # what the goal names may have been taken away
            true = self._is_reached(self.goal)
        return {"reached": {"seen": self._planner.reached(self.rgb, self.goal, self._grounder), "true": true}}

    def _is_reached(self, goal: Goal | PictureGoal) -> bool:
        """The environment's own verdict; a ValueError for a goal that cannot be one here."""
        if isinstance(goal, PictureGoal):
            return tuple(self.info["supports"]) == self.goal_supports
        task, objects = self.base.task, self.base.scene.objects
        asked = task.parse("put " + " and ".join(one.text.removeprefix("put ") for one in goal.instructions))
        scene = task.scene(objects, task.find_goal(objects, asked))
        return task.succeeded(self.base.world, self.base.robot, scene)

    @property
    def _planner(self) -> SearchPlanner:
        return SearchPlanner(cast(Foresees, self.world_model))

    def plan(self, text: str) -> dict[str, Any]:
        """Search for the goal of a sentence, or for the one that was arranged where there is no sentence."""
        self._check_scene()
        goal = Goal.parse(text) if text.strip() else self.goal
        if goal is None:
            raise Refused("say what the goal is, or arrange it")
        if not self.world_model.foresees:
            raise Refused(
                f"the checkpoint {self.world_model.checkpoint.name} cannot foresee where sentences lead, which a "
                "plan is made of; tabletop-small can"
            )
        self._is_reached(goal)
        self.goal = goal
        state = self.goal_state()
        if state["reached"]["seen"]:
            return {"done": True, **state}
        plan = self._planner.plan(self.rgb, goal, self._grounder)
        self.shown = [(one, None) for one in plan.rollouts]
        names = _names(plan.grounding)
        films = [film_data(one, (), names) for one in plan.rollouts]
        return {"done": False, "films": films, **plan_data(self.world_model, self.rgb, goal, plan)}

    def _check_scene(self) -> None:
        if self.picture is not None:
            raise Refused("this is your own picture, with no robot behind it; go back to the scene for that")
        if self.before_goal is not None:
            raise Refused("a goal is being arranged: say that this is the goal, or cancel")


def _names(grounding: Grounding) -> dict[int, str]:
    things = {slot: str(thing) for thing, slots in grounding.things.items() for slot in slots}
    return things | {slot: "arm" for slot in grounding.arm}


def _as_item(item: Sequence[Any]) -> dict[str, Any]:
    kind, color, x, y, z, yaw = item
    turned = (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
    return {"kind": kind, "color": color, "position": (x, y, z), "orientation": turned}
