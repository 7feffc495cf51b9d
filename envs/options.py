"""``reset(options=...)``, checked as a whole before anything changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from envs.colors import CAPTION_COLORS
from envs.geometry import Sizes
from envs.physics.arm import Joints, forward_kinematics
from envs.physics.robot import HOME_JOINTS, REACH_HIGH, REACH_LOW
from envs.sampling import SceneRequest, arm_jitter
from envs.scene import GoalPair, Instruction, ObjectSpec, Scene, read_layout
from envs.tasks.base import Task

RANDOM_SCENE_OPTIONS = ("n_objects", "n_bowls", "color_split", "blocks_in_bowls", "target_in_bowl")
OPTIONS = ("layout", "instruction", "arm_start", *RANDOM_SCENE_OPTIONS)


@dataclass(frozen=True)
class ResetOptions:
    """A checked `options` argument. `request` describes the random scene where `layout` is None."""

    task: Task
    layout: tuple[ObjectSpec, ...] | None
    goal: tuple[GoalPair, ...] | None
    """What the instruction asks for, where layout and instruction are both given."""
    arm_start: str | Joints
    request: SceneRequest

    def draw(self, rng: np.random.Generator, sizes: Sizes) -> tuple[Scene, Joints]:
        """The scene to build, and the joint angles the arm starts at."""
        task, layout, request = self.task, self.layout, self.request
        if layout is None:
            scene = task.sample(rng, request, sizes)
        else:
            scene = task.scene(
                layout, self.goal or task.draw_goal(rng, layout, request.color_split, request.n_pairs)
            )
        start = HOME_JOINTS if isinstance(self.arm_start, str) else self.arm_start
        offsets = arm_jitter(rng) if self.arm_start == "random" else (0.0,) * 6
        joints = tuple(angle + offset for angle, offset in zip(start, offsets, strict=True))
        return scene, joints  # type: ignore[return-value]


def read_options(
    options: Mapping[str, Any] | None, task: Task, defaults: SceneRequest, sizes: Sizes
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
    layout = read_layout(options["layout"], sizes) if options.get("layout") is not None else None
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
    return ResetOptions(task, layout, goal, _read_arm_start(options.get("arm_start", "home")), request)


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


def _read_arm_start(value: Any) -> str | Joints:
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
            tip, _ = forward_kinematics(joints)
            upright = abs(sum(joints[1:4])) < 1e-3 and abs(joints[4]) < 1e-3
            within = all(low <= at <= high for low, at, high in zip(REACH_LOW, tip, REACH_HIGH, strict=True))
            if upright and within:
                return joints
    raise ValueError(
        f"arm_start must be 'home', 'random' or 6 finite joint angles in radians with the tool upright "
        f"(lift + elbow + wrist1 = 0, wrist2 = 0) and its tip between {REACH_LOW} and {REACH_HIGH} m; "
        f"got {value!r}"
    )
