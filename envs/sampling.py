"""Random scenes. Everything is drawn from one generator, so a seed is a scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import dist, hypot, pi

import numpy as np

from .colors import COLORS, ColorSplit
from .geometry import SPAWN, Box2, Sizes
from .scene import MAX_OBJECTS, TABLE, Instruction, ObjectSpec, Thing

MAX_BOWLS = 5
MAX_TRIES = 5000  # whole layouts, 0.3 ms each; the fullest scene needs about 100 (at most 516 in 60 seeds)
AVOIDED = 0.08  # metres around the arm's resting place in which no stack may grow
ARM_JITTER = 0.08  # half-width in radians of the random joint offsets of a perturbed start pose


@dataclass(frozen=True)
class SceneRequest:
    """What a random scene must be like; ValueError when no scene can be like that."""

    named: tuple[str, ...]  # kinds of what the instruction names, in its order: thing, target, thing, ...
    n_objects: int = 6
    n_bowls: int | None = None  # number of bowls; uniform over the possible numbers when None
    color_split: ColorSplit = "seen"  # which colours the instruction may name
    instructions: tuple[Instruction, ...] | None = None  # what the instruction asks for; drawn when None
    blocks_in_bowls: int = 0  # how many blocks that are not named start in bowls that are not named
    target_in_bowl: bool = False  # whether the first named block starts in a bowl that is not named
    family: str | None = None  # the kind of scene, where the task has several; drawn when None
    spawn: Box2 = SPAWN  # where objects stand
    edge: float = 0.0  # how far from the edge of that area their centres are, in footprints
    avoid: tuple[float, float] | None = None  # where nothing stands: a stack would be in the arm's way

    def __post_init__(self) -> None:
        if not len(self.named) <= self.n_objects <= MAX_OBJECTS:
            raise ValueError(
                f"n_objects must be {len(self.named)} to {MAX_OBJECTS} for the {len(self.named)} things that "
                f"the instruction names, so that all fit on the table; got {self.n_objects}"
            )
        low, high = self.bowl_range
        if low > high:
            raise ValueError(
                f"{self.n_objects} objects are too few for {len(self.named)} named things and "
                f"{self.blocks_in_bowls + self.target_in_bowl} blocks that start in other bowls"
            )
        if self.n_bowls is not None and not low <= self.n_bowls <= high:
            raise ValueError(f"n_bowls must be {low} to {high} for this scene; got {self.n_bowls}")

    @property
    def bowl_range(self) -> tuple[int, int]:
        """Fewest and most bowls such a scene can have."""
        low = self.named.count("bowl") + self.blocks_in_bowls + self.target_in_bowl
        return low, min(MAX_BOWLS, self.n_objects - self.named.count("block") - self.blocks_in_bowls)


def sample_objects(
    rng: np.random.Generator, request: SceneRequest, n_bowls: int, named: Sequence[Thing], sizes: Sizes
) -> tuple[ObjectSpec, ...]:
    """Draw the objects of a scene: the ``named`` things, others of other colours, and the places of all."""
    named_colors = [thing.color for thing in named]
    others = rng.permutation([color for color in COLORS if color not in named_colors]).tolist()
    n_blocks = request.n_objects - n_bowls
    kinds = ["bowl"] * (n_bowls - request.named.count("bowl"))
    kinds += ["block"] * (n_blocks - request.named.count("block"))
    things = [*named, *map(Thing, others[: len(kinds)], kinds)]
    # Ids carry no meaning: without the shuffle the target would always be object 0.
    things = [things[k] for k in rng.permutation(len(things))]
    return place_objects(rng, request, things, _draw_insides(rng, request, things, named), sizes)


def place_objects(
    rng: np.random.Generator, request: SceneRequest, things: Sequence[Thing], carriers: dict[int, int], sizes: Sizes
) -> tuple[ObjectSpec, ...]:
    """Draw places and yaws of things, by id.

    ``carriers`` says of each block that is not on the table the id of the bowl or block that it is put on; lower ones
    come first.
    """
    places = _draw_places(rng, request, [thing.kind for thing in things], carriers, sizes)
    objects = [
        ObjectSpec(thing.kind, thing.color, x, y, float(rng.uniform(-pi, pi)))
        for thing, (x, y) in zip(things, places, strict=True)
    ]
    return tuple(item.carried_by(carriers.get(index, TABLE), objects) for index, item in enumerate(objects))


def arm_jitter(rng: np.random.Generator) -> tuple[float, ...]:
    """Random joint offsets (6,) in radians of the arm's start pose; the tool stays upright."""
    pan, lift, elbow = rng.uniform(-ARM_JITTER, ARM_JITTER, size=3).tolist()
    return pan, lift, elbow, -lift - elbow, 0.0, 0.0


