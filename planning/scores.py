"""From masks to distances, and from distances to success and scores.

`measure` turns the masks of arm, block and bowl into a `Trace` of two distances a frame. Everything else
reads a `Trace`: the `Judge` says whether the instruction was carried out, a `Score` ranks candidates. Scores
compose, and none of them knows where the masks came from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from planning.goals import Instruction
from planning.grounding import Grounding
from planning.thresholds import THRESHOLDS, Thresholds

if TYPE_CHECKING:
    from textocvp.rollout import Rollout

UNSEEN = float("inf")  # the distance to something that no pixel shows


@dataclass(frozen=True, eq=False)
class Trace:
    """Distances along B rollouts, at the t frames that were looked at.

    Attributes:
        frames: (t,) increasing indices of those frames in the rollout.
        arm_block_Bt: smallest distance between a pixel of the arm and a pixel of the block, in pixels; inf in
            frames where one of them is not seen.
        block_bowl_Bt: distance between the centroids of block and bowl, in pixels; inf as above.
    """

    frames: tuple[int, ...]
    arm_block_Bt: Tensor
    block_bowl_Bt: Tensor

    def then(self, later: Trace, length: int) -> Trace:
        """This trace and a later one that starts where this one's rollout of `length` frames ends."""
        return Trace(
            self.frames + tuple(length + frame for frame in later.frames),
            torch.cat([self.arm_block_Bt, later.arm_block_Bt], dim=1),
            torch.cat([self.block_bowl_Bt, later.block_bowl_Bt], dim=1),
        )

    def select(self, index: Sequence[int]) -> Trace:
        """The trace of some of the rollouts."""
        keep = list(index)
        return Trace(self.frames, self.arm_block_Bt[keep], self.block_bowl_Bt[keep])

    def held(self, within: float) -> Tensor:
        """The longest unbroken run of frames with the arm at most `within` pixels from the block, (B,) in
        frames.

        Between two looked-at neighbours that both hold, the frames skipped are taken to hold as well.
        """
        near_Bt = self.arm_block_Bt <= within
        longest_B = torch.zeros(near_Bt.shape[0])
        start_B = torch.zeros(near_Bt.shape[0])
        for i, frame in enumerate(self.frames):
            begins_B = near_Bt[:, i] if i == 0 else near_Bt[:, i] & ~near_Bt[:, i - 1]
            start_B = torch.where(begins_B, float(frame), start_B)
            longest_B = torch.where(near_Bt[:, i], torch.maximum(longest_B, frame - start_B + 1), longest_B)
        return longest_B


def arm_block_distance(arm_NHW: Tensor, block_NHW: Tensor) -> Tensor:
    """Smallest distance between a pixel of one mask and a pixel of the other.

    Args:
        arm_NHW, block_NHW: bool masks (..., H, W).

    Returns:
        (...) in pixels, exact: 0 where they overlap, 1 for neighbours, inf where one is empty.
    """
    lead, (height, width) = arm_NHW.shape[:-2], arm_NHW.shape[-2:]
    arm_NHW, block_NHW = arm_NHW.reshape(-1, height, width), block_NHW.reshape(-1, height, width)
    # First the vertical distance to the arm within each column (two running maxima), then, only at the
    # block's few pixels, the best column: an exact distance transform evaluated where it is needed.
    rows_H1 = torch.arange(height, dtype=torch.float32)[:, None]
    far = 4.0 * (height + width)
    above_NHW = rows_H1 - torch.where(arm_NHW, rows_H1, -far).cummax(1).values
    below_NHW = torch.where(arm_NHW, rows_H1, far + height).flip(1).cummin(1).values.flip(1) - rows_H1
    vertical_NHW = torch.minimum(above_NHW, below_NHW)
    n, y, x = block_NHW.nonzero(as_tuple=True)
    across_PW = x[:, None].float() - torch.arange(width, dtype=torch.float32)
    squared_P = (vertical_NHW[n, y].square() + across_PW.square()).amin(1)
    squared_N = torch.full((len(arm_NHW),), UNSEEN).scatter_reduce(0, n, squared_P, "amin")
    squared_N[~arm_NHW.flatten(1).any(1)] = UNSEEN
    return squared_N.sqrt().reshape(lead)


def centroids(masks_NHW: Tensor) -> Tensor:
    """Centres of mass (x, y) of masks (..., H, W), in pixels, (..., 2); NaN for an empty mask."""
    height, width = masks_NHW.shape[-2:]
    masks_NHW = masks_NHW.float()
    area_N = masks_NHW.sum((-2, -1))
    x_N = (masks_NHW.sum(-2) * (torch.arange(width) + 0.5)).sum(-1) / area_N
    y_N = (masks_NHW.sum(-1) * (torch.arange(height) + 0.5)).sum(-1) / area_N
    return torch.stack([x_N, y_N], dim=-1)


def block_bowl_distance(block_NHW: Tensor, bowl_NHW: Tensor) -> Tensor:
    """Distance between the centroids of two bool masks (..., H, W), in pixels; inf where one is empty:
    (...).
    """
    return (centroids(block_NHW) - centroids(bowl_NHW)).norm(dim=-1).nan_to_num(nan=UNSEEN)


