"""Which slot is what, in the first frame of a rollout.

`ground` goes by how slots look, and learns nothing. `ground_by_segmentation` reads the simulator's truth: it is for
studies and for the control column `privileged`, never for the planner proper.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import scipy  # its parts are loaded when they are first used
from numpy.typing import NDArray

from .camera import MIDDLE_HEIGHT, PinholeCamera, View
from .language import Instruction, Thing
from .masks import Bools, frame_masks
from .relations import CLOSE_VIEW, RELATIONS

if TYPE_CHECKING:
    from textocvp.rollout import Rollout

RGB = tuple[float, float, float]
Integers = NDArray[np.integer[Any]]
Floats = NDArray[np.floating[Any]]

# A surface shows its colour times the light on it, which lies between these in the tabletop scenes.
LIGHT = (0.7, 1.05)
# To get a name that is not its nearest, a slot may be at most this far from it (Euclidean, RGB 0..1).
SECOND_CHOICE = 0.25
# A slot must be present this much, and win this many pixels of a `View`, to be looked at.
MIN_PRESENCE, MIN_PIXELS = 0.5, 6
# Slots of one colour name belong to one object when their pixels are at most this far apart, in pixels of a `View`.
TOUCH_PX = 2
# What looks wider than this, in metres, is a bowl. In the first and last frames of 200 val episodes blocks look
# 0.054 to 0.076 wide and bowls 0.115 to 0.149 (`experiments/calibrate.py`).
BOWL_WIDTH = 0.095
# Labels in a segmentation of what is no object.
BACKGROUND, ROBOT = 0, 1


class GroundingError(LookupError):
    """The scene does not show what was asked for."""


@dataclass(frozen=True)
class Palette:
    """How the names of colours, the robot and the table look, RGB 0..1."""

    colors: Mapping[str, RGB]
    robot: RGB
    table: RGB

    @classmethod
    def from_info(cls, palette: Mapping[str, Any]) -> Palette:
        """From `info["palette"]` of the environments, RGB 0..255."""

        def unit(color: Sequence[float]) -> RGB:
            red, green, blue = color
            return red / 255, green / 255, blue / 255

        colors = {name: unit(color) for name, color in palette["colors"].items()}
        return cls(colors, unit(palette["robot"]), unit(palette["table"]))


TABLETOP = Palette.from_info({
    "colors": {
        "blue": (78, 121, 167), "green": (89, 169, 79), "red": (255, 87, 89), "brown": (156, 117, 95),
        "cyan": (118, 183, 178), "gray": (186, 176, 172), "yellow": (237, 201, 72), "pink": (255, 157, 167),
        "purple": (176, 122, 161), "white": (255, 255, 255), "orange": (242, 142, 43),
    },
    "robot": (105, 72, 240),
    "table": (47, 47, 47),
})  # fmt: skip
"""Of the environments' scene "simple"."""


@dataclass(frozen=True)
class Grounding:
    """Which slots of one scene are what. Slots keep their index, so this holds for all frames of a rollout."""

    background: tuple[int, ...]  # table and floor
    arm: tuple[int, ...]
    # Usually one slot; two where a lit and a shaded side were parsed apart.
    things: Mapping[Thing, tuple[int, ...]] = field(default_factory=dict)
    view: View = field(default=CLOSE_VIEW, compare=False)  # how large things are seen

    def of_kind(self, kind: str) -> tuple[Thing, ...]:
        """The things of one kind, sorted."""
        return tuple(sorted(thing for thing in self.things if thing.kind == kind))

    def instructions(self, *relations: str) -> tuple[Instruction, ...]:
        """Every instruction of these relations (by default of all) that the scene allows, sorted."""
        every = [
            Instruction(name, thing, target)
            for name in relations or RELATIONS
            for thing in self.of_kind(RELATIONS[name].kinds[0])
            for target in self.of_kind(RELATIONS[name].kinds[1])
            if thing.color != target.color
        ]
        return tuple(sorted(every))

    def slots_of(self, thing: Thing) -> tuple[int, ...]:
        """The slots of a thing.

        Raises:
            GroundingError: if the scene has no such thing; the message lists those it has.
        """
        if thing not in self.things:
            seen = ", ".join(str(other) for other in sorted(self.things))
            raise GroundingError(f"no {thing} is seen; seen: {seen or 'nothing'}")
        return self.things[thing]

    def with_kinds(self, things: Iterable[Thing]) -> Grounding:
        """This grounding, with the kinds that language gives these things; those that are not seen are ignored."""
        # A goal that names the red block says that what looks red is a block: no two objects share a colour.
        kinds = {thing.color: thing.kind for thing in things}
        seen = self.things.items()
        renamed = {Thing(one.color, kinds.get(one.color, one.kind)): slots for one, slots in seen}
        return replace(self, things=renamed)

    told = with_kinds  # what it was called: programs of users say it


