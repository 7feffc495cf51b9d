"""What happens in a clip of CATER-hard: which things there are, which two of them act, and where each is at any time.

Facts of the world are those of CATER (Girdhar and Ramanan, 2020) and of CATER-GEN-v2 (MAGE, Hu et al. 2022): five
shapes, three sizes, two materials, eight colours, a table from -3 to 3 in x and y, four actions, two of them at once.
Motion is kinematic: things do not touch each other, so nothing needs to be simulated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, hypot, pi
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..colors import RGB

Shape = Literal["cone", "cube", "cylinder", "sphere", "snitch"]
Action = Literal["rotate", "slide", "pick-place", "contain"]

SIZES: dict[str, float] = {"small": 0.25, "medium": 0.5, "large": 0.75}
"""Half the width of a thing, in the table's units."""
MATERIALS = ("rubber", "metal")  # matt and shiny
COLORS: dict[str, RGB] = {
    "gray": (87, 87, 87),
    "red": (173, 35, 35),
    "blue": (42, 75, 215),
    "green": (29, 105, 20),
    "brown": (129, 74, 25),
    "purple": (129, 38, 192),
    "cyan": (41, 208, 208),
    "yellow": (255, 238, 51),
}
GOLD: RGB = (212, 175, 55)
ACTIONS: dict[Shape, tuple[Action, ...]] = {
    "cone": ("slide", "pick-place", "contain"),
    "cube": ("slide", "pick-place", "rotate"),
    "cylinder": ("slide", "pick-place", "rotate"),
    "sphere": ("slide", "pick-place"),
    "snitch": ("slide", "pick-place", "rotate"),
}
CONTAINED: tuple[Shape, ...] = ("cone", "sphere", "snitch")  # what a larger cone can be put over

FRAMES = 30  # of a clip
LATEST_START, SHORTEST = 10, 20  # frames before a motion begins, and that it lasts, at most and at least
TABLE = 3.0  # half the side
LIFT = 2.0  # how high a thing is picked up
GAP = 0.15  # between things, at least
FEWEST, MOST = 2, 8  # things of a scene
TRIES = 200  # to place a thing, or to find an action that pushes nothing
EYE = (7.2, -6.6, 5.4)  # where the camera is
HIDDEN = 0.5  # share of a thing that others may hide at the start

Place = tuple[float, float]


@dataclass(frozen=True)
class Thing:
    """One thing as it stands at the start of a clip."""

    shape: Shape
    size: str
    material: str
    color: str
    place: Place
    yaw: float  # radians

    @property
    def radius(self) -> float:
        """Half its width, of a cube half its diagonal."""
        return SIZES[self.size]

    @property
    def height(self) -> float:
        """Half its height."""
        return self.radius / 2**0.5 if self.shape == "cube" else self.radius

    @property
    def rgb(self) -> RGB:
        """Its colour, 0..255."""
        return GOLD if self.color == "gold" else COLORS[self.color]

    @property
    def name(self) -> str:
        """What captions call it; two things may have the same name."""
        return f"{self.size} {self.color} {self.material} {self.shape}"


@dataclass(frozen=True)
class Act:
    """What one thing does in a clip.

    Attributes:
        thing: its number.
        action: what it does.
        start, stop: frames of the generator at which the motion begins and ends.
        to: where it ends; None for a rotation.
        into: number of the thing that a cone is put over.
        axis: of a rotation by a right angle: 0, 1 or 2 for x, y, z.
    """

    thing: int
    action: Action
    start: int
    stop: int
    to: Place | None = None
    into: int | None = None
    axis: int = 2

    def done(self, frame: float) -> float:
        """How much of the motion is behind it at a frame, 0..1; it starts and ends gently."""
        t = min(1.0, max(0.0, (frame - self.start) / (self.stop - self.start)))
        return t * t * (3 - 2 * t)


