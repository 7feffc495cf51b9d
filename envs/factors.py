"""What varies from scene to scene beside the objects: named factors, each with a range."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from .checks import check_range
from .colors import COLORS
from .geometry import Box2, Sizes
from .scene import HELD_HEIGHT, MAX_OBJECTS, Scene, Thing

Range = tuple[float, float]

# Factors that change the objects. What they did is seen in the objects, so it needs no values.
SHARES = ("same_color", "in_bowl", "on_block", "carried")

# Shapes of the factors whose value in a scene is no single number.
SHAPES: dict[str, tuple[int, ...]] = {
    "tint": (4, 3),
    "object_gain": (MAX_OBJECTS,),
    "object_tint": (MAX_OBJECTS, 3),
    "camera_shift": (2, 3),
}


@dataclass(frozen=True)
class Factors:
    """The factors of a scene: a range is (low, high), (v, v) sets a factor, and None or 0 leaves it out.

    Values are uniform, and each factor has a stream of its own: to change one changes no other.

    Raises:
        ValueError: for a range that is none.
    """

    light_tilt: Range | None = (0.0, 50.0)  # degrees between the light and the vertical
    light_turn: Range | None = (-180.0, 180.0)  # degrees about the vertical, from +x to +y
    ambient: Range | None = (0.45, 0.75)  # strength of the light that comes from everywhere
    diffuse: Range | None = (0.2, 0.5)  # strength of the light from one direction, on a surface that faces it
    specular: Range | None = (0.0, 0.1)
    table_gray: Range | None = (20.0, 120.0)  # of 255, as are the following
    floor_gray: Range | None = (110.0, 250.0)
    arm_dark: Range | None = (20.0, 75.0)
    arm_light: Range | None = (90.0, 230.0)
    tint: Range | None = (-12.0, 12.0)  # added to each channel of table, floor and both grays of the arm
    object_gain: Range | None = (0.8, 1.1)  # factor of each object's colour
    object_tint: Range | None = (-15.0, 15.0)  # added to each channel of each object's colour
    block: Range | None = (0.038, 0.064)  # edge of the blocks, metres
    bowl: Range | None = (0.11, 0.15)  # diameter of the bowls, metres; more where a block would not fit
    # Metres by which the camera and the point that it looks at move; 1 cm is about 2 pixels at 336x336.
    camera_shift: Range | None = (-0.02, 0.02)
    camera_zoom: Range | None = (-1.0, 1.0)  # degrees added to the field of view
    same_color: float = 0.35  # share of the scenes in which things that are not named may share a colour
    in_bowl: float = 0.2  # share of the scenes in which another block starts in another bowl, if it can
    on_block: float = 0.2  # share of the scenes in which a block starts on one that is not named, if it can
    carried: float = 0.15  # share of the scenes in which the arm holds the first named block at the start

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in SHARES:
                check_range(name, value, 0.0, 1.0)
            elif value is not None and not (len(value) == 2 and value[0] <= value[1]):
                raise ValueError(f"{name} must be a range (low, high) or None, not {value!r}")
            elif value is not None:
                object.__setattr__(self, name, tuple(map(float, value)))

    def without(self, names: Iterable[str]) -> Factors:
        """These factors, some left out."""
        off: dict[str, Any] = {name: 0.0 if name in SHARES else None for name in names}
        return replace(self, **off)

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """The values of one scene, as JSON has them; ``rng`` itself does not move on."""
        streams = zip(vars(self).items(), rng.spawn(len(vars(self))), strict=True)
        return {
            name: (value[0] + (value[1] - value[0]) * stream.random(SHAPES.get(name, ()))).tolist()
            for (name, value), stream in streams
            if name not in SHARES and value is not None
        }

    def rearrange(self, rng: np.random.Generator, scene: Scene, sizes: Sizes, space: Box2) -> Scene:
        """The scene with doubled colours, and blocks in bowls, on blocks and (in ``space``) in the hand."""
        objects, streams = list(scene.objects), dict(zip(SHARES, rng.spawn(len(SHARES)), strict=True))
        chosen = {name for name, stream in streams.items() if stream.random() < getattr(self, name)}
        named = {index for pair in scene.goal for index in (pair.thing, pair.target)}

        def free(kind: str) -> list[int]:
            """Objects on the table that nothing lies in or on, those that the goal names at the end."""
            used = {item.inside for item in objects} | {item.on for item in objects}
            alone = (k for k, item in enumerate(objects) if item.stands and k not in used)
            return sorted((k for k in alone if objects[k].kind == kind), key=named.__contains__)

        if "same_color" in chosen:
            pool = streams["same_color"].permutation(list(COLORS))[:3].tolist()
            taken = {objects[index].thing for index in named}
            for index in set(range(len(objects))) - named:
                thing = Thing(pool[int(streams["same_color"].integers(3))], objects[index].kind)
                if thing not in taken:
                    objects[index] = replace(objects[index], color=thing.color)
        blocks, bowls = free("block"), free("bowl")
        if "in_bowl" in chosen and blocks and bowls and named.isdisjoint((blocks[0], bowls[0])):
            bowl = objects[bowls[0]]
            objects[blocks[0]] = replace(objects[blocks[0]], x=bowl.x, y=bowl.y, inside=bowls[0])
        blocks = free("block")
        if "on_block" in chosen and len(blocks) > 1 and blocks[0] not in named:
            lower, upper = blocks[0], blocks[int(streams["on_block"].integers(1, len(blocks)))]
            dx, dy = (0.1 * sizes.block * streams["on_block"].uniform(-1, 1, size=2)).tolist()
            x, y = objects[lower].x + dx, objects[lower].y + dy
            objects[upper] = replace(objects[upper], x=x, y=y, on=lower)
        moved = scene.goal[0].thing
        if "carried" in chosen and objects[moved].kind == "block":
            low = space.x[0], space.y[0], (HELD_HEIGHT + 0.5) * sizes.block
            x, y, height = streams["carried"].uniform(low, (space.x[1], space.y[1], 0.26)).tolist()
            objects[moved] = replace(objects[moved], x=x, y=y, inside=None, on=None, height=height)
        return replace(scene, objects=tuple(objects))


FACTORS = tuple(field.name for field in fields(Factors))  # names of all factors
NO_FACTORS = Factors().without(FACTORS)


def read_factors(values: Any) -> dict[str, Any]:
    """The factors of an earlier scene, as in ``info["factors"]``; ValueError for anything else."""
    known = [name for name in FACTORS if name not in SHARES]
    if not isinstance(values, Mapping) or not set(values) <= set(known):
        raise ValueError(f"factors are a mapping with some of {', '.join(known)}, not {values!r}")
    for name, value in values.items():
        array, shape = np.asarray(value), SHAPES.get(name, ())
        if array.dtype.kind not in "if" or array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f"the factor {name} is a finite array of shape {shape}, not {value!r}")
    return dict(values)
