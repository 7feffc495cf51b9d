"""What a scene is and what may be asked of it: plain values, no physics, no task."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import hypot
from typing import Any, NamedTuple

import numpy as np

from envs.colors import COLORS
from envs.geometry import Box2, Sizes

KINDS = ("block", "bowl")
MAX_OBJECTS = 8
"""As many objects as fit side by side into the workspace, each visible."""


HELD_HEIGHT = 2.5
"""A block whose centre is higher than this many blocks hangs at the arm: no two blocks reach so high."""


class Thing(NamedTuple):
    """An object as a sentence names it."""

    color: str
    kind: str

    def __str__(self) -> str:
        return f"{self.color} {self.kind}"


class Instruction(NamedTuple):
    """One step of a sentence: a thing shall have a relation ("in", ...) to a target."""

    relation: str
    thing: Thing
    target: Thing

    @property
    def things(self) -> tuple[Thing, Thing]:
        return self.thing, self.target

    def __str__(self) -> str:
        return f"the {self.thing} {self.relation} the {self.target}"


class GoalPair(NamedTuple):
    """An instruction in a scene: the ids of the object that shall move and of that at which it shall end."""

    relation: str
    thing: int
    target: int


@dataclass(frozen=True)
class ObjectSpec:
    """One object of a layout. ``inside`` is the id of the bowl that a block lies in; ids count from 0."""

    kind: str
    color: str
    x: float
    y: float
    yaw: float = 0.0
    inside: int | None = None
    on: int | None = None
    """The id of the block that a block stands on."""
    height: float | None = None
    """Of a block's centre (metres), if the arm holds it."""

    @property
    def thing(self) -> Thing:
        return Thing(self.color, self.kind)

    @property
    def stands(self) -> bool:
        """Whether it stands on the table itself."""
        return self.inside is None and self.on is None and self.height is None


@dataclass(frozen=True)
class Scene:
    """A scene to build."""

    objects: tuple[ObjectSpec, ...]
    goal: tuple[GoalPair, ...]
    instruction: str
    """The sentence that asks for the goal."""

    @property
    def held(self) -> int:
        """The id of the block that the arm holds, or -1."""
        return next((index for index, item in enumerate(self.objects) if item.height is not None), -1)


def read_layout(items: Any, sizes: Sizes, workspace: Box2, crowded: bool = False) -> tuple[ObjectSpec, ...]:
    """Check an explicit layout: a sequence of mappings with `kind`, `color`, `xy` (metres), optionally `yaw`.

    ``info["objects"]`` of an earlier `reset` is a layout too: `position` and `orientation` (a quaternion)
    stand for `xy` and `yaw`. A block whose centre is within a bowl's floor lies in that bowl.

    Args:
        items: the layout.
        sizes: of the objects.
        workspace: where they may be.
        crowded: whether objects may share a colour, and the third value of a `position` counts: a block that
            is higher than another at the same place stands on it, and one much higher hangs at the arm.

    Raises:
        ValueError: for anything that is not such a layout, two objects of one colour, overlapping objects, or
            one outside the workspace; the message says what is allowed.
    """
    if isinstance(items, str | Mapping) or not isinstance(items, Iterable):
        raise ValueError(f"a layout is a list of objects such as {_EXAMPLE}, not {type(items).__name__}")
    objects = [_read_object(item, workspace) for item in items]
    if not 2 <= len(objects) <= MAX_OBJECTS:
        raise ValueError(f"a layout has 2 to {MAX_OBJECTS} objects, not {len(objects)}")
    colors = [item.color for item in objects]
    twice = sorted({color for color in colors if colors.count(color) > 1})
    if twice and not crowded:
        raise ValueError(f"no two objects may share a colour, but {', '.join(twice)} is there more than once")
    if not crowded:
        objects = [replace(item, height=None) for item in objects]
    return tuple(_find_supports(objects, sizes))


_EXAMPLE = "{'kind': 'block', 'color': 'red', 'xy': (0.5, 0.1)}"


def _read_object(item: Any, workspace: Box2) -> ObjectSpec:
    if not isinstance(item, Mapping):
        raise ValueError(f"an object of a layout is a mapping such as {_EXAMPLE}, not {item!r}")
    kind, color = item.get("kind"), item.get("color")
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r} in a layout; allowed: {', '.join(KINDS)}")
    if color not in COLORS:
        raise ValueError(f"unknown colour {color!r} in a layout; allowed: {', '.join(COLORS)}")
    try:
        place = np.asarray(item["xy"] if "xy" in item else item["position"], dtype=float).ravel()
        x, y = float(place[0]), float(place[1])
        height = float(place[2]) if len(place) > 2 and kind == "block" else None
        yaw = _yaw(item["orientation"]) if "orientation" in item else float(item.get("yaw", 0.0))
    except (KeyError, TypeError, ValueError, IndexError):
        raise ValueError(f"the {color} {kind} needs a place 'xy' in metres, as in {_EXAMPLE}") from None
    if not (workspace.contains(x, y) and np.isfinite(yaw)):
        raise ValueError(f"the {color} {kind} at ({x:g}, {y:g}) is out of the workspace: {workspace}")
    return ObjectSpec(kind, color, x, y, yaw, height=height)


def _yaw(quaternion: Any) -> float:
    x, y, z, w = (float(value) for value in quaternion)
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _find_supports(objects: list[ObjectSpec], sizes: Sizes) -> list[ObjectSpec]:
    """Mark the blocks that lie in bowls, stand on blocks or hang at the arm, and refuse every other overlap."""
    placed: list[ObjectSpec] = []
    for item in objects:
        inside = on = None
        held = item.height is not None and item.height > HELD_HEIGHT * sizes.block
        for index, other in enumerate(objects):
            distance = hypot(item.x - other.x, item.y - other.y)
            if held or item.kind != "block" or distance > max(inside_radius(sizes), sizes.block / 2):
                continue
            if other.kind == "bowl" and distance <= inside_radius(sizes):
                inside = index
            elif other.kind == "block" and (item.height or 0) > (other.height or 0) + sizes.block / 2:
                on = index
        placed.append(replace(item, inside=inside, on=on, height=item.height if held else None))
    if sum(item.height is not None for item in placed) > 1:
        raise ValueError(
            "the arm can hold one block at the start, not several; see the heights in the layout"
        )
    filled = [item.inside for item in placed if item.inside is not None]
    for index in filled:
        if filled.count(index) > 1:
            raise ValueError(
                f"the {placed[index].thing} has room for one block at the start, not {filled.count(index)}"
            )
    for index, item in enumerate(placed):
        for other in placed[:index]:
            if not (item.stands and other.stands):
                continue
            needed = sizes.footprint(item.kind) + sizes.footprint(other.kind)
            if hypot(item.x - other.x, item.y - other.y) < needed:
                raise ValueError(
                    f"the {item.thing} and the {other.thing} overlap; their centres must be at least "
                    f"{needed:.3f} m apart, or a block within {inside_radius(sizes):.3f} m of a bowl's "
                    "centre to lie in it"
                )
    return placed


def inside_radius(sizes: Sizes) -> float:
    """How far off the bowl's centre a block can lie flat, in metres."""
    return sizes.bowl_floor_radius - sizes.block / 2
