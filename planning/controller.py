"""From an imagined rollout to robot actions, through the camera and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from planning.camera import PinholeCamera
from planning.grounding import Grounding
from planning.language import Instruction
from planning.masks import frame_masks
from planning.relations import RELATIONS

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


@dataclass(frozen=True)
class PickAndPlace:
    """Where to pick and where to place, (x, y) in metres on the table."""

    pick: tuple[float, float]
    place: tuple[float, float]

    def to_action(self) -> NDArray[np.float32]:
        """The `primitive` action [pick_x, pick_y, place_x, place_y] of the environments."""
        return np.array([*self.pick, *self.place], dtype=np.float32)


@dataclass(frozen=True)
class Controller:
    """Reads pick and place points off a rollout: where the thing's slot starts, and where it ends."""

    camera: PinholeCamera
    # Metres above the table of the point that the slot of a thing is centred on: the middle of a block. With it, on the
    # true masks of 100 val scenes, picks are at most 2.6 mm off and places 3.3 mm (`experiments/calibrate.py`).
    pick_height: float = 0.029

    def act(self, rollout: Rollout, grounding: Grounding, instruction: Instruction) -> PickAndPlace:
        """The action that makes a rollout (B = 1) of this instruction real.

        Raises:
            GroundingError: if the thing is not in the grounding.
            ValueError: if the camera's ray through one of the points does not meet the table.
        """
        slots = grounding.slots_of(instruction.thing)
        start, end = (slot_center(rollout, slots, frame) for frame in (0, rollout.slots.shape[1] - 1))
        pick = self.camera.unproject_to_plane(start, self.pick_height)
        place = self.camera.unproject_to_plane(end, RELATIONS[instruction.relation].place_height)
        return PickAndPlace((float(pick[0]), float(pick[1])), (float(place[0]), float(place[1])))


def slot_center(rollout: Rollout, slots: Sequence[int], frame: int) -> NDArray[np.float64]:
    """Where an object is in one frame of a rollout (B = 1), (x, y) in pixels.

    The position of its slot; of several slots their mean, weighted by the pixels that each of them wins.
    """
    positions_k2 = rollout.positions[0, frame, list(slots)].double().cpu().numpy()
    if len(slots) == 1:
        return positions_k2[0]
    area_k = frame_masks(rollout, frame)[0, list(slots)].sum((1, 2))
    return np.average(positions_k2, axis=0, weights=area_k + 1e-6)