class Grounder(Protocol):
    """Grounds the first frame of one parsed scene (B = 1)."""

    def __call__(self, parsed: Rollout) -> Grounding: ...


@dataclass(frozen=True)
class AppearanceGrounder:
    """`ground` with the camera and palette of a scene."""

    camera: PinholeCamera
    palette: Palette

    @classmethod
    def from_info(cls, info: Mapping[str, Any]) -> AppearanceGrounder:
        """From `camera` and `palette` of the environments' `info`."""
        return cls(PinholeCamera.from_info(info["camera"]), Palette.from_info(info["palette"]))

    def __call__(self, parsed: Rollout) -> Grounding:
        return ground(parsed, self.camera, self.palette)[0]


@dataclass(frozen=True, eq=False)
class SegmentationGrounder:
    """`ground_by_segmentation` with the truth of a scene."""

    segmentation: Integers
    objects: Sequence[Mapping[str, Any]]
    view: View = CLOSE_VIEW

    @classmethod
    def from_info(cls, info: Mapping[str, Any]) -> SegmentationGrounder:
        """From `segmentation`, `objects` and `camera` of the environments' `info`."""
        return cls(info["segmentation"], info["objects"], View(PinholeCamera.from_info(info["camera"])))

    def __call__(self, parsed: Rollout) -> Grounding:
        return replace(ground_by_segmentation(parsed, self.segmentation, self.objects)[0], view=self.view)


def ground(rollout: Rollout, camera: PinholeCamera, palette: Palette = TABLETOP) -> list[Grounding]:
    """Ground the first frame of every rollout of a batch by appearance: B groundings.

    Each slot takes the nearest colour's name, whatever the light. Slots of one name that touch are one object, and no
    two objects share a name (Hungarian). Its apparent width in metres says of what kind it is.
    """
    colors_BK3, presence_BK = (values[:, 0].cpu().numpy() for values in (rollout.colors, rollout.presence))
    scenes = zip(frame_masks(rollout, 0), colors_BK3, presence_BK >= MIN_PRESENCE, strict=True)
    return [_ground_scene(*scene, View(camera), palette) for scene in scenes]


def _ground_scene(masks_KHW: Bools, colors_K3: Floats, present_K: Bools, view: View, palette: Palette) -> Grounding:
    area_K, zoom = masks_KHW.sum((1, 2)), view.zoom_at_middle
    largest = int(area_K.argmax())
    names = list(palette.colors)
    looks = [*palette.colors.values(), palette.robot, palette.table]
    cost_KN = np.stack([color_distance(colors_K3, color) for color in looks], axis=1)
    nearest_K = cost_KN.argmin(1)
    slots = [k for k in np.flatnonzero(present_K & (area_K >= MIN_PIXELS * zoom**2)).tolist() if k != largest]
    background = (largest, *(k for k in slots if nearest_K[k] > len(names)))
    arm = tuple(k for k in slots if nearest_K[k] == len(names))
    named = [k for k in slots if nearest_K[k] < len(names)]
    groups = _merge_touching(named, nearest_K, masks_KHW, max(1, round(TOUCH_PX * zoom)))
    if not groups:
        return Grounding(background, arm, view=view)
    area_G = np.array([area_K[group].sum() for group in groups])
    cost_GN = np.array([np.average(cost_KN[g, : len(names)], axis=0, weights=area_K[g]) for g in groups])
    things = {}
    # Weighted by area, so that a stray fragment never takes a name away.
    for g, n in zip(*scipy.optimize.linear_sum_assignment(cost_GN * area_G[:, None]), strict=True):
        if n == cost_GN[g].argmin() or cost_GN[g, n] <= SECOND_CHOICE:
            width = apparent_width(np.any(masks_KHW[groups[g]], axis=0), view.camera)
            things[Thing(names[n], "bowl" if width > BOWL_WIDTH else "block")] = tuple(groups[g])
    return Grounding(background, arm, things, view)


