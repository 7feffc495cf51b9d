"""Which slot is what, told by how the slots of the first frame look.

Nothing is learned here and nothing comes from the simulator: a slot's colour is compared with a table of
colour names and with the robot's own colour, its apparent size becomes metres through the camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from planning.camera import PinholeCamera
from planning.goals import Instruction, Thing

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


#: The public palette: colour name -> RGB 0..1 (CLIPort's tasks; the paper's captions use its names).
COLORS: dict[str, tuple[float, float, float]] = {
    name: (red / 255, green / 255, blue / 255)
    for name, (red, green, blue) in {
        "blue": (78, 121, 167),
        "green": (89, 169, 79),
        "red": (255, 87, 89),
        "brown": (156, 117, 95),
        "cyan": (118, 183, 178),
        "gray": (186, 176, 172),
        "yellow": (237, 201, 72),
        "pink": (255, 157, 167),
        "purple": (176, 122, 161),
        "white": (255, 255, 255),
        "orange": (242, 142, 43),
    }.items()
}

#: The robot knows how it looks itself, and the table that it stands at. RGB 0..1.
ROBOT_COLOR = (105 / 255, 72 / 255, 240 / 255)
TABLE_COLOR = (47 / 255, 47 / 255, 47 / 255)

#: A surface shows its colour times the light on it, which lies between these in the tabletop scenes.
LIGHT = (0.7, 1.05)

#: To get a name that is not its nearest, a slot may be at most this far from it (Euclidean, RGB 0..1).
SECOND_CHOICE = 0.25

#: A slot must be present this much, and win this many pixels, to be looked at.
MIN_PRESENCE, MIN_PIXELS = 0.5, 6

#: Slots of one colour name belong to one object when their pixels are at most this far apart.
TOUCH_PX = 2

#: What looks wider than this, in metres, is a bowl. In the first and last frames of 200 val episodes blocks look
#: 0.054 to 0.076 wide and bowls 0.115 to 0.149 (`experiments/calibrate.py`).
BOWL_WIDTH = 0.095

#: Height above the table, in metres, at which apparent sizes are measured.
MIDDLE_HEIGHT = 0.03


class GroundingError(LookupError):
    """The scene does not show what was asked for."""


@dataclass(frozen=True)
class Grounding:
    """Which slots of one scene are what. Slots keep their index over a rollout, so this holds for all its
    frames.

    Attributes:
        background: slots that show table and floor.
        arm: slots that show the robot (their union is the arm).
        things: the slots of every named object, usually one, two where a lit and a shaded side were parsed
            apart.
    """

    background: tuple[int, ...]
    arm: tuple[int, ...]
    things: Mapping[Thing, tuple[int, ...]] = field(default_factory=dict)

    @property
    def blocks(self) -> tuple[str, ...]:
        """Colour names of the blocks, sorted."""
        return tuple(sorted(thing.color for thing in self.things if thing.kind == "block"))

    @property
    def bowls(self) -> tuple[str, ...]:
        """Colour names of the bowls, sorted."""
        return tuple(sorted(thing.color for thing in self.things if thing.kind == "bowl"))

    @property
    def instructions(self) -> tuple[Instruction, ...]:
        """Every block x bowl instruction of the scene, sorted."""
        return tuple(Instruction(block, bowl) for block in self.blocks for bowl in self.bowls)

    def find(self, thing: Thing) -> tuple[int, ...]:
        """The slots of a thing.

        Raises:
            GroundingError: if the scene has no such thing; the message lists those it has.
        """
        if thing not in self.things:
            seen = ", ".join(f"{other.color} {other.kind}" for other in sorted(self.things))
            raise GroundingError(f"no {thing.color} {thing.kind} is seen; seen: {seen or 'nothing'}")
        return self.things[thing]

    def told(self, things: Iterable[Thing]) -> Grounding:
        """This grounding, with the kinds of these things taken from language.

        A goal that names the red block says that what looks red is a block: no two objects of a scene share a
        colour. Colours that the scene does not show are left out.
        """
        kinds = {thing.color: thing.kind for thing in things}
        told = {
            Thing(seen.color, kinds.get(seen.color, seen.kind)): slots for seen, slots in self.things.items()
        }
        return replace(self, things=told)


class Grounder(Protocol):
    """Anything that grounds the first frame of one parsed scene."""

    def __call__(self, parsed: Rollout) -> Grounding: ...


@dataclass(frozen=True)
class AppearanceGrounder:
    """`ground` for one scene, with the camera and the robot's self-knowledge bound."""

    camera: PinholeCamera

    def __call__(self, parsed: Rollout) -> Grounding:
        return ground(parsed, self.camera)[0]


