"""Predicted frames against true frames: PSNR and SSIM."""

import torch
from torch import Tensor


def psnr(imagined: Tensor, real: Tensor) -> Tensor:
    """Peak signal-to-noise ratio (...) of frames (..., 3, H, W) in 0..1, in dB; infinite for equal ones.

    Raises:
        ValueError: if the shapes differ or are not of frames.
    """
    check_frames(imagined, real)
    error = (imagined.float() - real.float()).square().flatten(-3).mean(dim=-1)
    return -10 * torch.log10(error)


def ssim(imagined: Tensor, real: Tensor) -> Tensor:
    """Structural similarity (...), at most 1, of frames (..., 3, H, W) in 0..1.

    As the authors do: a Gaussian window of 11 pixels and deviation 1.5, and the picture mirrored at its edges.

    Raises:
        ValueError: if the shapes differ or are not of frames.
    """
    # Takes seconds to import, and the world model and the command line want PSNR or nothing of this package.
    from torchmetrics.functional.image import structural_similarity_index_measure

    check_frames(imagined, real)
    flat = [frames.float().reshape(-1, *frames.shape[-3:]) for frames in (imagined, real)]
    value = structural_similarity_index_measure(
        flat[0], flat[1], gaussian_kernel=True, sigma=1.5, kernel_size=11, reduction="none", data_range=1.0
    )
    assert isinstance(value, Tensor)
    return value.reshape(imagined.shape[:-3])


def check_frames(imagined: Tensor, real: Tensor) -> None:
    """Raise a ValueError unless both are frames (..., 3, H, W) of one shape."""
    if imagined.shape != real.shape or imagined.ndim < 3 or imagined.shape[-3] != 3:
        raise ValueError(
            f"need frames (..., 3, H, W) of one shape, got {tuple(imagined.shape)} and {tuple(real.shape)}"
        )
