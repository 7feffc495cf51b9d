"""``reset(options=...)``, checked as a whole before anything changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from envs.colors import CAPTION_COLORS
from envs.factors import read_factors
from envs.physics.arm import Arm, Joints
from envs.sampling import SceneRequest, arm_jitter
from envs.scene import GoalPair, Instruction, ObjectSpec, Scene, read_layout
from envs.scenes import Setup
from envs.tasks.base import Task

CARRIED_MARGIN = 0.1
"""A block that is carried at the start is this far inside the spawn area, so that the arm reaches it."""

RANDOM_SCENE_OPTIONS = ("n_objects", "n_bowls", "color_split", "blocks_in_bowls", "target_in_bowl")
OPTIONS = ("layout", "instruction", "arm_start", "factors", *RANDOM_SCENE_OPTIONS)


@dataclass(frozen=True)
class ResetOptions:
    """A checked `options` argument. `request` describes the random scene where `layout` is None."""

    task: Task
    layout: tuple[ObjectSpec, ...] | None
    goal: tuple[GoalPair, ...] | None
    """What the instruction asks for, where layout and instruction are both given."""
    arm_start: str | Joints
    request: SceneRequest
    setup: Setup
    factors: dict[str, Any] | None
    """Values to use instead of random ones."""

    def draw(self, rng: np.random.Generator) -> tuple[Setup, dict[str, Any], Scene, Joints]:
        """What to build: the setup, the values of its factors, the scene, and the arm's joint angles."""
        task, layout, request = self.task, self.layout, self.request
        factors = self.setup.factors
        drawn = factors.draw(rng) if self.factors is None else self.factors
        if layout is not None and self.factors is None:  # the layout was checked with the usual sizes
            drawn = {name: value for name, value in drawn.items() if name not in ("block", "bowl")}
        setup = self.setup.with_factors(drawn)
        if layout is None:
            scene = task.sample(rng, request, setup.sizes)
            scene = factors.rearrange(rng, scene, setup.sizes, setup.spawn.shrunk(CARRIED_MARGIN))
        else:
            scene = task.scene(
                layout, self.goal or task.draw_goal(rng, layout, request.color_split, request.n_pairs)
            )
        start = setup.arm.home_joints if isinstance(self.arm_start, str) else self.arm_start
        offsets = arm_jitter(rng) if self.arm_start == "random" else (0.0,) * 6
        joints = tuple(angle + offset for angle, offset in zip(start, offsets, strict=True))
        if scene.held >= 0:
            item = scene.objects[scene.held]
            tip = (item.x, item.y, (item.height or 0.0) + setup.sizes.block / 2)
            joints = setup.arm.inverse(tip, 0.0)
        return setup, drawn, scene, joints  # type: ignore[return-value]


def read_options(
    options: Mapping[str, Any] | None, task: Task, defaults: SceneRequest, setup: Setup
) -> ResetOptions:
    """Check `options`; what is not given comes from ``defaults``.

    Raises:
        ValueError: for an unknown option, a value that is not allowed, or options that contradict each other.
            The message says what is allowed.
    """
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a mapping, not {type(options).__name__}")
    unknown = sorted(set(options) - set(OPTIONS))
    if unknown:
        raise ValueError(
            f"unknown reset option {', '.join(map(repr, unknown))}; allowed: {', '.join(OPTIONS)}"
        )
    factors = read_factors(options["factors"]) if options.get("factors") is not None else None
    layout = None
    if options.get("layout") is not None:
        sizes = setup.with_factors(factors or {}).sizes
        layout = read_layout(options["layout"], sizes, setup.workspace, setup.crowded)
        for item in layout:
            tip = (item.x, item.y, (item.height or 0.0) + sizes.block / 2)
            if item.height is not None and setup.arm.within_reach(tip) != tip:
                raise ValueError(f"the arm cannot hold the {item.thing} at {tip[:2]}, {item.height} m high")
    steps = task.parse(options["instruction"]) if options.get("instruction") is not None else None
    if layout is not None:
        clash = [name for name in RANDOM_SCENE_OPTIONS if name in options and name != "color_split"]
        if clash:
            raise ValueError(f"{', '.join(clash)} describe a random scene and cannot be given with a layout")
        there = {item.kind for item in layout}
        missing = [kind for relation in task.relations for kind in relation.kinds if kind not in there]
        if missing:
            raise ValueError(f"a layout has at least one {missing[0]}")
    request = _read_request(options, defaults, steps, layout is not None)
    goal = None
    if layout is not None and steps is not None:
        goal = task.find_goal(layout, steps)
        if all(task.relation(pair).fulfilled_at_start(layout, pair.thing, pair.target) for pair in goal):
            raise ValueError("the layout already fulfils the instruction; ask for something else")
    elif layout is not None and not task.open_pairs(layout, request.color_split):
        raise ValueError(
            f"no instruction with colours {', '.join(CAPTION_COLORS[request.color_split])} "
            f"has anything to do in this layout; give an 'instruction', or another 'color_split'"
        )
    task.check_instructions(steps or ())
    arm_start = _read_arm_start(options.get("arm_start", "home"), setup.arm)
    return ResetOptions(task, layout, goal, arm_start, request, setup, factors)


def _read_request(
    options: Mapping[str, Any],
    defaults: SceneRequest,
    steps: tuple[Instruction, ...] | None,
    has_layout: bool,
) -> SceneRequest:
    split = options.get("color_split", defaults.color_split)
    if split not in CAPTION_COLORS:
        raise ValueError(f"unknown color_split {split!r}; allowed: {', '.join(CAPTION_COLORS)}")
    given: dict[str, Any] = {"color_split": split}
    for name in ("n_objects", "n_bowls", "blocks_in_bowls"):
        value = options.get(name, getattr(defaults, name))
        if name in options and (
            isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0
        ):
            raise ValueError(f"{name} must be a whole number of at least 0, not {value!r}")
        given[name] = value
    given["target_in_bowl"] = options.get("target_in_bowl", defaults.target_in_bowl)
    if not isinstance(given["target_in_bowl"], bool | np.bool_):
        raise ValueError(f"target_in_bowl must be True or False, not {given['target_in_bowl']!r}")
    if steps is not None and not has_layout:
        named = [thing for step in steps for thing in step.things]
        if len({thing.color for thing in named}) < len(named):
            raise ValueError(
                "no two objects of a random scene share a colour, so its instruction must not "
                "name a colour twice"
            )
        given |= {"instructions": steps, "named": tuple(thing.kind for thing in named)}
    return replace(defaults, **given)


def _read_arm_start(value: Any, arm: Arm) -> str | Joints:
    if isinstance(value, str):
        if value in ("home", "random"):
            return value
    else:
        try:
            angles = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            angles = np.empty(0)
        if angles.shape == (6,) and np.isfinite(angles).all():
            joints: Joints = tuple(angles.tolist())
            tip, _ = arm.forward(joints)
            upright = abs(sum(joints[1:4])) < 1e-3 and abs(joints[4]) < 1e-3
            within = max(map(abs, np.subtract(arm.within_reach(tip), tip))) < 1e-9
            if upright and within:
                return joints
    raise ValueError(
        f"arm_start must be 'home', 'random' or 6 finite joint angles in radians with the tool upright "
        f"(lift + elbow + wrist1 = 0, wrist2 = 0) and its tip between {arm.reach_low} and {arm.reach_high} m; "
        f"got {value!r}"
    )
