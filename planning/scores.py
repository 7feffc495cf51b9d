"""What masks say: whether instructions hold in a frame, and how well a rollout fulfils them.

`unmet` looks at one frame. `measure` turns the masks of a rollout into a `Trace` of two distances a frame. From that
`succeeds` tells whether the instruction was carried out, and `score` ranks candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from .camera import View
from .grounding import Grounding
from .language import Goal, Instruction
from .masks import Bools, centroids, contact_distance, frame_masks
from .relations import CLOSE_VIEW, RELATIONS, THRESHOLDS, Thresholds

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


def holds(masks_KHW: Bools, grounding: Grounding, instruction: Instruction) -> bool:
    """Whether bool masks (K, H, W) show what an instruction asks for; a GroundingError if its things are not seen."""
    thing_HW, target_HW = (np.any(masks_KHW[list(grounding.slots_of(one))], axis=0) for one in instruction.things)
    return RELATIONS[instruction.relation].shown(thing_HW, target_HW, grounding.view)


def unmet(parsed: Rollout, grounding: Grounding, goal: Goal) -> tuple[Instruction, ...]:
    """The instructions of a goal that do not hold in the first frame of a parsed observation (B = 1).

    Raises:
        GroundingError: if a thing of the goal is not seen.
    """
    masks_KHW = frame_masks(parsed, 0)[0]
    return tuple(one for one in goal.instructions if not holds(masks_KHW, grounding, one))


@dataclass(frozen=True, eq=False)
class Trace:
    """Distances along B rollouts at t frames, in pixels of a `View`; inf where one of the two is not seen."""

    frames: tuple[int, ...]  # (t,), increasing indices in the rollout
    contact_Bt: Tensor  # between arm and thing: `contact_distance`
    distance_Bt: Tensor  # how far thing and target are from the relation: `Relation.distance`
    within_B: Tensor  # up to which distance it is fulfilled: `Relation.within_px`

    def then(self, later: Trace, length: int) -> Trace:
        """This trace and a later one that starts where this one's rollout of `length` frames ends."""
        return Trace(
            self.frames + tuple(length + frame for frame in later.frames),
            torch.cat([self.contact_Bt, later.contact_Bt], dim=1),
            torch.cat([self.distance_Bt, later.distance_Bt], dim=1),
            self.within_B,
        )

    def select(self, index: Sequence[int]) -> Trace:
        """The trace of some of the rollouts."""
        keep = list(index)
        return Trace(self.frames, self.contact_Bt[keep], self.distance_Bt[keep], self.within_B[keep])

    def longest_contact(self, within: float) -> Tensor:
        """The longest unbroken run with the arm at most `within` pixels from the thing, (B,) in frames.

        Between two looked-at neighbours that both touch, the frames skipped are taken to touch as well.
        """
        near_Bt = self.contact_Bt <= within
        longest_B = torch.zeros(near_Bt.shape[0])
        start_B = torch.zeros(near_Bt.shape[0])
        for i, frame in enumerate(self.frames):
            begins_B = near_Bt[:, i] if i == 0 else near_Bt[:, i] & ~near_Bt[:, i - 1]
            start_B = torch.where(begins_B, float(frame), start_B)
            longest_B = torch.where(near_Bt[:, i], torch.maximum(longest_B, frame - start_B + 1), longest_B)
        return longest_B


def measure(
    arm_BtHW: Tensor,
    thing_BtHW: Tensor,
    target_BtHW: Tensor,
    relations: Sequence[str],
    frames: Sequence[int] | None = None,
    views: Sequence[View] = (),
) -> Trace:
    """The trace of B clips whose bool masks (B, t, H, W) of arm, thing and target are given.

    Args:
        relations: B keys of `RELATIONS`.
        frames: which frames of the rollout the t masks show; by default 0..t-1.
        views: of the B clips; by default all are of the `close` camera at 64x64.

    Raises:
        ValueError: if the shapes differ or are not (B, t, H, W).
    """
    if not (arm_BtHW.shape == thing_BtHW.shape == target_BtHW.shape) or arm_BtHW.ndim != 4:
        raise ValueError(
            f"masks must share one shape (B, t, H, W), got arm {tuple(arm_BtHW.shape)}, "
            f"thing {tuple(thing_BtHW.shape)}, target {tuple(target_BtHW.shape)}"
        )
    contact_Bt, distance_Bt = contact_distance(arm_BtHW, thing_BtHW), torch.empty(arm_BtHW.shape[:2])
    kinds = list(zip(relations, views or [CLOSE_VIEW] * len(relations), strict=True))
    for name, view in set(kinds):
        rows = [row for row, other in enumerate(kinds) if other == (name, view)]
        distance_Bt[rows] = RELATIONS[name].distance(thing_BtHW[rows], target_BtHW[rows], view)
        contact_Bt[rows] /= view.zoom(centroids(thing_BtHW[rows]))
    return Trace(
        tuple(range(arm_BtHW.shape[1]) if frames is None else frames),
        contact_Bt,
        distance_Bt,
        torch.tensor([RELATIONS[name].within_px for name in relations]),
    )


