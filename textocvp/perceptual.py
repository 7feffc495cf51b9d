"""Learned distances between pictures: LPIPS (Zhang et al. 2018) and ST-LPIPS (Ghildyal and Liu 2022).

LPIPS needs the weights of AlexNet, which its library fetches on first use; ST-LPIPS has its weights in a package. Where
weights cannot be had the figure is absent with a reason; it is never computed with random ones.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from textocvp.shift_tolerant import WeightsNotFound, load_shift_tolerant


class MetricUnavailable(RuntimeError):
    """A metric cannot be computed on this machine; the message says why and what would help."""


class PerceptualNetwork(Protocol):
    """What a distance is made of: features of each picture, and their comparison."""

    def features(self, frames_N3HW: Tensor, /) -> Sequence[Tensor]:
        """Maps (N, C, h, w) of pictures in -1..1."""

    def compare(self, imagined: Sequence[Tensor], real: Sequence[Tensor], /) -> Tensor:
        """Distances (N,)."""


@dataclass(frozen=True)
class Features:
    """Features of T pictures, kept so that several imagined films can be compared with one real film.

    Attributes:
        layers: maps (T, C, h, w).
    """

    layers: tuple[Tensor, ...]

    def first(self, frames: int) -> Features:
        """Those of the first pictures."""
        return Features(tuple(layer[:frames] for layer in self.layers))


@dataclass(frozen=True)
class PerceptualDistance:
    """A distance between pictures, lower is more alike.

    Attributes:
        name: the metric and its backbone, for tables.
        network: does the work.
    """

    name: str
    network: PerceptualNetwork

    def __call__(self, imagined: Tensor, real: Tensor) -> Tensor:
        """Distance (...) of each of the frames (..., 3, H, W) in 0..1.

        Raises:
            ValueError: if the shapes differ or are not of frames, or the frames are too small.
        """
        if imagined.shape != real.shape or imagined.ndim < 3 or imagined.shape[-3] != 3:
            raise ValueError(
                f"need frames (..., 3, H, W) of one shape, "
                f"got {tuple(imagined.shape)} and {tuple(real.shape)}"
            )
        shape = imagined.shape
        flat = (self.features(frames.reshape(-1, *shape[-3:])) for frames in (imagined, real))
        return self.compare(*flat).reshape(shape[:-3])

    @torch.no_grad()
    def features(self, frames_T3HW: Tensor) -> Features:
        """Features of frames (T, 3, H, W) in 0..1, computed on the CPU, where the networks are loaded."""
        return Features(tuple(self.network.features(frames_T3HW.float().cpu() * 2 - 1)))

    @torch.no_grad()
    def compare(self, imagined: Features, real: Features) -> Tensor:
        """Distances (T,) of equally many pictures."""
        return self.network.compare(imagined.layers, real.layers)


@dataclass(frozen=True)
class _WholePictures:
    """A network that takes two pictures at once: their features are the pictures themselves."""

    network: Callable[[Tensor, Tensor], Tensor]

    def features(self, frames_N3HW: Tensor) -> Sequence[Tensor]:
        return (frames_N3HW,)

    def compare(self, imagined: Sequence[Tensor], real: Sequence[Tensor]) -> Tensor:
        return self.network(imagined[0], real[0]).flatten()


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
            f"LPIPS needs the package lpips and a torchvision that fits the installed torch: {error}"
        ) from error
    try:
        # The library prints to stdout while it loads, and calls torchvision in a way that has gone out of fashion;
        # both would end up in a study's table.
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            network: Any = lpips.LPIPS(net="alex", verbose=False).eval()
    except (OSError, RuntimeError) as error:
        raise MetricUnavailable(f"LPIPS could not load the weights of AlexNet: {error}") from error
    return PerceptualDistance("LPIPS (AlexNet)", _WholePictures(network))


def load_st_lpips() -> PerceptualDistance:
    """ST-LPIPS with AlexNet. Its figures are not LPIPS figures: they rank alike, on another scale.

    Raises:
        MetricUnavailable: if its weights are not installed.
    """
    try:
        return PerceptualDistance("ST-LPIPS (AlexNet)", load_shift_tolerant())
    except WeightsNotFound as error:
        raise MetricUnavailable(
            f"ST-LPIPS cannot be computed: {error}. `pip install stlpips_pytorch` brings them"
        ) from error
