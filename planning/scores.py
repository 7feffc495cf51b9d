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
        """The longest unbroken run with the arm at most `within` pixels from the block, (B,) in frames.

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
    lead, size = arm_NHW.shape[:-2], arm_NHW.shape[-2:]
    arm_NHW, block_NHW = arm_NHW.reshape(-1, *size), block_NHW.reshape(-1, *size)
    # Two disjoint shapes are nearest to each other at their outlines, which are few pixels.
    arm_NP2, block_NQ2 = outline_points(arm_NHW, UNSEEN), outline_points(block_NHW, -UNSEEN)
    gap_N = torch.full((len(arm_NHW),), UNSEEN)
    if arm_NP2.shape[1] and block_NQ2.shape[1]:
        rows_NPQ, columns_NPQ = (arm_NP2[:, :, None, i] - block_NQ2[:, None, :, i] for i in (0, 1))
        gap_N = (rows_NPQ.square_() + columns_NPQ.square_()).flatten(1).amin(1).sqrt()
    overlap_N = (arm_NHW & block_NHW).flatten(1).any(1)
    return gap_N.masked_fill(overlap_N, 0.0).reshape(lead)


def outline_points(masks_NHW: Tensor, filler: float) -> Tensor:
    """Rows and columns (N, P, 2) of those pixels of bool masks (N, H, W) that have a neighbour outside.

    P is what the longest outline needs; shorter ones are filled up with `filler`.
    """
    inner_NHW = masks_NHW.clone()
    inner_NHW[:, [0, -1]], inner_NHW[:, :, [0, -1]] = False, False
    inner_NHW[:, 1:-1, 1:-1] &= masks_NHW[:, 2:, 1:-1] & masks_NHW[:, :-2, 1:-1]
    inner_NHW[:, 1:-1, 1:-1] &= masks_NHW[:, 1:-1, 2:] & masks_NHW[:, 1:-1, :-2]
    n, y, x = (masks_NHW & ~inner_NHW).nonzero(as_tuple=True)
    count_N = torch.bincount(n, minlength=len(masks_NHW))
    place = torch.arange(len(n)) - (count_N.cumsum(0) - count_N)[n]
    points_NP2 = torch.full((len(masks_NHW), int(count_N.max()) if len(count_N) else 0, 2), filler)
    points_NP2[n, place] = torch.stack([y, x], dim=1).float()
    return points_NP2


def centroids(masks_NHW: Tensor) -> Tensor:
    """Centres of mass (x, y) of masks (..., H, W), in pixels, (..., 2); NaN for an empty mask."""
    height, width = masks_NHW.shape[-2:]
    masks_NHW = masks_NHW.float()
    area_N = masks_NHW.sum((-2, -1))
    x_N = (masks_NHW.sum(-2) * (torch.arange(width) + 0.5)).sum(-1) / area_N
    y_N = (masks_NHW.sum(-1) * (torch.arange(height) + 0.5)).sum(-1) / area_N
    return torch.stack([x_N, y_N], dim=-1)


def block_bowl_distance(block_NHW: Tensor, bowl_NHW: Tensor) -> Tensor:
    """Distance (...) between the centroids of two bool masks (..., H, W), in pixels; inf if one is empty."""
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
    """The trace of a batch of rollouts, each for one instruction (not necessarily the one imagined).

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
