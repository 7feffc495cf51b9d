"""Crops the pixels of a slot into a small canonical picture, and pastes such a picture back at the slot's place.

In its own coordinates a thing looks the same wherever it stands (Invariant Slot Attention, Biza et al. 2023). Both ways
are two small matrix products (DRAW, Gregor et al. 2015) and differentiable in place and size.
"""

import torch
from torch import Tensor

NOTHING = -12.0  # alpha logit outside a pasted picture and in unused slots; the background's is 0


def crop(images: Tensor, position: Tensor, scale: Tensor, cells: int, extent: float) -> Tensor:
    """Crop canonical pictures.

    Args:
        images: (B, K, C, H, W).
        position, scale: (B, K, 2) place and standard deviation (x, y) of each slot, in -1..1.
        cells: along a side of the picture.
        extent: how many standard deviations the picture reaches to each side.

    Returns:
        (B, K, C, cells, cells); cells outside the image are 0.
    """
    rows = _crop_weights(position[..., 1], scale[..., 1], images.shape[-2], cells, extent)
    columns = _crop_weights(position[..., 0], scale[..., 0], images.shape[-1], cells, extent)
    return rows[:, :, None] @ images @ columns[:, :, None].transpose(-1, -2)


def paste(pictures: Tensor, position: Tensor, scale: Tensor, height: int, width: int, extent: float) -> Tensor:
    """Paste canonical pictures (B, K, C, cells, cells) into images (B, K, C, height, width) of zeros; see `crop`."""
    cells = pictures.shape[-1]
    rows = _paste_weights(position[..., 1], scale[..., 1], height, cells, extent)
    columns = _paste_weights(position[..., 0], scale[..., 0], width, cells, extent)
    return rows[:, :, None] @ pictures @ columns[:, :, None].transpose(-1, -2)


def _crop_weights(center: Tensor, scale: Tensor, pixels: int, cells: int, extent: float) -> Tensor:
    """(..., cells, pixels): each cell as a weighted mean of the pixels under it, along one axis."""
    where, spacing = _cells(center, scale, cells, extent)
    width = spacing.clamp_min(2 / pixels)[..., None]  # never narrower than a pixel: interpolate, do not skip
    hat = (1 - (where[..., None] - _centers(pixels, center)).abs() / width).clamp_min(0)
    return hat / hat.sum(-1, keepdim=True).clamp_min(0.5)  # cells outside the image fade to 0


def _paste_weights(center: Tensor, scale: Tensor, pixels: int, cells: int, extent: float) -> Tensor:
    """(..., pixels, cells): each pixel as a linear interpolation of the cells around it, along one axis."""
    where, spacing = _cells(center, scale, cells, extent)
    apart = _centers(pixels, center)[:, None] - where[..., None, :]
    return (1 - apart.abs() / spacing[..., None]).clamp_min(0)


def _cells(center: Tensor, scale: Tensor, cells: int, extent: float) -> tuple[Tensor, Tensor]:
    """Centres (..., cells) of the canonical cells along one axis of the image (-1..1), and their spacing (..., 1)."""
    reach = scale[..., None] * extent
    return center[..., None] + reach * _centers(cells, center), 2 * reach / cells


def _centers(count: int, like: Tensor) -> Tensor:
    """(count,) centres of as many equal parts of -1..1."""
    return (torch.arange(count, device=like.device, dtype=like.dtype) + 0.5) / count * 2 - 1
