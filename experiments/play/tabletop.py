"""The tabletops: blocks and bowls that a person moves, and a robot that carries sentences out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np

from envs.colors import COLORS
from envs.tabletop import TabletopEnv
from envs.tasks.rearrange import FAMILIES
from experiments.play.links import MOST_ACTS, Link, Refused
from planning import (
    RELATIONS,
    AppearanceGrounder,
    Goal,
    Grounding,
    Instruction,
    LiteralController,
    PinholeCamera,
    SegmentationGrounder,
    Thing,
)
from planning.controller import RESTING_HEIGHTS
from planning.planners import HORIZON
from textocvp import Rollout

Row = Sequence[Any]  # of a layout: kind, colour, x, y, z and yaw


class Tabletop:
    """A `World` whose scene a person arranges, and for which plans can be made."""

    def __init__(self, env_id: str, image_size: int, **options: Any) -> None:
        # The robot of the simple scene needs 24 frames, that of others about 50.
        self.horizon = None if "scene" in options else HORIZON
        options |= {"image_size": image_size, "max_steps": 10**6}
        self.env = gym.make(env_id, control="primitive", record_frames=True, **options)
        self.base = cast(TabletopEnv, self.env.unwrapped)
        self.families = list(FAMILIES) if self.base.task.stacks else []
        self.relations = [one.name for one in self.base.task.relations if one.name in RELATIONS]
        self.link = Link()

    def close(self) -> None:
        """Give the simulator back."""
        self.env.close()

    def show(self, link: Link) -> None:
        """Build the scene of a link; a scene that cannot be is refused and the last one stays."""
        options: dict[str, Any] = {"family": link.family} if link.family else {}
        if link.family and not self.families:
            raise Refused(f"this world has no families of scenes, such as {link.family!r}")
        if link.layout:
            options = {"layout": [_as_item(row) for row in link.layout]}
        observation, info = self.env.reset(seed=link.seed, options=options)
        for act in link.acts:
            observation, *_, info = self.env.step(self._within_reach(act))
        self.link, self.rgb, self.info = link, observation["rgb"], info
        self.task = info["instruction"] if info["instruction"].startswith("put ") else ""

    def _within_reach(self, act: Sequence[float]) -> np.ndarray:
        space = cast(gym.spaces.Box, self.env.action_space)
        return np.clip(np.asarray(act, float), space.low, space.high).astype(np.float32)

    # -- what is seen and said ---------------------------------------------------------------------------------

    @property
    def supports(self) -> dict[str, str]:
        """What carries each thing, by name: things that were taken away and added again have other numbers."""
        names = [str(_thing(item)) for item in self.info["objects"]]
        known = {-1: "table", -2: ""} | dict(enumerate(names))
        return dict(zip(names, (known[carrier] for carrier in self.info["supports"]), strict=True))

    @property
    def camera(self) -> PinholeCamera:
        """That the scene is seen through."""
        return PinholeCamera.from_info(self.info["camera"])

    @property
    def grounder(self) -> AppearanceGrounder:
        """Which goes by how slots look."""
        return AppearanceGrounder.from_info(self.info)

    def things(self) -> list[dict[str, Any]]:
        """What is there, and where in the picture."""
        camera, colors = self.camera, self.info["palette"]["colors"]
        return [
            {
                "name": str(_thing(item)),
                "color": [int(value) for value in colors[item["color"]]],
                "at": camera.project(item["position"]).tolist(),
                "height": float(item["position"][2]),
            }
            for item in self.info["objects"]
        ]

    def sentences(self, picture: Rollout | None) -> list[str]:
        """Every sentence of one step about what is there, or about what is seen in a person's own picture."""
        if picture is None:
            named = {_thing(item): () for item in self.info["objects"]}
            grounding = Grounding((), (), named)
        else:
            grounding = self.grounder(picture)
        return [one.text for one in grounding.instructions(*self.relations)]

    def names(self, rollout: Rollout, own_picture: bool) -> dict[int, str]:
        """By how slots look in a person's own picture, and in the scene by what they really show."""
        grounder = self.grounder if own_picture else SegmentationGrounder.from_info(self.info)
        return slot_names(grounder(rollout))

    # -- what is done ------------------------------------------------------------------------------------------

    def read(self, text: str) -> Instruction:
        """What a sentence asks for."""
        if len(self.link.acts) >= MOST_ACTS:
            raise Refused(f"{MOST_ACTS} acts were carried out in this scene; take a new one")
        wish = Instruction.parse(text)
        if wish.relation not in self.relations:
            raise Refused(f"in this world nothing is put {wish.relation} a {wish.target.kind}: {wish.text!r}")
        return wish

    def act(self, wish: Instruction, rollout: Rollout) -> np.ndarray:
        """Pick and place as the sentence says, what it names found by how it looks."""
        grounding = self.grounder(rollout).with_kinds(wish.things)
        action = LiteralController(self.camera).act(rollout, grounding, wish).to_action()
        act = tuple(round(float(value), 4) for value in action)  # as a link repeats it
        before = self.rgb
        observation, *_, self.info = self.env.step(self._within_reach(act))
        self.rgb = observation["rgb"]
        self.link = Link(self.link.seed, self.link.family, self.link.layout, (*self.link.acts, act))
        return np.stack([before, *self.info["frames"]])

    def is_reached(self, goal: Goal) -> bool:
        """The environment's own verdict; a ValueError for a goal that cannot be one here."""
        task, objects = self.base.task, self.base.scene.objects
        asked = task.parse("put " + " and ".join(one.text.removeprefix("put ") for one in goal.instructions))
        scene = task.scene(objects, task.find_goal(objects, asked))
        return task.succeeded(self.base.world, self.base.robot, scene)

    # -- arranging ---------------------------------------------------------------------------------------------

    def layout(self) -> list[list[Any]]:
        """What is there now; numbers are rounded as links have them."""
        rows = []
        for item in self.info["objects"]:
            qx, qy, qz, qw = map(float, item["orientation"])
            yaw = float(np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))
            numbers = [round(float(value), 4) for value in (*item["position"], yaw)]
            rows.append([item["kind"], item["color"], *numbers])
        return rows

    def arrange(self, rows: Sequence[Row]) -> None:
        """Build another scene of these things; one that cannot be is refused and the last one stays."""
        self.show(Link(self.link.seed, "", tuple(tuple(row) for row in rows)))

    def move(self, thing: int, x: float, y: float) -> None:
        """Put a thing, with what it carries, down at a pixel."""
        self._check(thing)
        rows, supports = self.layout(), self.info["supports"]
        moved = {thing}
        for _ in rows:  # as high as towers can be
            moved |= {number for number, support in enumerate(supports) if support in moved}
        others = [row for number, row in enumerate(rows) if number not in moved]
        by = np.subtract(self._put_down(rows[thing][0], x, y, others), rows[thing][2:5])
        for number in moved:
            rows[number][2:5] = [round(float(value), 4) for value in np.add(rows[number][2:5], by)]
        self.arrange(rows)

    def _put_down(self, kind: str, x: float, y: float, others: Sequence[Row]) -> list[float]:
        """Where a thing comes to stand that is let go at a pixel: a block over the middle of what is under it."""
        sizes = self.base.setup.sizes
        place, height = self.camera.unproject_to_plane((x, y), RESTING_HEIGHTS[kind])[:2], sizes.block / 2
        reach = {"bowl": sizes.bowl_floor_radius, "block": sizes.block / 2 if self.base.task.stacks else 0.0}
        for other, _, *its, z, _ in sorted(others, key=lambda row: row[4]) if kind == "block" else ():
            if np.hypot(*(place - its)) < reach[other]:
                place, height = np.array(its), (z + sizes.block if other == "block" else height)
        return [*place, height]

    def remove(self, thing: int) -> None:
        """Take a thing away."""
        self._check(thing)
        self.arrange([row for number, row in enumerate(self.layout()) if number != thing])

    def add(self, kind: str, color: str) -> None:
        """Add a thing at the first free place."""
        if kind not in RESTING_HEIGHTS or color not in COLORS:
            raise Refused(f"there are blocks and bowls in {', '.join(COLORS)}, but no {color} {kind}")
        rows, problem = self.layout(), "there is no room for it"
        for x in np.linspace(*self.base.setup.spawn.x, 8):
            for y in np.linspace(*self.base.setup.spawn.y, 8):
                new = [kind, color, round(float(x), 4), round(float(y), 4), 0.03, 0.0]
                try:
                    return self.arrange([*rows, new])
                except ValueError as error:
                    problem = str(error)
        raise Refused(f"no {color} {kind} can be added: {problem}")

    def _check(self, thing: int) -> None:
        if not 0 <= thing < len(self.info["objects"]):
            raise Refused(f"there is no thing number {thing}")


def slot_names(grounding: Grounding) -> dict[int, str]:
    """What grounded slots are called."""
    things = {slot: str(thing) for thing, slots in grounding.things.items() for slot in slots}
    return things | {slot: "arm" for slot in grounding.arm}


def _thing(item: Mapping[str, Any]) -> Thing:
    """What language calls one of `info["objects"]`."""
    return Thing(item["color"], item["kind"])


def _as_item(row: Row) -> dict[str, Any]:
    kind, color, x, y, z, yaw = row
    turned = (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
    return {"kind": kind, "color": color, "position": (x, y, z), "orientation": turned}
