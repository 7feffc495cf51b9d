"""From an imagined rollout to robot actions, through the camera and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from .camera import PinholeCamera
from .grounding import Grounding
from .language import Instruction, Thing
from .masks import frame_masks
from .relations import RELATIONS

if TYPE_CHECKING:
    from textocvp.rollout import Rollout

# Metres above the table of the point that the slot of a thing on the table is centred on: the middle of a block, and of
# what is seen of a bowl.
RESTING_HEIGHTS = {"block": 0.029, "bowl": 0.026}


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
    # With it, on the true masks of 100 val scenes, picks are at most 2.6 mm off and places 3.3 mm
    # (`experiments/calibrate.py`).
    pick_height: float = RESTING_HEIGHTS["block"]
    # `WorldModel.outcome`, for models that have one: it says more exactly than a film where the thing ends.
    outcome: Callable[[Rollout, Sequence[str]], Rollout] | None = None

    def act(self, rollout: Rollout, grounding: Grounding, instruction: Instruction) -> PickAndPlace:
        """The action that makes a rollout (B = 1) of this instruction real.

        Raises:
            GroundingError: if the thing is not in the grounding.
            ValueError: if the camera's ray through one of the points does not meet the table.
        """
        slots = grounding.slots_of(instruction.thing)
        ends = rollout if self.outcome is None else self.outcome(rollout.first, [instruction.text])
        start, end = slot_center(rollout, slots, 0), slot_center(ends, slots, ends.slots.shape[1] - 1)
        pick = self.camera.unproject_to_plane(start, self.pick_height)
        place = self.camera.unproject_to_plane(end, RELATIONS[instruction.relation].place_height)
        return PickAndPlace((float(pick[0]), float(pick[1])), (float(place[0]), float(place[1])))


@dataclass(frozen=True)
class LiteralController:
    """Picks where the named thing is seen and places over where the target is seen, whatever was imagined."""

    camera: PinholeCamera

    def act(self, rollout: Rollout, grounding: Grounding, instruction: Instruction) -> PickAndPlace:
        """The action that says what the instruction says; errors as `Controller.act`."""
        points = [self._point(rollout, grounding, one) for one in instruction.things]
        return PickAndPlace(*points)

    def _point(self, rollout: Rollout, grounding: Grounding, thing: Thing) -> tuple[float, float]:
        thing = self._top(rollout, grounding, thing)
        center = slot_center(rollout, grounding.slots_of(thing), 0)
        height = self._height(rollout, grounding, thing, center)
        x, y, _ = self.camera.unproject_to_plane(center, height)
        return float(x), float(y)

    def _top(self, rollout: Rollout, grounding: Grounding, thing: Thing) -> Thing:
        """The top of the pile that a block is in: it hides parts of those below, whose pixels then mislead."""
        on, pile = RELATIONS["on"], [thing]
        while thing.kind == on.kinds[1]:
            below_it = torch.as_tensor(slot_center(rollout, grounding.slots_of(thing), 0))
            off = {
                other: float(on.distance_of_places(torch.as_tensor(center), below_it, grounding.view))
                for other in grounding.of_kind(on.kinds[0])
                if other not in pile
                for center in [slot_center(rollout, grounding.slots_of(other), 0)]
            }
            above = min(off, key=off.__getitem__, default=thing)
            if off.get(above, torch.inf) > on.within_px:
                break
            thing = above
            pile.append(thing)
        return thing

    def _height(self, rollout: Rollout, grounding: Grounding, thing: Thing, center: NDArray[np.float64]) -> float:
        """Metres above the table of the point that a thing's slot is centred on, by what it is seen to stand on."""
        for relation in RELATIONS.values():
            if thing.kind != relation.kinds[0]:
                continue
            for other in grounding.of_kind(relation.kinds[1]):
                below_it = slot_center(rollout, grounding.slots_of(other), 0)
                both = torch.as_tensor(center), torch.as_tensor(below_it)
                off = relation.distance_of_places(*both, grounding.view)
                if other != thing and off <= relation.within_px:
                    below = self._height(rollout, grounding, other, below_it)
                    return below + relation.place_height - RESTING_HEIGHTS[other.kind]
        return RESTING_HEIGHTS[thing.kind]


def slot_center(rollout: Rollout, slots: Sequence[int], frame: int) -> NDArray[np.float64]:
    """Where an object is in one frame of a rollout (B = 1), (x, y) in pixels.

    The position of its slot; of several slots their mean, weighted by the pixels that each of them wins.
    """
    positions_k2 = rollout.positions[0, frame, list(slots)].cpu().double().numpy()
    if len(slots) == 1:
        return positions_k2[0]
    area_k = frame_masks(rollout, frame)[0, list(slots)].sum((1, 2))
    return np.average(positions_k2, axis=0, weights=area_k + 1e-6)
