"""When a rollout counts as success: four numbers, calibrated once on the simulator's own masks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the success criterion, for 64x64 pictures of the `close` camera.

    Attributes:
        arm_block_px: the arm holds the block while the smallest distance between pixels of their masks is at
            most this, in pixels between pixel centres (1 = neighbours).
        hold_frames: for how many consecutive frames it must hold it.
        block_bowl_px: the block lies in the bowl while their masks' centroids are at most this apart, in
            pixels.
        settle_frames: how many last frames of the rollout it must lie there.
    """

    arm_block_px: float
    hold_frames: int
    block_bowl_px: float
    settle_frames: int


# TODO calibrate
THRESHOLDS = Thresholds(arm_block_px=2.0, hold_frames=4, block_bowl_px=4.0, settle_frames=2)
