"""What of a goal is reached already, as far as the planner can see."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from planning.goals import Goal, Instruction
from planning.grounding import Grounding, hard_masks

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


def open_pairs(parsed: Rollout, grounding: Grounding, goal: Goal) -> tuple[Instruction, ...]:
    """The pairs of a goal that are not reached in the first frame of a parsed observation (B = 1).

    Raises:
        GroundingError: if a block or bowl of the goal is not seen.
    """
    masks_KHW = hard_masks(parsed.decode_masks([0])[0, 0]).cpu().numpy()
    return tuple(pair for pair in goal.pairs if not lies_in(masks_KHW, grounding, pair))


def goal_reached(parsed: Rollout, grounding: Grounding, goal: Goal) -> bool:
    """Whether every block of the goal is seen in its bowl.

    Raises:
        GroundingError: if a block or bowl of the goal is not seen.
    """
    return not open_pairs(parsed, grounding, goal)


def contents(masks_KHW: NDArray[np.bool_], grounding: Grounding) -> dict[str, set[str]]:
    """Which blocks are seen to lie in which bowl, in the bool masks (K, H, W) of one frame.

    Returns:
        The colour of every bowl -> the colours of the blocks in it.
    """
    pairs = {
        bowl: [Instruction(block, bowl) for block in grounding.blocks if block != bowl]
        for bowl in grounding.bowls
    }
    return {
        bowl: {pair.block for pair in into if lies_in(masks_KHW, grounding, pair)}
        for bowl, into in pairs.items()
    }


def lies_in(masks_KHW: NDArray[np.bool_], grounding: Grounding, pair: Instruction) -> bool:
    """Whether the pair's block is seen in its bowl, in the bool masks (K, H, W) of one frame.

    Its centroid must lie within the convex outline of the bowl's pixels: the outline, because a block hides
    part of the bowl that it lies in.
    """
    block_HW = masks_KHW[list(grounding.find(pair.block_thing))].any(0)
    bowl_HW = masks_KHW[list(grounding.find(pair.bowl_thing))].any(0)
    if not block_HW.any() or bowl_HW.sum() < 3:
        return False
    try:
        sides_n3 = ConvexHull(np.argwhere(bowl_HW)).equations
    except QhullError:  # the bowl's pixels are all on one line
        return False
    return bool((sides_n3[:, :2] @ np.argwhere(block_HW).mean(0) + sides_n3[:, 2] <= 0).all())
