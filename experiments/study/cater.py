"""What CATER's scenes are for a study, and how an imagined clip is judged: from masks, by the simulator's rules."""

from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from envs.cater import Act, Action, Clip, Table, Thing, draw_acts
from envs.cater.record import clip_of
from envs.cater.scenes import CONTAINED, LIFT
from envs.splits import SPLITS
from experiments.study.scenes import SCENES_PER_SEED
from planning import PinholeCamera
from textocvp import Rollout
from textocvp.metrics import object_ious

MOVED = 3.0  # pixels of 64: a thing that stays nearer to its place has not moved
LIFTED = 0.5  # share of the way up at which a thing counts as lifted
NEAR = 4.0  # pixels between a cone and what it was put over
VANISHED = 0.4  # share of its pixels that a contained thing shows at most
COVERED = 0.3  # IoU of a slot with the thing that it holds, at least
TRIES = 20  # to find other actions for a scene
SIDE = 64  # pixels of a picture's side
FAR = 8.0  # of them: a slide that nobody can overlook


@dataclass(frozen=True)
class CaterScene:
    """One scene of a split, with its own actions or others."""

    split: str
    seed: int
    variant: int = 0  # 0: its own

    def clip(self) -> Clip:
        """Its things and what they do."""
        own, _ = clip_of(self.seed)
        return own if self.variant == 0 else _other(self.seed, self.variant)

    def watch(self, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Frames (T, H, W, 3) uint8 and labels (T, H, W), 1 + i for thing i, as the simulator draws them."""
        return _table(size).film(self.clip(), clip_of(self.seed)[1])


@lru_cache(maxsize=2)
def _table(size: int) -> Table:
    return Table(size)


@lru_cache(maxsize=64)
def _other(seed: int, variant: int) -> Clip:
    """The same things under another caption: other things act, or do something else, or end elsewhere."""
    own, _ = clip_of(seed)
    rng = np.random.default_rng([seed, 5, variant])
    for _ in range(TRIES):
        acts = draw_acts(rng, own.things)
        if acts is not None and (found := Clip(own.things, acts)).instruction != own.instruction:
            return found
    return own


def cater_scenes(count: int, seed: int, split: str = "test") -> list[CaterScene]:
    """So many scenes of a split; each `seed` chooses other ones."""
    first = SCENES_PER_SEED * seed
    return [CaterScene(split, SPLITS[split].seed(first + i)) for i in range(count)]


def slide_away(things: tuple[Thing, ...]) -> tuple[Act, ...] | None:
    """Actions in which the first thing slides further than `FAR` in the picture, and another one acts."""
    rng = np.random.default_rng([len(things), 6])
    for _ in range(TRIES):
        acts = draw_acts(rng, things, first=(0, "slide"))
        if acts is None or acts[0].to is None:
            return None
        start, end = (in_picture(place, things[0].height, SIDE) for place in (things[0].place, acts[0].to))
        if np.linalg.norm(end - start) > FAR:
            return acts
    return None


def slots_of_things(rollout: Rollout, first_HW: np.ndarray) -> dict[int, int]:
    """Thing -> the slot (B = 1) whose mask covers it in the first frame, by the simulator's labels of that frame."""
    labels_HW = rollout.decode_masks([0])[0, 0].argmax(0).cpu().numpy()
    found = object_ious(labels_HW, first_HW, np.unique(first_HW[first_HW > 0]).tolist(), min_pixels=1)
    pairs = zip(found.ids, found.slots, found.ious, strict=True)
    return {int(label) - 1: int(slot) for label, slot, iou in pairs if iou > COVERED}


@dataclass(frozen=True)
class Judged:
    """One action as it was imagined; None where nothing can be said of it."""

    object: bool | None  # the named thing is among those that move farthest
    action: bool | None  # what it does is what the caption says; a turn cannot be told from its mask
    rests: bool | None  # what is told to turn stays where it is
    place: bool | None  # it ends in the named cell or next to it
    vanishes: bool | None  # what is contained is no longer seen

    def where(self, true: "Judged") -> "Judged":
        """Only what the simulator's own masks show: a thing that it moves by two pixels does not move in pictures."""
        return Judged(*(getattr(self, one.name) if getattr(true, one.name) else None for one in fields(self)))


def judge(labels_THW: np.ndarray, clip: Clip, first_HW: np.ndarray) -> list[Judged]:
    """What masks (T, H, W) show of the actions of a clip.

    Where both acting things have one name, each may do the other's part: the better of the two readings counts.

    Args:
        labels_THW: the slot of each pixel, frame 0 first.
        first_HW: the simulator's labels of frame 0, by which slots get their things.
    """
    ways, readings = paths(labels_THW, clip, first_HW), [clip.acts]
    who = [act.thing for act in clip.acts]
    if len({clip.things[k].name for k in who}) < len(who):
        readings.append(tuple(replace(act, thing=k) for act, k in zip(clip.acts, who[::-1], strict=True)))
    judged = [_judged(ways, Clip(clip.things, acts), first_HW.shape[0]) for acts in readings]
    return max(judged, key=lambda found: sum(value is True for one in found for value in vars(one).values()))


def _judged(ways: dict[int, "Path"], clip: Clip, size: int) -> list[Judged]:
    far = {k: float(np.linalg.norm(way.end - way.start)) for k, way in ways.items()}
    moving = [act for act in clip.acts if act.to is not None]
    farthest = sorted(far, key=lambda k: -far[k])[: len(moving)]
    found = []
    for act in clip.acts:
        who = _meant(act, clip, ways, far)
        way = ways.get(who)
        did = _did(who, way, clip, ways, size) if way is not None else None
        place = None
        if act.to is not None:
            place = way is not None and _next_to(_place(way, clip.things[who], size), act.to)
        turns = act.action == "rotate"
        found.append(
            Judged(
                None if act.to is None else who in farthest and far[who] > MOVED,
                None if turns else did == act.action,
                did == "rotate" if turns else None,
                place,
                None if act.into is None else act.into in ways and ways[act.into].left <= VANISHED,
            )
        )
    return found


@dataclass(frozen=True)
class Path:
    """How one thing moves in the picture."""

    points_T2: np.ndarray  # centres (x, y) in pixels; NaN where it is hidden
    left: float  # share of its pixels that is shown at the end

    @property
    def start(self) -> np.ndarray:
        """Where it is at first."""
        return self.points_T2[0]

    @property
    def end(self) -> np.ndarray:
        """Where it is seen last."""
        return self.points_T2[~np.isnan(self.points_T2[:, 0])][-1]


def paths(labels_THW: np.ndarray, clip: Clip, first_HW: np.ndarray) -> dict[int, Path]:
    """The way of each thing that has a slot in the first frame."""
    matched = object_ious(labels_THW[0], first_HW, range(1, 1 + len(clip.things)), min_pixels=1)
    found = {}
    for label, slot, iou in zip(matched.ids, matched.slots, matched.ious, strict=True):
        own_THW = labels_THW == slot
        if iou > 0 and own_THW[0].any():
            points = np.stack([_center(own_HW) for own_HW in own_THW])
            found[int(label) - 1] = Path(points, float(own_THW[-1].sum() / own_THW[0].sum()))
    return found


def _center(own_HW: np.ndarray) -> np.ndarray:
    y, x = own_HW.nonzero()
    return np.array([x.mean() + 0.5, y.mean() + 0.5]) if len(x) else np.full(2, np.nan)


def _meant(act: Act, clip: Clip, ways: dict[int, Path], far: dict[int, float]) -> int:
    """The thing of that name: of two alike, the one that moves farther and does not act itself."""
    name, acting = clip.things[act.thing].name, {other.thing for other in clip.acts} - {act.thing}
    alike = [k for k, thing in enumerate(clip.things) if thing.name == name and k in ways and k not in acting]
    return max(alike, key=lambda k: far[k], default=act.thing)


def _did(who: int, way: Path, clip: Clip, ways: dict[int, Path], size: int) -> Action:
    """The action that a way in the picture shows."""
    thing, T = clip.things[who], len(way.points_T2)
    share_T = np.linspace(0, 1, T)
    line_y = way.start[1] + share_T * (way.end[1] - way.start[1])
    up = float(np.nanmax(line_y - way.points_T2[:, 1]))
    high, low = (in_picture(thing.place, z, size) for z in (thing.height + LIFT, thing.height))
    if up < LIFTED * (low[1] - high[1]):
        return "slide" if np.linalg.norm(way.end - way.start) > MOVED else "rotate"
    for k, other in enumerate(clip.things):
        smaller = other.shape in CONTAINED and other.radius < thing.radius and thing.shape == "cone"
        if not smaller or k not in ways or ways[k].left > VANISHED:
            continue
        if np.linalg.norm(ways[k].start - way.end) <= NEAR + size * 0.02 * thing.radius:
            return "contain"
    return "pick-place"


def in_picture(place: tuple[float, float], height: float, size: int) -> np.ndarray:
    """Where a point above a place of the table is seen, (x, y) in pixels of a picture of so many a side."""
    return np.asarray(_camera(size).project(np.array([[*place, height]]))[0])


@lru_cache(maxsize=2)
def _camera(size: int) -> PinholeCamera:
    camera = _table(size).camera
    return PinholeCamera(camera.intrinsics, camera.extrinsics)


def _place(way: Path, thing: Thing, size: int) -> np.ndarray:
    """Where it ends on the table: its way in the picture seen through the camera, from its true place on."""
    camera = _camera(size)
    off = camera.unproject_to_plane(way.start, thing.height)[:2] - thing.place
    return np.asarray(camera.unproject_to_plane(way.end, thing.height)[:2] - off)


def _next_to(place: np.ndarray, to: tuple[float, float]) -> bool:
    """Whether a place lies in the cell of another, or in one that touches it, be it off the table."""
    cells = np.ceil(np.array([place, to]))
    return bool((np.abs(cells[0] - cells[1]) <= 1).all())
