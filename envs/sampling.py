"""Random scenes. Everything is drawn from one generator, so a seed is a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot, pi

import numpy as np

from envs.colors import CAPTION_COLORS, COLORS, ColorSplit
from envs.geometry import SPAWN, Sizes
from envs.language import ColorPair
from envs.scene import MAX_OBJECTS, ObjectSpec, Scene, find_goal

MAX_BOWLS = 5
MAX_TRIES = 5000
"""Whole layouts to try. The fullest allowed scene needs about 100 (at most 516 in 60 seeds), at 0.3 ms each."""

ARM_JITTER = 0.08
"""Half-width in radians of the random joint offsets of a perturbed start pose."""


@dataclass(frozen=True)
class SceneRequest:
    """What a random scene must be like.

    Raises:
        ValueError: from `__post_init__`, when no scene can be like that.
    """

    n_objects: int = 6
    n_bowls: int | None = None
    """Number of bowls; uniform over the possible numbers when None."""
    color_split: ColorSplit = "seen"
    """Which colours the instruction may name."""
    n_pairs: int = 1
    wishes: tuple[ColorPair, ...] | None = None
    """The colours that the instruction names; drawn when None."""
    blocks_in_bowls: int = 0
    """How many blocks that the instruction does not name start in bowls that it does not name."""
    target_in_bowl: bool = False
    """Whether the first named block starts in a bowl that is not named."""

    def __post_init__(self) -> None:
        if not 2 * self.n_pairs <= self.n_objects <= MAX_OBJECTS:
            raise ValueError(
                f"n_objects must be {2 * self.n_pairs} to {MAX_OBJECTS} for {self.n_pairs} (block, bowl) "
                f"pairs, so that all fit on the table; got {self.n_objects}"
            )
        low, high = self.bowl_range
        if low > high:
            raise ValueError(
                f"{self.n_objects} objects are too few for {self.n_pairs} named pairs and "
                f"{self.blocks_in_bowls + self.target_in_bowl} blocks that start in other bowls"
            )
        if self.n_bowls is not None and not low <= self.n_bowls <= high:
            raise ValueError(f"n_bowls must be {low} to {high} for this scene; got {self.n_bowls}")

    @property
    def bowl_range(self) -> tuple[int, int]:
        """Fewest and most bowls such a scene can have."""
        low = self.n_pairs + self.blocks_in_bowls + self.target_in_bowl
        return low, min(MAX_BOWLS, self.n_objects - self.n_pairs - self.blocks_in_bowls)


def sample_scene(rng: np.random.Generator, request: SceneRequest, sizes: Sizes) -> Scene:
    """Draw a scene: kinds, colours (no two alike), a goal that is not reached yet, and places."""
    low, high = request.bowl_range
    n_bowls = int(rng.integers(low, high + 1)) if request.n_bowls is None else request.n_bowls
    wishes = request.wishes or _draw_wishes(rng, request)
    named = [color for wish in wishes for color in wish]
    others = rng.permutation([color for color in COLORS if color not in named]).tolist()
    kinds = ["bowl"] * (n_bowls - len(wishes)) + ["block"] * (request.n_objects - n_bowls - len(wishes))
    things = [(kind, color) for wish in wishes for kind, color in zip(("block", "bowl"), wish, strict=True)]
    things += list(zip(kinds, others[: len(kinds)], strict=True))
    # Ids carry no meaning: without the shuffle the target would always be object 0.
    things = [things[k] for k in rng.permutation(len(things))]
    insides = _draw_insides(rng, request, things, wishes)
    places = _draw_places(rng, [kind for kind, _ in things], insides, sizes)
    objects = tuple(
        ObjectSpec(kind, color, x, y, float(rng.uniform(-pi, pi)), insides.get(index))
        for index, ((kind, color), (x, y)) in enumerate(zip(things, places, strict=True))
    )
    return Scene(objects, find_goal(objects, wishes))


def jitter_arm(rng: np.random.Generator, scene: Scene) -> Scene:
    """The scene with a randomly perturbed start pose of the arm; the tool stays upright enough to look as at
    home."""
    pan, lift, elbow = rng.uniform(-ARM_JITTER, ARM_JITTER, size=3).tolist()
    return replace(scene, arm_offset=(pan, lift, elbow, -lift - elbow, 0.0, 0.0))


def _draw_wishes(rng: np.random.Generator, request: SceneRequest) -> tuple[ColorPair, ...]:
    colors = rng.permutation(CAPTION_COLORS[request.color_split])[: 2 * request.n_pairs].tolist()
    return tuple(ColorPair(*colors[k : k + 2]) for k in range(0, len(colors), 2))


def _draw_insides(
    rng: np.random.Generator,
    request: SceneRequest,
    things: list[tuple[str, str]],
    wishes: tuple[ColorPair, ...],
) -> dict[int, int]:
    """Block id -> id of the bowl that it starts in."""
    named = {("block", wish.block) for wish in wishes} | {("bowl", wish.bowl) for wish in wishes}
    free = [index for index, thing in enumerate(things) if thing not in named]
    blocks = rng.permutation([index for index in free if things[index][0] == "block"]).tolist()
    bowls = rng.permutation([index for index in free if things[index][0] == "bowl"]).tolist()
    filling = [int(block) for block in blocks[: request.blocks_in_bowls]]
    if request.target_in_bowl:
        filling.append(things.index(("block", wishes[0].block)))
    return {block: int(bowl) for block, bowl in zip(filling, bowls, strict=False)}


def _draw_places(
    rng: np.random.Generator, kinds: list[str], insides: dict[int, int], sizes: Sizes
) -> list[tuple[float, float]]:
    """Places such that no object touches or much hides another."""
    standing = [index for index in range(len(kinds)) if index not in insides]
    # Wide things first: a late bowl would find only gaps that fit a block.
    standing.sort(key=lambda index: -sizes.footprint(kinds[index]))
    for _ in range(MAX_TRIES):
        places = _try_places(rng, kinds, standing, sizes)
        if places is not None:
            break
    else:
        raise ValueError(
            f"{len(standing)} objects of this size do not fit on the table; use fewer, or a smaller scale"
        )
    for block, bowl in insides.items():
        # Within the millimetres that leave the block flat on the bowl's floor at any yaw.
        slack = max(0.0, sizes.bowl_floor_radius - sizes.footprint("block"))
        radius, angle = slack * float(rng.random()) ** 0.5, float(rng.uniform(0, 2 * pi))
        places[block] = (places[bowl][0] + radius * np.cos(angle), places[bowl][1] + radius * np.sin(angle))
    return [places[index] for index in range(len(kinds))]


def _try_places(
    rng: np.random.Generator, kinds: list[str], standing: list[int], sizes: Sizes
) -> dict[int, tuple[float, float]] | None:
    places: dict[int, tuple[float, float]] = {}
    for index in standing:
        for x, y in rng.uniform((SPAWN.x[0], SPAWN.y[0]), (SPAWN.x[1], SPAWN.y[1]), size=(40, 2)).tolist():
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
