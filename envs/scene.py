"""What a scene is and what may be asked of it: plain values, no physics, no task."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot
from typing import Any, NamedTuple

import numpy as np

from .checks import check_choice
from .colors import COLORS
from .geometry import Box2, Sizes

KINDS = ("block", "bowl")
MAX_OBJECTS = 8  # as many objects as fit side by side into the workspace, each visible

TABLE, NOWHERE = -1, -2
"""Supports beside ids of objects: the table, and nothing that a sentence could name (held, askew, falling)."""

HELD_HEIGHT = 2.5  # a block whose centre is higher than this many blocks hangs at the arm: no two blocks reach so high


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
    """One object of a layout; ids count from 0."""

    kind: str
    color: str
    x: float
    y: float
    yaw: float = 0.0
    inside: int | None = None  # the id of the bowl that a block lies in
    on: int | None = None  # the id of the block that a block stands on
    height: float | None = None  # of a block's centre (metres), if the arm holds it

    @property
    def thing(self) -> Thing:
        return Thing(self.color, self.kind)

    @property
    def stands(self) -> bool:
        """Whether it stands on the table itself."""
        return self.inside is None and self.on is None and self.height is None

    @property
    def support(self) -> int:
        """The id of the bowl or block that carries it, or `TABLE`."""
        return next((index for index in (self.inside, self.on) if index is not None), TABLE)

    def carried_by(self, support: int, objects: Sequence[ObjectSpec]) -> ObjectSpec:
        """The same object on another `support`, which counts as the table where it is no id of ``objects``."""
        kind = objects[support].kind if support >= 0 else "table"
        return replace(self, inside=support if kind == "bowl" else None, on=support if kind == "block" else None)


@dataclass(frozen=True)
class Scene:
    """A scene to build."""

    objects: tuple[ObjectSpec, ...]
    goal: tuple[GoalPair, ...]
    instruction: str  # the sentence that asks for the goal
    picture: tuple[ObjectSpec, ...] | None = None  # how all shall lie in the end, where a picture is the goal
    family: str | None = None  # the kind of random scene

    @property
    def held(self) -> int:
        """The id of the block that the arm holds, or -1."""
        return next((index for index, item in enumerate(self.objects) if item.height is not None), -1)


def read_layout(
    items: Any, sizes: Sizes, workspace: Box2, crowded: bool = False, stacked: bool = False
) -> tuple[ObjectSpec, ...]:
    """Check an explicit layout: a sequence of mappings with `kind`, `color`, `xy` (metres), optionally `yaw`.

    ``info["objects"]`` of an earlier `reset` is a layout too: `position` and `orientation` (a quaternion)
    stand for `xy` and `yaw`. A block whose centre is within a bowl's floor lies in that bowl.

    With ``stacked`` the third value of a `position` counts: a block that is higher than another at the same place
    stands on it. With ``crowded`` too, but one that is much higher hangs at the arm, and objects may share a colour.

    Raises:
        ValueError: for anything that is not such a layout, two objects of one colour, overlapping objects, or
            one outside the workspace; the message says what is allowed.
    """
    if isinstance(items, str | Mapping) or not isinstance(items, Iterable):
        raise ValueError(f"a layout is a list of objects such as {_EXAMPLE}, not {type(items).__name__}")
    objects = [_read_object(item, workspace) for item in items]
    if not 2 <= len(objects) <= MAX_OBJECTS:
        raise ValueError(f"a layout has 2 to {MAX_OBJECTS} objects, not {len(objects)}")
    if not crowded:
        counts = Counter(item.color for item in objects)
        if twice := ", ".join(sorted(color for color in counts if counts[color] > 1)):
            raise ValueError(f"no two objects may share a colour, but {twice} is there more than once")
        objects = [replace(item, height=item.height if stacked else None) for item in objects]
    return tuple(_find_supports(objects, sizes, may_hang=crowded))


_EXAMPLE = "{'kind': 'block', 'color': 'red', 'xy': (0.5, 0.1)}"


def _read_object(item: Any, workspace: Box2) -> ObjectSpec:
    if not isinstance(item, Mapping):
        raise ValueError(f"an object of a layout is a mapping such as {_EXAMPLE}, not {item!r}")
    kind, color = item.get("kind"), item.get("color")
    check_choice("kind", kind, KINDS, where=" in a layout", form=str)
    check_choice("colour", color, COLORS, where=" in a layout", form=str)
    try:
        place = np.asarray(item["xy"] if "xy" in item else item["position"], dtype=float).ravel()
        x, y = float(place[0]), float(place[1])
        height = float(place[2]) if len(place) > 2 and kind == "block" else None
        if "orientation" not in item:
            yaw = float(item.get("yaw", 0.0))
        else:
            qx, qy, qz, qw = map(float, item["orientation"])
            yaw = float(np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))
    except (KeyError, TypeError, ValueError, IndexError):
        raise ValueError(f"the {color} {kind} needs a place 'xy' in metres, as in {_EXAMPLE}") from None
    if not (workspace.contains(x, y) and np.isfinite(yaw)):
        raise ValueError(f"the {color} {kind} at ({x:g}, {y:g}) is out of the workspace: {workspace}")
    return ObjectSpec(str(kind), str(color), x, y, yaw, height=height)


def _find_supports(objects: list[ObjectSpec], sizes: Sizes, may_hang: bool) -> list[ObjectSpec]:
    """Mark the blocks that lie in bowls, stand on blocks or hang at the arm, and refuse other overlaps."""
    placed: list[ObjectSpec] = []
    radius = inside_radius(sizes)
    for item in objects:
        inside = on = None
        held = may_hang and item.height is not None and item.height > HELD_HEIGHT * sizes.block
        for index, other in enumerate(objects if item.kind == "block" and not held else ()):
            distance = hypot(item.x - other.x, item.y - other.y)
            if other.kind == "bowl" and distance <= radius:
                inside = index
            higher = other.kind == "block" and (item.height or 0) > (other.height or 0) + sizes.block / 2
            under = on is None or (other.height or 0) > (objects[on].height or 0)
            if higher and under and distance <= max(radius, sizes.block / 2):
                on = index
        inside = inside if on is None else None
        placed.append(replace(item, inside=inside, on=on, height=item.height if held else None))
    if sum(item.height is not None for item in placed) > 1:
        raise ValueError("the arm can hold one block at the start, not several; see the heights in the layout")
    for bowl, count in Counter(item.inside for item in placed).items():
        if bowl is not None and count > 1:
            raise ValueError(f"the {placed[bowl].thing} has room for one block at the start, not {count}")
    standing = [item for item in placed if item.stands]
    for index, item in enumerate(standing):
        for other in standing[:index]:
            needed = sizes.footprint(item.kind) + sizes.footprint(other.kind)
            if hypot(item.x - other.x, item.y - other.y) < needed:
                raise ValueError(
                    f"the {item.thing} and the {other.thing} overlap; their centres must be at least "
                    f"{needed:.3f} m apart, or a block within {radius:.3f} m of a bowl's centre to lie in it"
                )
    return placed


def inside_radius(sizes: Sizes) -> float:
    """How far off the bowl's centre a block can lie flat, in metres."""
    return sizes.bowl_floor_radius - sizes.block / 2
