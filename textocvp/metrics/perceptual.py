"""Learned distances between pictures: LPIPS (Zhang et al. 2018) and ST-LPIPS (Ghildyal and Liu 2022).

LPIPS needs the weights of AlexNet: `textocvp weights lpips` fetches them, else its library on first use.
ST-LPIPS has its weights in a package.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F

from textocvp.metrics.frames import check_frames
from textocvp.metrics.lpips_weights import BACKBONE, COMMAND, weights_path

CHANNELS = (64, 192, 384, 256, 256)
MIN_SIZE = 21
# Of ImageNet's colours for pictures in -1..1, as in LPIPS.
MEAN, DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_CONVOLUTIONS = ("slice1.0", "slice2.5", "slice3.9", "slice4.11", "slice5.13")


class MetricUnavailable(RuntimeError):
    """A metric cannot be computed on this machine; the message says why and what would help."""


@dataclass(frozen=True)
class Features:
    """Features of T pictures, kept so that several predictions can be compared with one true video."""

    layers: tuple[Tensor, ...]  # maps (T, C, h, w)

    def first(self, frames: int) -> Features:
        """Those of the first pictures."""
        return Features(tuple(layer[:frames] for layer in self.layers))


@dataclass(frozen=True)
class PerceptualDistance:
    """A distance between pictures, lower is more alike."""

    name: str  # of the metric and its backbone, for tables
    describe: Callable[[Tensor], Sequence[Tensor]]  # pictures (N, 3, H, W) in -1..1 to feature maps (N, C, h, w)
    difference: Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]  # maps of N pictures and N others to (N,)

    def __call__(self, imagined: Tensor, real: Tensor) -> Tensor:
        """Distance (...) of each of the frames (..., 3, H, W) in 0..1.

        Raises:
            ValueError: if the shapes differ or are not of frames, or ST-LPIPS gets frames smaller than 21x21.
        """
        check_frames(imagined, real)
        flat = (self.features(frames.reshape(-1, *frames.shape[-3:])) for frames in (imagined, real))
        return self.compare(*flat).reshape(imagined.shape[:-3])

    @torch.no_grad()
    def features(self, frames_T3HW: Tensor) -> Features:
        """Features of frames (T, 3, H, W) in 0..1, computed on the CPU, where the networks are loaded."""
        return Features(tuple(self.describe(frames_T3HW.float().cpu() * 2 - 1)))

    @torch.no_grad()
    def compare(self, imagined: Features, real: Features) -> Tensor:
        """Distances (T,) of equally many pictures."""
        return self.difference(imagined.layers, real.layers)


class ShiftTolerantAlexNet(nn.Module):
    """Distance of pictures as the weighted difference of five layers' features."""

    mean: Tensor
    deviation: Tensor
    blur: Tensor

    def __init__(self) -> None:
        super().__init__()
        sizes, paddings = (11, 5, 3, 3, 3), (2, 2, 1, 1, 1)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, size, padding=padding)
            for (before, after), size, padding in zip(pairwise((3, *CHANNELS)), sizes, paddings, strict=True)
        )
        self.weights = nn.ParameterList(nn.Parameter(torch.zeros(channels)) for channels in CHANNELS)
        line = torch.tensor([0.25, 0.5, 0.25])
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION).view(3, 1, 1), persistent=False)
        self.register_buffer("blur", line[:, None] * line[None, :], persistent=False)

    def features(self, frames_N3HW: Tensor) -> tuple[Tensor, ...]:
        """Five maps (N, C, h, w) of pictures in -1..1, each pixel's features of length 1."""
        H, W = frames_N3HW.shape[-2:]
        if min(H, W) < MIN_SIZE:
            raise ValueError(f"ST-LPIPS needs pictures of at least {MIN_SIZE}x{MIN_SIZE} pixels, not {H}x{W}")
        x_NCHW = (frames_N3HW - self.mean) / self.deviation
        found = []
        for layer, convolution in enumerate(self.convolutions):
            if layer in (1, 2):
                x_NCHW = self._halve(F.max_pool2d(x_NCHW, kernel_size=3, stride=1))
            x_NCHW = convolution(x_NCHW)
            x_NCHW = F.relu(self._halve(x_NCHW) if layer == 0 else x_NCHW)
            found.append(x_NCHW / (x_NCHW.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return tuple(found)

    def compare(self, imagined: Sequence[Tensor], real: Sequence[Tensor]) -> Tensor:
        """Distances (N,) from the features of N pictures to those of N others."""
        layers = zip(imagined, real, self.weights, strict=True)
        maps = [torch.einsum("nchw,c->nhw", (a - b).square(), weight) for a, b, weight in layers]
        return torch.stack([map_Nhw.mean(dim=(1, 2)) for map_Nhw in maps]).sum(dim=0)

    def _halve(self, x_NCHW: Tensor) -> Tensor:
        C = x_NCHW.shape[1]
        padded_NCHW = F.pad(x_NCHW, (2, 2, 2, 2), mode="reflect")
        return F.conv2d(padded_NCHW, self.blur.expand(C, 1, 3, 3), stride=2, groups=C)


def load_lpips() -> PerceptualDistance:
    """LPIPS with AlexNet, the backbone of the paper's numbers.

    The weights are those that `textocvp weights lpips` has fetched; without them the library downloads torchvision's.

    Raises:
        MetricUnavailable: if the library or its weights cannot be loaded; the message says how to get them.
    """
    path = weights_path()
    try:
        import lpips
    except (ImportError, RuntimeError, OSError) as error:  # RuntimeError: a torchvision built for another torch
        raise MetricUnavailable(
            f"LPIPS needs the package lpips and a torchvision that fits the installed torch: {error}"
        ) from error
    try:
        # The library prints while it loads, and torchvision warns: both would end up in a study's table.
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            network: Any = lpips.LPIPS(net="alex", pnet_rand=path.is_file(), verbose=False).eval()
        if path.is_file():
            _set_lpips_weights(network, load_file(path))
    except (OSError, RuntimeError, KeyError, SafetensorError) as error:
        raise MetricUnavailable(
            f"LPIPS could not load the weights of {BACKBONE.name}: {error}. `{COMMAND}` fetches them with pip and "
            f"keeps them in {path.parent}; else the library needs a network to download torchvision's"
        ) from error
    # The library takes two pictures at once, so their features are the pictures themselves.
    return PerceptualDistance(f"LPIPS ({BACKBONE.name})", lambda x: (x,), lambda a, b: network(a[0], b[0]).flatten())


@torch.no_grad()
def _set_lpips_weights(network: Any, tensors: Mapping[str, Tensor]) -> None:
    """Copy weights, named as in `lpips_weights.tensors_of`, into a network of the library, all of it."""
    convolutions = [module for module in network.net.modules() if isinstance(module, nn.Conv2d)]
    targets = {f"layer.{i}": layer.model[-1].weight for i, layer in enumerate(network.lins)}
    for i, convolution in enumerate(convolutions):
        targets[f"convolution.{i}.weight"] = convolution.weight
        targets[f"convolution.{i}.bias"] = convolution.bias
    if other := sorted(targets.keys() ^ tensors.keys()):
        raise KeyError(f"the kept weights are of another network: {other[0]}")
    for name, target in targets.items():
        target.copy_(tensors[name].view_as(target))


def load_st_lpips(weights: Path | None = None) -> PerceptualDistance:
    """ST-LPIPS with AlexNet. Its values rank like those of LPIPS, on another scale.

    Args:
        weights: file of the authors' weights; by default the one in the package `stlpips_pytorch`.

    Raises:
        MetricUnavailable: if the weights are not there, or are those of another network.
    """
    path = weights or st_lpips_weights()
    stored = torch.load(path, map_location="cpu", weights_only=True)
    network = ShiftTolerantAlexNet()
    try:
        state = {}
        for layer, name in enumerate(_CONVOLUTIONS):
            state[f"convolutions.{layer}.weight"] = stored[f"net.{name}.weight"]
            state[f"convolutions.{layer}.bias"] = stored[f"net.{name}.bias"]
            state[f"weights.{layer}"] = stored[f"lin{layer}.model.1.weight"].flatten()
        network.load_state_dict(state)
    except (KeyError, RuntimeError) as error:
        raise _no_st_lpips(f"{path} has not the weights of ST-LPIPS (AlexNet): {error}") from error
    network.eval().requires_grad_(False)
    return PerceptualDistance("ST-LPIPS (AlexNet)", network.features, network.compare)


def st_lpips_weights() -> Path:
    """The authors' weights in the installed package `stlpips_pytorch`, which is not imported.

    Raises:
        MetricUnavailable: if the package is not installed or has no such file.
    """
    package = find_spec("stlpips_pytorch")
    if package is None or package.origin is None:
        raise _no_st_lpips("the package stlpips_pytorch, which has the weights, is not installed")
    path = Path(package.origin).parent / "weights" / "vST0.0" / "alex_shift_tolerant.pth"
    if not path.is_file():
        raise _no_st_lpips(f"stlpips_pytorch has no weights {path}: another version of it?")
    return path


def _no_st_lpips(reason: str) -> MetricUnavailable:
    remedy = "`pip install stlpips_pytorch` brings them"
    return MetricUnavailable(f"ST-LPIPS cannot be computed: {reason}. {remedy}")
