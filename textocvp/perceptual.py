"""LPIPS, where it can be had: a learned distance between pictures (Zhang et al. 2018).

It needs the extra `metrics` and the weights of AlexNet, which its library fetches on first use. Where either
is missing the figure is absent with a reason; it is never computed with random weights.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


class MetricUnavailable(RuntimeError):
    """A metric cannot be computed on this machine; the message says why and what would help."""


@dataclass(frozen=True)
class PerceptualDistance:
    """A distance between pictures, lower is more alike.

    Attributes:
        name: the metric and its backbone, for tables.
        network: distance of two batches (N, 3, H, W) in -1..1.
    """

    name: str
    network: Callable[[Tensor, Tensor], Tensor]

    @torch.no_grad()
    def __call__(self, imagined: Tensor, real: Tensor) -> Tensor:
        """Distance (...) of each of the frames (..., 3, H, W) in 0..1.

        Raises:
            ValueError: if the shapes differ or are not of frames.
        """
        if imagined.shape != real.shape or imagined.ndim < 3 or imagined.shape[-3] != 3:
            raise ValueError(
                f"need frames (..., 3, H, W) of one shape, "
                f"got {tuple(imagined.shape)} and {tuple(real.shape)}"
            )
        shape = imagined.shape
        flat = (frames.float().reshape(-1, *shape[-3:]) * 2 - 1 for frames in (imagined, real))
        return self.network(*flat).reshape(shape[:-3])


def load_lpips() -> PerceptualDistance:
    """LPIPS with AlexNet, the backbone of the paper's figures.

    Raises:
        MetricUnavailable: if the library or its weights cannot be loaded.
    """
    try:
        import lpips
    # A torchvision that was built for another torch fails with RuntimeError, not with ImportError.
    except (ImportError, RuntimeError, OSError) as error:
        raise MetricUnavailable(
            "LPIPS needs `pip install 'textocvp[metrics]'` with a torchvision that fits the installed torch: "
            f"{error}"
        ) from error
    try:
        # The library prints to stdout while it loads, which would end up in a study's table.
        with contextlib.redirect_stdout(io.StringIO()):
            network = lpips.LPIPS(net="alex", verbose=False).eval()
    except (OSError, RuntimeError) as error:
        raise MetricUnavailable(f"LPIPS could not load the weights of AlexNet: {error}") from error
    return PerceptualDistance("LPIPS (AlexNet)", network)