def hard_masks(masks_NKHW: Tensor) -> Tensor:
    """Soft masks (..., K, H, W) -> bool masks: each pixel belongs to the slot with the largest share."""
    winner_N1HW = masks_NKHW.argmax(-3, keepdim=True)
    slots_K11 = torch.arange(masks_NKHW.shape[-3], device=masks_NKHW.device)[:, None, None]
    return winner_N1HW == slots_K11


def ground(rollout: Rollout, camera: PinholeCamera) -> list[Grounding]:
    """Ground the first frame of every rollout of a batch by appearance: B groundings.

    Colours: each slot takes the nearest name, whatever the light; slots of one name that touch are one
        object; no two
    objects share a name (Hungarian). Kind: by apparent width in metres.

    Args:
        camera: the camera of the scene, for the metric size of what the slots show.
    """
    masks_BKHW = hard_masks(rollout.decode_masks([0])[:, 0]).cpu().numpy()
    colors_BK3 = rollout.colors[:, 0].cpu().numpy()
    present_BK = rollout.presence[:, 0].cpu().numpy() >= MIN_PRESENCE
    return [
        _ground_scene(masks, colors, present, camera)
        for masks, colors, present in zip(masks_BKHW, colors_BK3, present_BK, strict=True)
    ]


def _ground_scene(
    masks_KHW: NDArray[np.bool_],
    colors_K3: NDArray[np.floating],
    present_K: NDArray[np.bool_],
    camera: PinholeCamera,
) -> Grounding:
    area_K = masks_KHW.sum((1, 2))
    background, arm = [int(area_K.argmax())], []
    palette = [*COLORS.values(), ROBOT_COLOR, TABLE_COLOR]
    cost_KN = np.stack([color_distance(colors_K3, color) for color in palette], axis=1)
    nearest_K = cost_KN.argmin(1)
    named: list[int] = []
    for slot in np.flatnonzero(present_K & (area_K >= MIN_PIXELS)).tolist():
        if slot == background[0]:
            continue
        if nearest_K[slot] == len(COLORS):
            arm.append(slot)
        elif nearest_K[slot] > len(COLORS):
            background.append(slot)
        else:
            named.append(slot)
    groups = _merge_touching(named, nearest_K, masks_KHW)
    # One name an object: the assignment is weighted by area, so that a stray fragment never takes a name
    # away.
    area_G = np.array([area_K[group].sum() for group in groups])
    cost_GN = np.array(
        [np.average(cost_KN[group, : len(COLORS)], axis=0, weights=area_K[group]) for group in groups]
    )
    things = {}
    if groups:
        names = list(COLORS)
        for g, n in zip(*linear_sum_assignment(cost_GN * area_G[:, None]), strict=True):
            if n == cost_GN[g].argmin() or cost_GN[g, n] <= SECOND_CHOICE:
                width = apparent_width(np.any(masks_KHW[groups[g]], axis=0), camera)
                things[Thing(names[n], "bowl" if width > BOWL_WIDTH else "block")] = tuple(groups[g])
    return Grounding(tuple(background), tuple(arm), things)


def color_distance(colors_N3: NDArray[np.floating], color: Sequence[float]) -> NDArray[np.floating]:
    """Distance (N,) of seen colours (N, 3) to a named one (3,) in RGB 0..1, under the light that suits it
    best.
    """
    reference_3 = np.asarray(color)
    light_N = np.clip(colors_N3 @ reference_3 / (reference_3 @ reference_3), *LIGHT)
    return np.linalg.norm(colors_N3 - light_N[:, None] * reference_3, axis=1)


def apparent_width(mask_HW: NDArray[np.bool_], camera: PinholeCamera) -> float:
    """Width in metres, across the line of sight, of the upright box that spreads its pixels as this mask
    does.
    """
    y, x = np.nonzero(mask_HW)
    center = np.array([x.mean() + 0.5, y.mean() + 0.5])
    # A uniform bar of width w has standard deviation w / sqrt(12); unlike an outermost pixel this forgives
    # strays.
    return float(12**0.5 * x.std() * camera.metres_per_pixel(center, MIDDLE_HEIGHT))


def _merge_touching(
    slots: Sequence[int], name_K: NDArray[np.integer], masks_KHW: NDArray[np.bool_]
) -> list[list[int]]:
    groups: list[list[int]] = []
    for slot in slots:
        near = binary_dilation(masks_KHW[slot], np.ones((3, 3)), iterations=TOUCH_PX)
        same = [g for g in groups if name_K[g[0]] == name_K[slot] and (near & masks_KHW[g].any(0)).any()]
        groups = [g for g in groups if g not in same] + [
            sorted([slot, *(other for g in same for other in g)])
        ]
    return groups