@dataclass(frozen=True)
class Clip:
    """The things of a scene and what two of them do."""

    things: tuple[Thing, ...]
    acts: tuple[Act, ...]

    def poses(self, frame: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres (n, 3) of the things in the table's units, and rotations (n, 4) as quaternions x y z w."""
        centers = np.array([(*thing.place, thing.height) for thing in self.things])
        turns = np.array([(0.0, 0.0, np.sin(t.yaw / 2), np.cos(t.yaw / 2)) for t in self.things])
        for act in self.acts:
            k, done = act.thing, act.done(frame)
            if act.to is None:
                turns[k] = _product(_turn(act.axis, done * pi / 2), turns[k])
                continue
            start, end = np.array(self.things[k].place), np.array(act.to)
            if act.action == "slide":
                centers[k, :2] = start + done * (end - start)
                continue
            # Picked up in the first third, carried in the second, put down in the third.
            centers[k, 2] += LIFT * min(1.0, 3 * done, 3 * (1 - done))
            centers[k, :2] = start + min(1.0, max(0.0, 3 * done - 1)) * (end - start)
        return centers, turns

    @property
    def instruction(self) -> str:
        """The caption, every action with all attributes: what CATER-GEN-v2 calls explicit."""
        return " ".join(self._said(act) for act in sorted(self.acts, key=lambda act: act.thing))

    def ambiguous(self, rng: np.random.Generator) -> str:
        """A caption that leaves out attributes at random and names quadrants instead of cells."""
        return " ".join(self._said(act, rng) for act in sorted(self.acts, key=lambda act: act.thing))

    def _said(self, act: Act, rng: np.random.Generator | None = None) -> str:
        name = _named(self.things[act.thing], rng)
        if act.action == "rotate":
            return f"the {name} is rotating."
        if act.action == "contain":
            assert act.into is not None
            return f"the {name} is picked up and containing the {_named(self.things[act.into], rng)}."
        assert act.to is not None
        x, y = cell(act.to)
        where = f"({x}, {y})" if rng is None else f"the {quadrant(act.to)} quadrant"
        return f"the {name} is {'sliding' if act.action == 'slide' else 'picked up and placed'} to {where}."


def cell(place: Place) -> tuple[int, int]:
    """The cell of the 6x6 grid in which a place lies, each number -3 to -1 or 1 to 3."""
    x, y = (ceil(value - 1 if value <= 0 else value) for value in place)
    return max(-3, x), max(-3, y)


def quadrant(place: Place) -> str:
    """Counted against the clock from where x and y are positive."""
    names = {(True, True): "first", (False, True): "second", (False, False): "third", (True, False): "fourth"}
    return names[place[0] > 0, place[1] > 0]


def draw_clip(rng: np.random.Generator) -> Clip:
    """A random clip."""
    while True:
        things = _draw_things(rng)
        acts = draw_acts(rng, things)
        if acts is not None:
            return Clip(things, acts)


def draw_acts(
    rng: np.random.Generator, things: tuple[Thing, ...], first: tuple[int, Action] | None = None
) -> tuple[Act, ...] | None:
    """Two random actions at once in which no thing pushes another; None where none were found.

    Args:
        first: the thing that acts first, and its action, if they are not to be drawn.
    """
    for _ in range(TRIES):
        pair = rng.permutation(len(things))[:2].tolist()
        if first is not None:
            pair[0] = first[0]
        acts: list[Act] = []
        for number in dict.fromkeys(pair):
            act = _draw_act(rng, things, number, pair, first[1] if first and not acts else None)
            if act is not None:
                acts.append(act)
        if len(acts) == 2 and free(Clip(things, tuple(acts))):
            return tuple(acts)
    return None


def _draw_things(rng: np.random.Generator) -> tuple[Thing, ...]:
    while True:
        things: list[Thing] = []
        count = int(rng.integers(FEWEST, MOST + 1))
        for _ in range(TRIES):
            thing = _draw_thing(rng)
            if thing.shape == "snitch" and any(other.shape == "snitch" for other in things):
                continue
            if things and rng.random() < 0.2:  # a whole thing once more
                twin = things[int(rng.integers(len(things)))]
                if twin.shape != "snitch":
                    thing = replace(twin, place=thing.place, yaw=thing.yaw)
            apart = all(_apart(thing.place, o.place) > thing.radius + o.radius + GAP for o in things)
            if apart and all(share <= HIDDEN for share in hidden([*things, thing])):
                things.append(thing)
            if len(things) == count:
                return tuple(things)


def _draw_thing(rng: np.random.Generator) -> Thing:
    shape: Shape = str(rng.choice(list(ACTIONS), p=(0.25, 0.2, 0.2, 0.2, 0.15)))  # type: ignore[assignment]
    size, material, color = (str(rng.choice(list(names))) for names in (SIZES, MATERIALS, COLORS))
    if shape == "snitch":
        size, material, color = "small", "metal", "gold"
    yaw = float(rng.uniform(0, 2 * pi))
    return Thing(shape, size, material, color, _draw_place(rng, SIZES[size]), yaw)


def _draw_place(rng: np.random.Generator, radius: float) -> Place:
    x, y = rng.uniform(radius - TABLE, TABLE - radius, 2)
    return float(x), float(y)


def draw_times(rng: np.random.Generator) -> tuple[int, int]:
    """Frames at which a motion begins and ends."""
    start = int(rng.integers(LATEST_START + 1))
    return start, int(rng.integers(start + SHORTEST, FRAMES + 1))


def _draw_act(
    rng: np.random.Generator, things: tuple[Thing, ...], number: int, acting: Sequence[int], action: Action | None
) -> Act | None:
    thing = things[number]
    start, stop = draw_times(rng)
    inside = [
        k
        for k, other in enumerate(things)
        if k not in acting and other.shape in CONTAINED and other.radius < thing.radius
    ]
    can = [each for each in ACTIONS[thing.shape] if each != "contain" or inside]
    if action is None:
        action = can[int(rng.integers(len(can)))]
    if action not in can:
        return None
    if action == "contain":
        into = inside[int(rng.integers(len(inside)))]
        return Act(number, action, start, stop, things[into].place, into)
    if action == "rotate":
        return Act(number, action, start, stop, axis=int(rng.integers(3)))
    to = _draw_place(rng, thing.radius)
    if cell(to) == cell(thing.place):  # it would say nothing
        return None
    return Act(number, action, start, stop, to)


def free(clip: Clip) -> bool:
    """Whether no thing comes too near to another at any time."""
    radii = np.array([thing.radius for thing in clip.things])
    wide = radii[:, None] + radii + GAP
    inside = {(act.thing, act.into) for act in clip.acts if act.into is not None}
    moving = sorted(act.thing for act in clip.acts)
    for frame in range(FRAMES + 1):
        centers, _ = clip.poses(frame)
        for k in moving:
            off = np.abs(centers - centers[k])
            near = (np.hypot(off[:, 0], off[:, 1]) < wide[k]) & (off[:, 2] < wide[k])
            if any(other != k and (k, other) not in inside for other in near.nonzero()[0].tolist()):
                return False
    return True


def hidden(things: Sequence[Thing]) -> list[float]:
    """About what share of each thing the others hide from the camera; all are taken for balls."""
    shares = []
    eye = np.array(EYE)
    centers = np.array([(*thing.place, thing.radius) for thing in things])
    for k, thing in enumerate(things):
        offsets = thing.radius * 0.7 * np.array([(0, 0, 0), (0, 0, 1), (0, 0, -1), (1, 1, 0), (-1, -1, 0)])
        rays = centers[k] + offsets - eye
        covered = np.zeros(len(rays), bool)
        for other, center in enumerate(centers):
            if other != k:
                along = np.clip((rays @ (center - eye)) / np.square(rays).sum(1), 0, 1)
                covered |= np.linalg.norm(along[:, None] * rays - (center - eye), axis=1) < things[other].radius
        shares.append(float(covered.mean()))
    return shares


def _named(thing: Thing, rng: np.random.Generator | None) -> str:
    if rng is None:
        return thing.name
    words = thing.name.split()
    kept = [word for word in words[:-1] if rng.random() < 0.5]
    return " ".join([*kept, words[-1]])


def _apart(one: Place, other: Place) -> float:
    return hypot(one[0] - other[0], one[1] - other[1])


def _turn(axis: int, angle: float) -> NDArray[np.float64]:
    quaternion = np.zeros(4)
    quaternion[axis], quaternion[3] = np.sin(angle / 2), np.cos(angle / 2)
    return quaternion


def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation `b`, then `a`."""
    v = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.array([*v, a[3] * b[3] - a[:3] @ b[:3]])