def _draw_insides(
    rng: np.random.Generator, request: SceneRequest, things: Sequence[Thing], named: Sequence[Thing]
) -> dict[int, int]:
    """Block id -> id of the bowl that it starts in."""
    free = [index for index, thing in enumerate(things) if thing not in named]
    blocks = rng.permutation([index for index in free if things[index].kind == "block"]).tolist()
    bowls = rng.permutation([index for index in free if things[index].kind == "bowl"]).tolist()
    filling = [int(block) for block in blocks[: request.blocks_in_bowls]]
    if request.target_in_bowl:
        filling.append(things.index(named[0]))
    return {block: int(bowl) for block, bowl in zip(filling, bowls, strict=False)}


def _draw_places(
    rng: np.random.Generator, request: SceneRequest, kinds: list[str], carriers: dict[int, int], sizes: Sizes
) -> list[tuple[float, float]]:
    """Places such that no object touches or much hides another but what carries it."""
    standing = [index for index in range(len(kinds)) if index not in carriers]
    # Wide things first: a late bowl would find only gaps that fit a block.
    standing.sort(key=lambda index: -sizes.footprint(kinds[index]))
    for _ in range(MAX_TRIES):
        if (places := _try_places(rng, request, kinds, standing, sizes)) is not None:
            break
    else:
        count = len(standing)
        raise ValueError(f"{count} objects of this size do not fit on the table; use fewer, or a smaller scale")
    for block, lower in carriers.items():
        # Within the millimetres that leave the block flat on a bowl's floor at any yaw.
        slack = max(0.0, sizes.bowl_floor_radius - sizes.footprint("block"))
        radius, angle = slack * float(rng.random()) ** 0.5, float(rng.uniform(0, 2 * pi))
        places[block] = (places[lower][0] + radius * np.cos(angle), places[lower][1] + radius * np.sin(angle))
    return [places[index] for index in range(len(kinds))]


def _try_places(
    rng: np.random.Generator, request: SceneRequest, kinds: list[str], standing: list[int], sizes: Sizes
) -> dict[int, tuple[float, float]] | None:
    places: dict[int, tuple[float, float]] = {}
    for index in standing:
        area = request.spawn.shrunk(request.edge * sizes.footprint(kinds[index]))
        for x, y in rng.uniform((area.x[0], area.y[0]), (area.x[1], area.y[1]), size=(40, 2)).tolist():
            if request.avoid is not None and dist(request.avoid, (x, y)) < AVOIDED:
                continue
            if all(_apart(x - a, y - b, kinds[index], kinds[k], sizes) for k, (a, b) in places.items()):
                places[index] = (x, y)
                break
        else:
            return None
    return places


def _apart(dx: float, dy: float, kind: str, other: str, sizes: Sizes) -> bool:
    """Whether two objects leave a gap; a wider one along x, where the camera sees one behind the other."""
    distance = hypot(dx, dy)
    gap = 0.008 + 0.025 * abs(dx) / max(distance, 1e-9)
    return distance >= sizes.footprint(kind) + sizes.footprint(other) + gap
