"""The renderer of Non-OC: one slot holds the whole frame, and convolutions unfold it."""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn

from textocvp.layers import init_relu_
from textocvp.renderers.base import Rendered, Renderer, RendererConfig
from textocvp.slots import SlotLayout

CELLS = 8  # side of the picture that the linear layer makes


@dataclass(frozen=True)
class UpsampleConfig(RendererConfig):
    """Options of `UpsampleRenderer`."""

    kind: Literal["upsample"] = "upsample"
    channels: int = 32  # at half the frame's size; twice that below


class UpsampleRenderer(Renderer):
    """A linear layer to 8x8 cells, then doublings up to the frame of 16, 32, 64, ... pixels, each a convolution."""

    Config = UpsampleConfig

    def __init__(self, config: UpsampleConfig, layout: SlotLayout, image_size: int) -> None:
        super().__init__()
        self.image_size = image_size
        count = (image_size // CELLS).bit_length() - 1  # of doublings
        wide = 2 * config.channels
        self.cells = nn.Sequential(nn.Linear(layout.dim, wide * CELLS**2), nn.Unflatten(1, (wide, CELLS, CELLS)))
        blocks: list[nn.Module] = []
        for doubling in range(count - 1):
            width = config.channels if doubling == count - 2 else wide
            blocks += [nn.ReLU(), nn.Upsample(scale_factor=2.0), nn.Conv2d(wide, width, 3, padding=1)]
        last = wide if count == 1 else config.channels
        # On a CPU a pixel shuffle takes half the time of convolutions at full resolution.
        blocks += [nn.ReLU(), nn.Conv2d(last, 3 * 4, 3, padding=1), nn.PixelShuffle(2)]
        self.convolutions = nn.Sequential(*blocks)
        init_relu_(self)

    def forward(self, slots_B1D: Tensor) -> Rendered:
        """As `Renderer.forward`; raises a ValueError if there is more than one slot."""
        if slots_B1D.shape[1] != 1:
            raise ValueError(f"renderer.kind 'upsample' draws one slot, not {slots_B1D.shape[1]}")
        frames_B3HW = self.convolutions(self.cells(slots_B1D[:, 0]))
        return Rendered(frames_B3HW, self.masks(slots_B1D), lambda: frames_B3HW[:, None])

    def masks(self, slots_B1D: Tensor) -> Tensor:
        return slots_B1D.new_ones(len(slots_B1D), 1, self.image_size, self.image_size)
