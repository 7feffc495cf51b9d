"""Pixels: which slot wins them, where masks are, and how far apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy  # its parts are loaded when they are first used
import torch
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from textocvp.rollout import Rollout

Bools = NDArray[np.bool_]
UNSEEN = float("inf")  # the distance to something that no pixel shows


def hard_masks(masks_NKHW: Tensor) -> Tensor:
    """Soft masks (..., K, H, W) -> bool masks: each pixel belongs to the slot with the largest share."""
    winner_N1HW = masks_NKHW.argmax(-3, keepdim=True)
    slots_K11 = torch.arange(masks_NKHW.shape[-3], device=masks_NKHW.device)[:, None, None]
    return winner_N1HW == slots_K11


def frame_masks(rollout: Rollout, frame: int) -> Bools:
    """The hard masks (B, K, H, W) of one frame of a batch of rollouts."""
    return hard_masks(rollout.decode_masks([frame])[:, 0]).cpu().numpy()


def centroids(masks_NHW: Tensor) -> Tensor:
    """Centres of mass (x, y) of masks (..., H, W), in pixels, (..., 2); NaN for an empty mask."""
    height, width = masks_NHW.shape[-2:]
    masks_NHW = masks_NHW.float()
    area_N = masks_NHW.sum((-2, -1))
    x_N = (masks_NHW.sum(-2) * (torch.arange(width) + 0.5)).sum(-1) / area_N
    y_N = (masks_NHW.sum(-1) * (torch.arange(height) + 0.5)).sum(-1) / area_N
    return torch.stack([x_N, y_N], dim=-1)


def contact_distance(a_NHW: Tensor, b_NHW: Tensor) -> Tensor:
    """Smallest distance (...) between the pixels of two bool masks (..., H, W), in pixels between pixel centres.

    Exact: 0 where they overlap, 1 for neighbours, inf where one is empty.
    """
    lead, size = a_NHW.shape[:-2], a_NHW.shape[-2:]
    a_NHW, b_NHW = a_NHW.reshape(-1, *size), b_NHW.reshape(-1, *size)
    # Two disjoint shapes are nearest to each other at their outlines, which are few pixels.
    a_NP2, b_NQ2 = _outline_points(a_NHW, UNSEEN), _outline_points(b_NHW, -UNSEEN)
    gap_N = torch.full((len(a_NHW),), UNSEEN)
    if a_NP2.shape[1] and b_NQ2.shape[1]:
        rows_NPQ, columns_NPQ = (a_NP2[:, :, None, i] - b_NQ2[:, None, :, i] for i in (0, 1))
        gap_N = (rows_NPQ.square_() + columns_NPQ.square_()).flatten(1).amin(1).sqrt()
    overlap_N = (a_NHW & b_NHW).flatten(1).any(1)
    return gap_N.masked_fill(overlap_N, 0.0).reshape(lead)


def _outline_points(masks_NHW: Tensor, filler: float) -> Tensor:
    """Rows and columns (N, P, 2) of the pixels with a neighbour outside; shorter outlines end in `filler`."""
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


def center_inside(inner_HW: Bools, outer_HW: Bools) -> bool:
    """Whether the centroid of one bool mask (H, W) lies within the convex outline of another one's pixels."""
    if not inner_HW.any() or outer_HW.sum() < 3:
        return False
    try:
        sides_n3 = scipy.spatial.ConvexHull(np.argwhere(outer_HW)).equations
    except scipy.spatial.QhullError:  # the pixels are all on one line
        return False
    return bool((sides_n3[:, :2] @ np.argwhere(inner_HW).mean(0) + sides_n3[:, 2] <= 0).all())
