"""How good masks and frames are, and how sure a figure is.

Masks are compared with the simulator's segmentation: 0 is the background, 1 the arm, 2 + i object i. Nothing
here is used to train anything.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

# ---------------------------------------------------------------- frames against true frames


def psnr(imagined: Tensor, real: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of each frame in dB; infinite for equal frames.

    Args:
        imagined, real: (..., 3, H, W) in 0..1.

    Returns:
        (...).
    """
    _same_frames(imagined, real)
    error = (imagined.float() - real.float()).square().flatten(-3).mean(dim=-1)
    return -10 * torch.log10(error)


def ssim(imagined: Tensor, real: Tensor) -> Tensor:
    """Structural similarity of each frame, Gaussian window of 11 pixels and deviation 1.5, as the authors
    measure it.

    The picture is mirrored at its edges, so that pixels there count too.

    Args:
        imagined, real: (..., 3, H, W) in 0..1.

    Returns:
        (...), at most 1.
    """
    _same_frames(imagined, real)
    flat = [
        frames.float().flatten(0, -4) if frames.ndim > 3 else frames.float()[None]
        for frames in (imagined, real)
    ]
    value = structural_similarity_index_measure(
        flat[0], flat[1], gaussian_kernel=True, sigma=1.5, kernel_size=11, reduction="none", data_range=1.0
    )
    assert isinstance(value, Tensor)
    return value.reshape(imagined.shape[:-3])


def _same_frames(imagined: Tensor, real: Tensor) -> None:
    if imagined.shape != real.shape or imagined.shape[-3] != 3:
        raise ValueError(
            f"need frames (..., 3, H, W) of one shape, got {tuple(imagined.shape)} and {tuple(real.shape)}"
        )
