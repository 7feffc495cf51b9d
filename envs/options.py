"""``reset(options=...)`` and fixed lists of scenes, checked as a whole before anything changes."""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .checks import check_choice, check_range
from .colors import CAPTION_COLORS
from .factors import read_factors
from .geometry import Point, Sizes
from .physics.arm import Arm, Joints
from .sampling import SceneRequest, arm_jitter
from .scene import Instruction, ObjectSpec, Scene, read_layout
from .scenes import Setup
from .tasks.base import Task

_WITH_LAYOUT = ("color_split", "goal_layout")  # options of random scenes that a layout may have too
_OF_GOAL = ("family", "goal_layout")
CARRIED_MARGIN = 0.1  # how far inside the spawn area a carried block starts, so that the arm reaches it

OPTIONS = ("layout", "instruction", "arm_start", "factors")  # of every task, which adds its `scene_options`

Scenes = Sequence[int | Mapping[str, Any]] | str | os.PathLike[str]  # as users give a list of scenes


@dataclass(frozen=True)
class ResetOptions:
    """A checked `options` argument. `request` describes the random scene where `layout` is None."""

    task: Task
    layout: tuple[ObjectSpec, ...] | None
    scene: Scene | None  # where the layout and its goal are both given
    arm_start: str | Joints
    request: SceneRequest
    setup: Setup
    factors: dict[str, Any] | None  # values to use instead of random ones

    def draw(self, rng: np.random.Generator) -> tuple[Setup, dict[str, Any], Scene, Joints]:
        """What to build: the setup, the values of its factors, the scene, and the arm's joint angles."""
        task, layout, request, factors = self.task, self.layout, self.request, self.setup.factors
        drawn = factors.draw(rng) if self.factors is None else self.factors
        if layout is not None and self.factors is None:  # the layout was checked with the usual sizes
            drawn = {name: value for name, value in drawn.items() if name not in ("block", "bowl")}
        setup = self.setup.with_factors(drawn)
        if layout is None:
            scene = task.sample(rng, request, setup.sizes)
            if not task.stacks:  # such tasks fill bowls and stack blocks themselves
                scene = factors.rearrange(rng, scene, setup.sizes, setup.spawn.shrunk(CARRIED_MARGIN))
        elif self.scene is not None:
            scene = self.scene
        else:
            goal = task.draw_goal(rng, layout, request.color_split, len(request.named) // 2)
            scene = task.scene(layout, goal)
        joints = setup.arm.home_joints if isinstance(self.arm_start, str) else self.arm_start
        if self.arm_start == "random":
            joints = tuple(np.add(joints, arm_jitter(rng)).tolist())
        if scene.held >= 0:
            joints = setup.arm.inverse(_holding_tip(scene.objects[scene.held], setup.sizes), 0.0)
        return setup, drawn, scene, joints


def _holding_tip(item: ObjectSpec, sizes: Sizes) -> Point:
    """Where the tip holds a block."""
    return item.x, item.y, (item.height or 0.0) + sizes.block / 2


def override(given: Mapping[str, Any], options: Any, task: Task) -> Any:
    """``options`` over those ``given`` before; a layout replaces the description of a random scene."""
    if not isinstance(options or {}, Mapping):
        return options  # for `read_options` to refuse
    options = options or {}
    if options.get("layout") is not None:
        random = set(task.scene_options) - set(_WITH_LAYOUT)
        given = {name: value for name, value in given.items() if name not in random}
    return {**given, **options}


def read_seed(seed: Any) -> int:
    """A seed as a Python int; ValueError for what is no whole number of at least 0."""
    check_range("seed", seed, 0, None, whole=True)
    return int(seed)


def read_scenes(scenes: Scenes) -> tuple[tuple[int, dict[str, Any]], ...]:
    """Seed and reset options of each scene of a list, or of a JSON file with one.

    A scene is a seed, or a mapping of reset options and `seed`, which is the scene's place in the list by default.

    Raises:
        ValueError: when it is no such list; the options are for `read_options` to check.
    """
    if isinstance(scenes, str | os.PathLike):
        path = Path(scenes)
        try:
            scenes = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{path} is not a JSON file with a list of scenes: {error}") from None
    if not isinstance(scenes, Sequence) or isinstance(scenes, str) or not scenes:
        raise ValueError(f"scenes must be a list of at least one seed or mapping of reset options, not {scenes!r}")
    found = []
    for number, scene in enumerate(scenes):
        options = dict(scene) if isinstance(scene, Mapping) else {"seed": scene}
        try:
            found.append((read_seed(options.pop("seed", number)), options))
        except ValueError as error:
            raise ValueError(f"scene {number} of scenes: {error}") from None
    return tuple(found)


def read_options(options: Mapping[str, Any] | None, task: Task, defaults: SceneRequest, setup: Setup) -> ResetOptions:
    """Check `options`; what is not given comes from ``defaults``.

    Raises:
        ValueError: for an unknown option, a value that is not allowed, or options that contradict each other.
    """
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a mapping, not {type(options).__name__}")
    allowed = (*OPTIONS, *task.scene_options)
    if unknown := ", ".join(map(repr, sorted(set(options) - set(allowed), key=str))):
        raise ValueError(f"unknown reset option {unknown}; allowed: {', '.join(allowed)}")
    factors = read_factors(options["factors"]) if options.get("factors") is not None else None
    sizes = setup.with_factors(factors or {}).sizes
    layout = picture = None
    if options.get("layout") is not None:
        layout = _read_layout(options["layout"], task, setup, sizes)
        for item in layout:
            tip = _holding_tip(item, sizes)
            if item.height is not None and setup.arm.within_reach(tip) != tip:
                raise ValueError(f"the arm cannot hold the {item.thing} at {tip[:2]}, {item.height} m high")
    steps = task.parse(options["instruction"]) if options.get("instruction") is not None else None
    if options.get("goal_layout") is not None:
        if layout is None or steps is not None:
            raise ValueError("a goal_layout needs a layout, and stands instead of an instruction")
        picture = _read_layout(options["goal_layout"], task, setup, sizes)
    if layout is not None:
        clash = [name for name in task.scene_options if name in options and name not in _WITH_LAYOUT]
        if clash:
            raise ValueError(f"{', '.join(clash)} describe a random scene and cannot be given with a layout")
        there = {item.kind for item in layout}
        missing = [kind for relation in task.relations for kind in relation.kinds if kind not in there]
        if missing:
            raise ValueError(f"a layout has at least one {missing[0]}")
    request = _read_request(options, task, defaults, steps if layout is None else None)
    scene = None
    if layout is not None and picture is not None:
        scene = task.picture_scene(layout, picture)
    elif layout is not None and steps is not None:
        scene = task.scene(layout, task.find_goal(layout, steps))
    elif layout is not None and not task.open_pairs(layout, request.color_split):
        raise ValueError(
            f"no instruction with colours {', '.join(CAPTION_COLORS[request.color_split])} "
            f"has anything to do in this layout; give an 'instruction', or another 'color_split'"
        )
    task.check_instructions(steps or ())
    if scene is not None:
        task.check_scene(scene)
    arm_start = _read_arm_start(options.get("arm_start", "home"), setup.arm)
    return ResetOptions(task, layout, scene, arm_start, request, setup, factors)


def _read_layout(items: Any, task: Task, setup: Setup, sizes: Sizes) -> tuple[ObjectSpec, ...]:
    return read_layout(items, sizes, setup.workspace, setup.crowded and not task.stacks, task.stacks)


def _read_request(
    options: Mapping[str, Any], task: Task, defaults: SceneRequest, steps: tuple[Instruction, ...] | None
) -> SceneRequest:
    """What a random scene must be like, with what ``steps`` name."""
    given = {name: options[name] for name in task.scene_options if name in options and name not in _OF_GOAL}
    check_choice("color_split", given.get("color_split", "all"), CAPTION_COLORS, form=str)
    for name in ("n_objects", "n_bowls", "blocks_in_bowls"):
        check_range(name, given.get(name, 0), 0, None, whole=True)
    if not isinstance(given.get("target_in_bowl", False), bool | np.bool_):
        raise ValueError(f"target_in_bowl must be True or False, not {given['target_in_bowl']!r}")
    if options.get("family") is not None:
        defaults = task.with_family(defaults, options["family"])
    elif task.stacks and "n_bowls" in given:
        raise ValueError("n_bowls needs a family, which says how many are possible")
    if task.stacks and steps is not None:
        raise ValueError("an instruction needs a layout here: a random scene's family says what its goal is")
    if steps is not None:
        named = [thing for step in steps for thing in step.things]
        if len({thing.color for thing in named}) < len(named):
            raise ValueError(
                "no two objects of a random scene share a colour, so its instruction must not name a colour twice"
            )
        given |= {"instructions": steps, "named": tuple(thing.kind for thing in named)}
    return replace(defaults, **given)


def _read_arm_start(value: Any, arm: Arm) -> str | Joints:
    if isinstance(value, str) and value in ("home", "random"):
        return value
    with suppress(TypeError, ValueError):
        angles = np.asarray(value, dtype=float)
        if angles.shape == (6,) and np.isfinite(angles).all():
            joints: Joints = tuple(angles.tolist())
            tip, _ = arm.forward(joints)
            upright = abs(sum(joints[1:4])) < 1e-3 and abs(joints[4]) < 1e-3
            if upright and max(map(abs, np.subtract(arm.within_reach(tip), tip))) < 1e-9:
                return joints
    raise ValueError(
        f"arm_start must be 'home', 'random' or 6 finite joint angles in radians with the tool upright "
        f"(lift + elbow + wrist1 = 0, wrist2 = 0) and its tip between {arm.reach_low} and {arm.reach_high} m; "
        f"got {value!r}"
    )