def measure_rollout(
    rollout: Rollout,
    groundings: Grounding | Sequence[Grounding],
    instructions: Instruction | Sequence[Instruction],
    *,
    frames: Sequence[int] | None = None,
) -> Trace:
    """The trace of a batch of rollouts, each for one instruction (not necessarily the one imagined).

    Args:
        groundings: which slot is what; one for all B rollouts, or one each.
        instructions: whose thing and target to watch; one for all, or one each.
        frames: the frames to decode masks of; by default all.

    Raises:
        ValueError: if there is neither one grounding (instruction) nor B.
        GroundingError: if a grounding does not have the thing or target.
    """
    batch, length = rollout.slots.shape[:2]
    each_grounding = [groundings] * batch if isinstance(groundings, Grounding) else list(groundings)
    each_instruction = [instructions] * batch if isinstance(instructions, Instruction) else list(instructions)
    for values, name in ((each_grounding, "groundings"), (each_instruction, "instructions")):
        if len(values) != batch:
            raise ValueError(f"{batch} rollouts need one or {batch} {name}, got {len(values)}")
    frames = tuple(range(length) if frames is None else frames)
    masks_BtKHW = rollout.decode_masks(frames).cpu()
    largest_BtHW = masks_BtKHW.amax(2)
    rows_B1 = torch.arange(batch)[:, None]

    def union(slots_of_B: Sequence[Sequence[int]]) -> Tensor:
        """The pixels (B, t, H, W) that some of a rollout's given slots win."""
        most = max(1, *(len(slots) for slots in slots_of_B))
        index_Bn = torch.tensor([[*slots, *[-1] * (most - len(slots))] for slots in slots_of_B])
        share_BntHW = masks_BtKHW[rows_B1, :, index_Bn]
        share_BntHW[index_Bn < 0] = -1.0  # a thing may have fewer slots than another, or none
        return share_BntHW.amax(1) == largest_BtHW

    both = list(zip(each_grounding, each_instruction, strict=True))
    return measure(
        union([grounding.arm for grounding in each_grounding]),
        union([grounding.slots_of(instruction.thing) for grounding, instruction in both]),
        union([grounding.slots_of(instruction.target) for grounding, instruction in both]),
        [instruction.relation for instruction in each_instruction],
        frames,
        [grounding.view for grounding in each_grounding],
    )


def succeeds(trace: Trace, limits: Thresholds = THRESHOLDS) -> Tensor:
    """Whether each rollout of a trace carried the instruction out, (B,) bool (paper, section 4.4).

    It did if the arm stays at the thing for some frames in a row, and the thing ends as asked for. The thresholds are
    calibrated for traces of every frame.
    """
    settled_Bt = trace.distance_Bt[:, -limits.settle_frames :] <= trace.within_B[:, None]
    return (trace.longest_contact(limits.contact_px) >= limits.contact_frames) & settled_Bt.all(1)


def placement_score(trace: Trace, limits: Thresholds = THRESHOLDS) -> Tensor:
    """How near the relation is at the end (B,): 1 at distance 0, 0 at the limit of success, and down to -10 beyond.

    It is the mean over the last `settle_frames` looked-at frames.
    """
    distance_Bt = trace.distance_Bt[:, -limits.settle_frames :]
    return (1 - distance_Bt.mean(1) / trace.within_B).clamp(min=-10.0)


def carry_score(trace: Trace, limits: Thresholds = THRESHOLDS) -> Tensor:
    """How long the arm holds the thing (B,), as a share of `contact_frames`, at most 1."""
    return (trace.longest_contact(limits.contact_px) / limits.contact_frames).clamp(max=1)


def score(trace: Trace) -> Tensor:
    """What ranks rollouts (B,): higher is better, 1 is as good as it gets."""
    return 0.8 * placement_score(trace) + 0.2 * carry_score(trace)
