"""Which slot is what, told by how the slots of the first frame look.

Nothing is learned here and nothing comes from the simulator: a slot's colour is compared with a table of colour names
and with the robot's own colour, its apparent size becomes metres through the camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from planning.camera import PinholeCamera
from planning.goals import Instruction, Thing

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


class GroundingError(RuntimeError):
    """The scene does not show what was asked for."""


@dataclass(frozen=True)
class Grounding:
    """Which slots of one scene are what. Slots keep their index over a rollout, so this holds for all its frames.

    Attributes:
        background: slots that show table and floor.
        arm: slots that show the robot (their union is the arm).
        things: the slots of every named object, usually one, two where a lit and a shaded side were parsed apart.
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
        raise NotImplementedError

    def told(self, things: Iterable[Thing]) -> Grounding:
        """This grounding, with the kinds of these things taken from language.

        A goal that names the red block says that what looks red is a block: no two objects of a scene share a colour.
        Colours that the scene does not show are left out.
        """
        raise NotImplementedError


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
    slots_K11 = torch.arange(masks_NKHW.shape[-3])[:, None, None]
    return winner_N1HW == slots_K11


def ground(rollout: Rollout, camera: PinholeCamera) -> list[Grounding]:
    """Ground the first frame of every rollout of a batch by appearance: B groundings.

    Args:
        camera: the camera of the scene, for the metric size of what the slots show.
    """
    raise NotImplementedError
