"""From a grid of image features to a picture: the second half of the TextOCVP-DINO renderer, and of MAGE-DINO.

`cnn` is the published decoder; `vqgan` is built from the blocks of the VQGAN decoder (Esser et al. 2021), with which
the paper's reconstructions get sharper for about twice the parameters. Both double the grid until it is as large as the
frame, at most four times: as published, 24x24 features become 384x384. The result is resized to the size of the frames.
"""

from itertools import pairwise
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

DOUBLINGS = 4  # at most


class CnnDecoder(nn.Module):
    """Features (N, F, h, w) to frames (N, 3, H, W), about -1..1: 3x3 convolution, ReLU and doubling, a few times.

    `channels` is the width of the first convolution, a multiple of 8; every later one is half as wide.
    """

    def __init__(self, feature_dim: int, channels: int, cells: int, image_size: int) -> None:
        super().__init__()
        self.image_size = image_size
        widths = [feature_dim, *(channels >> i for i in range(doublings(cells, image_size)))]
        blocks: list[nn.Module] = []
        for wide, narrow in pairwise(widths):
            blocks += [nn.Conv2d(wide, narrow, 3, padding=1), nn.ReLU(), nn.Upsample(scale_factor=2)]
        self.blocks = nn.Sequential(*blocks, nn.Conv2d(widths[-1], 3, 3, padding=1))

    def forward(self, features_NFhw: Tensor) -> Tensor:
        return _resized(self.blocks(features_NFhw), self.image_size)


class VqganDecoder(nn.Module):
    """Features (N, F, h, w) to frames (N, 3, H, W), about -1..1: residual and non-local blocks, then doublings.

    `channels` is the width of the first blocks, a multiple of 32; the first three doublings halve it.
    """

    def __init__(self, feature_dim: int, channels: int, cells: int, image_size: int) -> None:
        super().__init__()
        self.image_size = image_size
        blocks: list[nn.Module] = [
            nn.Conv2d(feature_dim, channels, 3, padding=1),
            ResidualBlock(channels),
            NonLocalBlock(channels),
            ResidualBlock(channels),
            ResidualBlock(channels),
            NonLocalBlock(channels),
        ]
        width = channels
        for i in range(doublings(cells, image_size)):
            narrower = channels >> min(i + 1, 3)
            blocks += [nn.Upsample(scale_factor=2), nn.Conv2d(width, narrower, 3, padding=1)]
            blocks += [ResidualBlock(narrower), ResidualBlock(narrower)]
            width = narrower
        self.blocks = nn.Sequential(*blocks, _norm(width), nn.SiLU(), nn.Conv2d(width, 3, 3, padding=1))

    def forward(self, features_NFhw: Tensor) -> Tensor:
        return _resized(self.blocks(features_NFhw), self.image_size)


class ResidualBlock(nn.Module):
    """x + two times group norm, SiLU and 3x3 convolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        blocks: list[nn.Module] = []
        for _ in range(2):
            blocks += [_norm(channels), nn.SiLU(), nn.Conv2d(channels, channels, 3, padding=1)]
        self.layers = nn.Sequential(*blocks)

    def forward(self, x_NCHW: Tensor) -> Tensor:
        return x_NCHW + self.layers(x_NCHW)


class NonLocalBlock(nn.Module):
    """x + self-attention of one head among all locations (Wang et al. 2018)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = _norm(channels)
        self.query_key_value = nn.Conv2d(channels, 3 * channels, 1)
        self.out = nn.Conv2d(channels, channels, 1)

    def forward(self, x_NCHW: Tensor) -> Tensor:
        query_key_value = self.query_key_value(self.norm(x_NCHW)).flatten(2).transpose(1, 2)
        query, key, value = query_key_value.chunk(3, dim=-1)
        weights_NLL = torch.softmax(query @ key.transpose(1, 2) * query.shape[-1] ** -0.5, dim=-1)
        mixed_NCHW = (weights_NLL @ value).transpose(1, 2).unflatten(2, x_NCHW.shape[2:])
        return x_NCHW + self.out(mixed_NCHW)


def doublings(cells: int, image_size: int) -> int:
    """How often a grid of so many cells along a side is doubled."""
    return next((n for n in range(DOUBLINGS) if cells << n >= image_size), DOUBLINGS)


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(min(32, channels), channels, eps=1e-6)


def _resized(frames_N3HW: Tensor, size: int) -> Tensor:
    if frames_N3HW.shape[-1] == size:
        return frames_N3HW
    return F.interpolate(frames_N3HW, size=(size, size), mode="bilinear", align_corners=False, antialias=True)


def check_channels(channels: int) -> None:
    """Raise a ValueError if `channels` cannot be halved as often as a decoder needs."""
    if channels % 32:
        raise ValueError(f"renderer.image_channels must be a multiple of 32, not {channels}")


def build_image_decoder(
    kind: Literal["cnn", "vqgan"], feature_dim: int, channels: int, cells: int, image_size: int
) -> CnnDecoder | VqganDecoder:
    """The decoder that `kind` names; errors as `check_channels`."""
    check_channels(channels)
    if kind == "cnn":
        return CnnDecoder(feature_dim, channels, cells, image_size)
    return VqganDecoder(feature_dim, channels // 2, cells, image_size)
