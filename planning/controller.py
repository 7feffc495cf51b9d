"""From an imagined rollout to robot actions, through the camera and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from planning.camera import PinholeCamera
from planning.goals import Instruction
from planning.grounding import Grounding

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
    """Reads pick and place points off a rollout: where the block's slot starts, and where it ends.

    Attributes:
        camera: of the scene.
        pick_height: height above the table, in metres, of the point that a block's slot is centred on when it stands.
        place_height: the same when it lies in a bowl.
    """

    camera: PinholeCamera
    pick_height: float = 0.03
    place_height: float = 0.03

    def act(self, rollout: Rollout, grounding: Grounding, instruction: Instruction) -> PickAndPlace:
        """The action that makes an imagined rollout (B = 1) real.

        Args:
            instruction: the one that was imagined; its block is the one that moves.
        """
        raise NotImplementedError
