"""The network of ST-LPIPS (Ghildyal and Liu, "Shift-tolerant Perceptual Similarity Metric", ECCV 2022), section 4.

LPIPS on an AlexNet that hardly notices when a picture moves by a pixel or two: the first convolution looks at every
pixel, every later halving of the resolution is a blur first, and the pictures' edges are mirrored. It was trained and
judged on pictures of 64x64 pixels, the size of the tabletop's frames, so those are measured as they are, without
enlarging. Smaller than 21x21 it has nothing to look at.

The layers are our own, because the package `stlpips_pytorch` that has the authors' weights can only be imported beside
torchvision, IPython and torchsummary, none of which it says. Its weights are read, and its own class is what the tests
compare this one with.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CHANNELS = (64, 192, 384, 256, 256)
MIN_SIZE = 21
#: Mean and deviation of ImageNet's colours for pictures in -1..1, as in LPIPS.
MEAN, DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_CONVOLUTIONS = ("slice1.0", "slice2.5", "slice3.9", "slice4.11", "slice5.13")


class WeightsNotFound(RuntimeError):
    """The weights of ST-LPIPS are not installed, or are not what they should be."""


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
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION).view(3, 1, 1), persistent=False)
        line = torch.tensor([0.25, 0.5, 0.25])
        self.register_buffer("blur", line[:, None] * line[None, :], persistent=False)

    def features(self, frames_N3HW: Tensor) -> tuple[Tensor, ...]:
        """Five maps (N, C, h, w) of pictures in -1..1, each pixel's features of length 1.

        Raises:
            ValueError: if the pictures are smaller than 21x21.
        """
        if min(frames_N3HW.shape[-2:]) < MIN_SIZE:
            raise ValueError(
                f"ST-LPIPS needs pictures of at least {MIN_SIZE}x{MIN_SIZE} pixels, "
                f"not {frames_N3HW.shape[-2]}x{frames_N3HW.shape[-1]}"
            )
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
        parts = [
            torch.einsum("nchw,c->nhw", (a - b).square(), weight).mean(dim=(1, 2))
            for a, b, weight in zip(imagined, real, self.weights, strict=True)
        ]
        return torch.stack(parts).sum(dim=0)

    def _halve(self, x_NCHW: Tensor) -> Tensor:
        channels = x_NCHW.shape[1]
        kernel_C1hw = self.blur.expand(channels, 1, 3, 3)
        return F.conv2d(F.pad(x_NCHW, (2, 2, 2, 2), mode="reflect"), kernel_C1hw, stride=2, groups=channels)


def weights_file() -> Path:
    """The authors' weights in the installed package `stlpips_pytorch`, which is not imported.

    Raises:
        WeightsNotFound: if the package is not installed or has no such file.
    """
    package = find_spec("stlpips_pytorch")
    if package is None or package.origin is None:
        raise WeightsNotFound("the package stlpips_pytorch, which has the weights, is not installed")
    path = Path(package.origin).parent / "weights" / "vST0.0" / "alex_shift_tolerant.pth"
    if not path.is_file():
        raise WeightsNotFound(f"stlpips_pytorch has no weights {path}: another version of it?")
    return path


def load_shift_tolerant(path: Path | None = None) -> ShiftTolerantAlexNet:
    """The network with the authors' weights; `path` is a file other than the installed one.

    Raises:
        WeightsNotFound: if they are not there, or are those of another network.
    """
    path = path or weights_file()
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
        raise WeightsNotFound(f"{path} has not the weights of ST-LPIPS (AlexNet): {error}") from error
    return network.eval().requires_grad_(False)