def measure(
    arm_BtHW: Tensor, block_BtHW: Tensor, bowl_BtHW: Tensor, frames: Sequence[int] | None = None
) -> Trace:
    """The trace of B clips whose bool masks (B, t, H, W) of arm, block and bowl are given.

    Args:
        frames: which frames of the rollout the t masks show; by default 0..t-1.

    Raises:
        ValueError: if the shapes differ or are not (B, t, H, W).
    """
    if not (arm_BtHW.shape == block_BtHW.shape == bowl_BtHW.shape) or arm_BtHW.ndim != 4:
        raise ValueError(
            f"masks must share one shape (B, t, H, W), got arm {tuple(arm_BtHW.shape)}, "
            f"block {tuple(block_BtHW.shape)}, bowl {tuple(bowl_BtHW.shape)}"
        )
    return Trace(
        tuple(range(arm_BtHW.shape[1]) if frames is None else frames),
        arm_block_distance(arm_BtHW, block_BtHW),
        block_bowl_distance(block_BtHW, bowl_BtHW),
    )


def measure_rollout(
    rollout: Rollout,
    groundings: Grounding | Sequence[Grounding],
    instructions: Instruction | Sequence[Instruction],
    *,
    frames: Sequence[int] | None = None,
) -> Trace:
    """The trace of a batch of rollouts, each with respect to one instruction (not necessarily the one
    imagined).

    Args:
        groundings: which slot is what; one for all B rollouts, or one each.
        instructions: whose block and bowl to watch; one for all, or one each.
        frames: the frames to decode masks of; by default all.

    Raises:
        ValueError: if there is neither one grounding (instruction) nor B.
        GroundingError: if a grounding does not have the block or bowl.
    """
    batch, length = rollout.slots.shape[:2]
    each_grounding = [groundings] * batch if isinstance(groundings, Grounding) else list(groundings)
    each_instruction = [instructions] * batch if isinstance(instructions, Instruction) else list(instructions)
    for values, name in ((each_grounding, "groundings"), (each_instruction, "instructions")):
        if len(values) != batch:
            raise ValueError(f"{batch} rollouts need one or {batch} {name}, got {len(values)}")
    frames = tuple(range(length) if frames is None else frames)
    num_slots = rollout.slots.shape[2]
    winner_BtHW = rollout.decode_masks(frames).argmax(2).cpu()  # which slot each pixel belongs to

    def union(slots_of_B: Sequence[Sequence[int]]) -> Tensor:
        member_BK = torch.zeros(batch, num_slots, dtype=torch.bool)
        for b, slots in enumerate(slots_of_B):
            member_BK[b, list(slots)] = True
        return member_BK.gather(1, winner_BtHW.flatten(1)).view_as(winner_BtHW)

    both = list(zip(each_grounding, each_instruction, strict=True))
    return measure(
        union([grounding.arm for grounding in each_grounding]),
        union([grounding.find(instruction.block_thing) for grounding, instruction in both]),
        union([grounding.find(instruction.bowl_thing) for grounding, instruction in both]),
        frames,
    )


@dataclass(frozen=True)
class Judge:
    """Says of each rollout of a trace whether the instruction was carried out.

    The criterion of the paper's controllability study (section 4.4): the arm stays at the named block for
    some frames in a row, and the block ends in the named bowl. Look at every frame for the criterion as
    calibrated.
    """

    thresholds: Thresholds = THRESHOLDS

    def __call__(self, trace: Trace) -> Tensor:
        """Success, (B,) bool."""
        limits = self.thresholds
        settled_Bt = trace.block_bowl_Bt[:, -limits.settle_frames :] <= limits.block_bowl_px
        return (trace.held(limits.arm_block_px) >= limits.hold_frames) & settled_Bt.all(1)


class Score(Protocol):
    """Ranks rollouts."""

    def __call__(self, trace: Trace) -> Tensor:
        """One score a rollout, (B,); higher is better, 1 is as good as it gets."""
        ...


@dataclass(frozen=True)
class PlacementScore:
    """How near the bowl the block ends: 1 at its centre, 0 at the limit of success, negative beyond."""

    thresholds: Thresholds = THRESHOLDS
    floor: float = -10.0

    def __call__(self, trace: Trace) -> Tensor:
        """The mean over the last `settle_frames` looked-at frames, (B,)."""
        distance_Bt = trace.block_bowl_Bt[:, -self.thresholds.settle_frames :]
        return (1 - distance_Bt.mean(1) / self.thresholds.block_bowl_px).clamp(min=self.floor)


@dataclass(frozen=True)
class CarryScore:
    """How long the arm holds the block, as a share of `hold_frames`, at most 1."""

    thresholds: Thresholds = THRESHOLDS

    def __call__(self, trace: Trace) -> Tensor:
        return (trace.held(self.thresholds.arm_block_px) / self.thresholds.hold_frames).clamp(max=1)


@dataclass(frozen=True)
class WeightedSum:
    """The weighted mean of other scores."""

    scores: tuple[Score, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.scores) != len(self.weights) or sum(self.weights) <= 0:
            raise ValueError(
                f"{len(self.scores)} scores need as many weights with a positive sum: {self.weights}"
            )

    def __call__(self, trace: Trace) -> Tensor:
        parts = [weight * score(trace) for score, weight in zip(self.scores, self.weights, strict=True)]
        return torch.stack(parts).sum(0) / sum(self.weights)