def color_distance(colors_N3: Floats, color: Sequence[float]) -> Floats:
    """Distance (N,) of seen colours (N, 3) to a named one (3,), RGB 0..1, under the light that suits it best."""
    reference_3 = np.asarray(color)
    light_N = np.clip(colors_N3 @ reference_3 / (reference_3 @ reference_3), *LIGHT)
    return np.linalg.norm(colors_N3 - light_N[:, None] * reference_3, axis=1)


def apparent_width(mask_HW: Bools, camera: PinholeCamera) -> float:
    """Width in metres, across the line of sight, of the upright box that spreads its pixels as this mask does."""
    y, x = np.nonzero(mask_HW)
    center = np.array([x.mean() + 0.5, y.mean() + 0.5])
    # A uniform bar of width w has standard deviation w / sqrt(12); unlike an outermost pixel this forgives strays.
    return float(12**0.5 * x.std() * camera.metres_per_pixel(center, MIDDLE_HEIGHT))


def _merge_touching(slots: Sequence[int], name_K: Integers, masks_KHW: Bools, apart: int) -> list[list[int]]:
    groups: list[list[int]] = []
    for slot in slots:
        near = scipy.ndimage.binary_dilation(masks_KHW[slot], np.ones((3, 3)), iterations=apart)
        same = [g for g in groups if name_K[g[0]] == name_K[slot] and (near & masks_KHW[g].any(0)).any()]
        merged = sorted([slot, *(other for g in same for other in g)])
        groups = [g for g in groups if g not in same] + [merged]
    return groups


def ground_by_segmentation(
    rollout: Rollout, segmentation: Integers, objects: Sequence[Mapping[str, Any]]
) -> list[Grounding]:
    """Ground the first frame of every rollout by mask overlap with the true segmentation (Hungarian): B groundings.

    Args:
        segmentation: (H, W) or (B, H, W): 0 background, 1 robot, and the objects by their labels.
        objects: `info["objects"]`, each with `label`, `kind` and `color`; one scene for all B.

    Raises:
        ValueError: if the segmentation does not have the rollout's size.
    """
    masks_BKHW = frame_masks(rollout, 0)
    truth_BHW = np.broadcast_to(segmentation, (len(masks_BKHW), *np.shape(segmentation)[-2:]))
    if truth_BHW.shape[1:] != masks_BKHW.shape[2:]:
        raise ValueError(f"segmentation is {truth_BHW.shape[1:]}, the rollout's masks are {masks_BKHW.shape[2:]}")
    labels = [BACKGROUND, ROBOT, *(item["label"] for item in objects)]
    groundings = []
    for masks_KHW, truth_HW in zip(masks_BKHW, truth_BHW, strict=True):
        slots = _slots_of_labels(masks_KHW, truth_HW, labels)
        seen = [item for item in objects if slots[item["label"]]]
        things = {Thing(item["color"], item["kind"]): slots[item["label"]] for item in seen}
        groundings.append(Grounding(slots[BACKGROUND], slots[ROBOT], things))
    return groundings


def _slots_of_labels(masks_KHW: Bools, truth_HW: Integers, labels: Sequence[int]) -> dict[int, tuple[int, ...]]:
    true_NHW = np.stack([truth_HW == label for label in labels])
    overlap_KN = np.einsum("khw,nhw->kn", masks_KHW.astype(np.float32), true_NHW.astype(np.float32))
    union_KN = masks_KHW.sum((1, 2))[:, None] + true_NHW.sum((1, 2)) - overlap_KN
    iou_KN = overlap_KN / np.maximum(union_KN, 1)
    rows, columns = (index.tolist() for index in scipy.optimize.linear_sum_assignment(-iou_KN))
    chosen = {k: n for k, n in zip(rows, columns, strict=True) if iou_KN[k, n] > 0}
    # Slots left over go to whatever covers most of them: the robot and the background may take several.
    most_K = {k: int(overlap_KN[k].argmax()) for k in range(len(masks_KHW)) if overlap_KN[k].any()}
    owner_K = most_K | chosen
    return {label: tuple(sorted(k for k, m in owner_K.items() if m == n)) for n, label in enumerate(labels)}
