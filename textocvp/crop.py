"""Reading a slot's pixels into a small canonical picture, and drawing that picture back where the slot is.

A slot that knows its place and size can be described in its own coordinates: the same block looks the same wherever
it stands. Reading and drawing are axis-aligned, so each is two small matrix products (the separable attention of
DRAW, Gregor et al. 2015) and differentiable in place and size. The explicit place follows Invariant Slot Attention
(Biza et al. 2023).
"""

from __future__ import annotations

import torch
from torch import Tensor

NOTHING = -12.0
"""Alpha logit outside a glimpse and in unused slots; the background's is 0."""


def _cell_centers(center: Tensor, scale: Tensor, cells: int, extent: float) -> tuple[Tensor, Tensor]:
    """Positions (..., cells) of the canonical cells along one axis of the image (-1..1), and their spacing (..., 1)."""
    steps = (torch.arange(cells, device=center.device, dtype=center.dtype) + 0.5) / cells * 2 - 1
    reach = scale[..., None] * extent
    return center[..., None] + reach * steps, 2 * reach / cells


def reading_weights(center: Tensor, scale: Tensor, pixels: int, cells: int, extent: float) -> Tensor:
    """(..., cells, pixels): each canonical cell as a weighted mean of the pixels under it, along one axis.

    Args:
        center, scale: (...) place and standard deviation of the slot along this axis, in -1..1.
    """
    where, spacing = _cell_centers(center, scale, cells, extent)
    pixel = (torch.arange(pixels, device=center.device, dtype=center.dtype) + 0.5) / pixels * 2 - 1
    width = spacing.clamp_min(2 / pixels)[..., None]  # never narrower than a pixel: interpolate, do not skip
    hat = (1 - (where[..., None] - pixel).abs() / width).clamp_min(0)
    return hat / hat.sum(-1, keepdim=True).clamp_min(0.5)  # cells outside the image fade to 0


def drawing_weights(center: Tensor, scale: Tensor, pixels: int, cells: int, extent: float) -> Tensor:
    """(..., pixels, cells): each pixel as a linear interpolation of the canonical cells around it, along one axis."""
    where, spacing = _cell_centers(center, scale, cells, extent)
    pixel = (torch.arange(pixels, device=center.device, dtype=center.dtype) + 0.5) / pixels * 2 - 1
    return (1 - (pixel[:, None] - where[..., None, :]).abs() / spacing[..., None]).clamp_min(0)


def crop(images: Tensor, position: Tensor, scale: Tensor, cells: int, extent: float) -> Tensor:
    """Canonical pictures (B, K, C, cells, cells) of images (B, K, C, H, W) around position and scale (B, K, 2)."""
    rows = reading_weights(position[..., 1], scale[..., 1], images.shape[-2], cells, extent)
    columns = reading_weights(position[..., 0], scale[..., 0], images.shape[-1], cells, extent)
    return rows[:, :, None] @ images @ columns[:, :, None].transpose(-1, -2)


def paste(
    pictures: Tensor, position: Tensor, scale: Tensor, height: int, width: int, extent: float
) -> Tensor:
    """Images (B, K, C, H, W) with the canonical pictures (B, K, C, cells, cells) at position and scale (B, K, 2)."""
    cells = pictures.shape[-1]
    rows = drawing_weights(position[..., 1], scale[..., 1], height, cells, extent)
    columns = drawing_weights(position[..., 0], scale[..., 0], width, cells, extent)
    return rows[:, :, None] @ pictures @ columns[:, :, None].transpose(-1, -2)
