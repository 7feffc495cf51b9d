"""``reset(options=...)``, checked as a whole before anything changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from envs.arm import Joints, forward_kinematics
from envs.colors import CAPTION_COLORS
from envs.geometry import Sizes
from envs.language import ColorPair, parse_instruction
from envs.robot import HOME_JOINTS, REACH_HIGH, REACH_LOW
from envs.sampling import SceneRequest, jitter_arm, sample_scene
from envs.scene import ObjectSpec, Scene, find_goal, read_layout

RANDOM_SCENE_OPTIONS = ("n_objects", "n_bowls", "color_split", "blocks_in_bowls", "target_in_bowl")
OPTIONS = ("layout", "instruction", "arm_start", *RANDOM_SCENE_OPTIONS)


@dataclass(frozen=True)
class ResetOptions:
    """A checked `options` argument. `request` describes the random scene where `layout` is None."""

    layout: tuple[ObjectSpec, ...] | None
    wishes: tuple[ColorPair, ...] | None
    arm_start: str | Joints
    request: SceneRequest
    goal: tuple[tuple[int, int], ...] | None
    """(block id, bowl id) pairs, where layout and instruction are both given."""

    def draw(self, rng: np.random.Generator, sizes: Sizes) -> tuple[Scene, Joints]:
        """The scene to build, and the joint angles the arm starts at."""
        if self.layout is None:
            scene = sample_scene(rng, self.request, sizes)
        else:
            scene = Scene(self.layout, self.goal or _draw_goal(rng, self.layout, self.request))
        if self.arm_start == "random":
            scene = jitter_arm(rng, scene)
        start = HOME_JOINTS if isinstance(self.arm_start, str) else self.arm_start
        joints = tuple(angle + offset for angle, offset in zip(start, scene.arm_offset, strict=True))
        return scene, joints  # type: ignore[return-value]


def read_options(options: Mapping[str, Any] | None, defaults: SceneRequest, sizes: Sizes) -> ResetOptions:
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
    wishes = parse_instruction(options["instruction"]) if options.get("instruction") is not None else None
    if layout is not None:
        clash = [name for name in RANDOM_SCENE_OPTIONS if name in options and name != "color_split"]
        if clash:
            raise ValueError(f"{', '.join(clash)} describe a random scene and cannot be given with a layout")
    request = _read_request(options, defaults, wishes, layout is not None)
    goal = None
    if layout is not None:
        goal = find_goal(layout, wishes) if wishes is not None else None
        if goal is None and not _possible_pairs(layout, request):
            raise ValueError(
                f"no instruction with colours {', '.join(CAPTION_COLORS[request.color_split])} "
                f"has anything to do in this layout; give an 'instruction', or another 'color_split'"
            )
        if goal is not None and all(layout[block].inside == bowl for block, bowl in goal):
            raise ValueError("the layout already fulfils the instruction; name another bowl")
    if wishes is not None and len({wish.bowl for wish in wishes}) < len(wishes):
        raise ValueError("an instruction must not name a bowl twice: a bowl has room for one block")
    return ResetOptions(layout, wishes, _read_arm_start(options.get("arm_start", "home")), request, goal)


def _read_request(
    options: Mapping[str, Any], defaults: SceneRequest, wishes: tuple[ColorPair, ...] | None, has_layout: bool
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
    if wishes is not None and not has_layout:
        named = [color for wish in wishes for color in wish]
        if len(set(named)) < len(named):
            raise ValueError(
                "no two objects of a random scene share a colour, so its instruction must not "
                "name a colour twice"
            )
        given |= {"wishes": wishes, "n_pairs": len(wishes)}
    return replace(defaults, **given)


def _possible_pairs(layout: tuple[ObjectSpec, ...], request: SceneRequest) -> list[tuple[int, int]]:
    """(block id, bowl id) pairs that are not fulfilled yet and may be named."""
    colors = CAPTION_COLORS[request.color_split]
    nameable = [index for index, item in enumerate(layout) if item.color in colors]
    taken = {item.inside: index for index, item in enumerate(layout) if item.inside is not None}
    return [
        (block, bowl)
        for block in nameable
        for bowl in nameable
        if layout[block].kind == "block" and layout[bowl].kind == "bowl" and bowl not in taken
    ]


def _draw_goal(
    rng: np.random.Generator, layout: tuple[ObjectSpec, ...], request: SceneRequest
) -> tuple[tuple[int, int], ...]:
    goal: list[tuple[int, int]] = []
    pairs = _possible_pairs(layout, request)
    while pairs and len(goal) < request.n_pairs:
        goal.append(pairs[int(rng.integers(len(pairs)))])
        pairs = [pair for pair in pairs if pair[0] != goal[-1][0] and pair[1] != goal[-1][1]]
    return tuple(goal)


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
