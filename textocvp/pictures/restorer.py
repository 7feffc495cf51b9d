"""A small network that takes noise, traces of JPEG and burnt-out colours off a picture of the model's own world."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import init_relu_

LEVELS = 3  # of the U-Net, each of half the size


@dataclass(frozen=True)
class RestorerConfig:
    """Options of `Restorer`."""

    channels: int = 16  # at full size; twice as many at each level below


class Restorer(nn.Module):
    """A U-Net (Ronneberger et al. 2015) that says what to add to pictures (N, 3, H, W) in -1..1.

    H and W must be whole multiples of 4. Before training it adds nothing.
    """

    def __init__(self, config: RestorerConfig) -> None:
        super().__init__()
        widths = [config.channels * 2**level for level in range(LEVELS)]
        pairs = zip([3, *widths], widths, strict=False)
        self.down = nn.ModuleList(_convolutions(before, after) for before, after in pairs)
        self.up = nn.ModuleList(_convolutions(3 * width, width) for width in widths[:-1])
        self.last = nn.Conv2d(widths[0], 3, 1)
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, pictures_N3HW: Tensor) -> Tensor:
        found = [self.down[0](pictures_N3HW)]
        for block in list(self.down)[1:]:
            found.append(block(F.avg_pool2d(found[-1], 2)))
        x = found.pop()
        for block in reversed(self.up):
            x = block(torch.cat([F.interpolate(x, scale_factor=2.0), found.pop()], 1))
        return pictures_N3HW + self.last(x)


def _convolutions(before: int, after: int) -> nn.Sequential:
    block = nn.Sequential(
        nn.Conv2d(before, after, 3, padding=1), nn.ReLU(), nn.Conv2d(after, after, 3, padding=1), nn.ReLU()
    )
    init_relu_(block)
    return block
