"""The published renderer: a spatial broadcast decoder (Watters et al. 2019; TextOCVP-SAVi).

Every slot is copied to every pixel, given a code of that pixel's place, and decoded to a colour and an alpha. The
alphas of all slots become masks by a softmax over the slots.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from textocvp.layers import PositionCode
from textocvp.renderers.base import Rendered, Renderer, RendererConfig
from textocvp.slots import SlotLayout


@dataclass(frozen=True)
class BroadcastConfig(RendererConfig):
    """Options of `BroadcastRenderer`."""

    kind: Literal["broadcast"] = "broadcast"
    channels: int = 32  # width of its convolutions


class BroadcastRenderer(Renderer):
    """Four 5x5 convolutions at full resolution, then one to RGB and alpha. Slots are exchangeable."""

    Config = BroadcastConfig

    def __init__(self, config: BroadcastConfig, layout: SlotLayout, image_size: int) -> None:
        super().__init__()
        self.image_size = image_size
        slot_dim, channels = layout.dim, config.channels
        self.position = PositionCode(slot_dim)
        blocks: list[nn.Module] = []
        for inputs in (slot_dim, channels, channels, channels):
            blocks += [nn.Conv2d(inputs, channels, 5, padding=2), nn.ReLU()]
        self.convolutions = nn.Sequential(*blocks, nn.Conv2d(channels, 4, 3, padding=1))

    def forward(self, slots_BKD: Tensor) -> Rendered:
        B, K, D = slots_BKD.shape
        size = self.image_size
        map_NDHW = slots_BKD.reshape(B * K, D, 1, 1).expand(-1, -1, size, size)
        out_BK4HW = self.convolutions(self.position(map_NDHW)).view(B, K, 4, size, size)
        object_frames_BK3HW = out_BK4HW[:, :, :3]
        masks_BKHW = torch.softmax(out_BK4HW[:, :, 3].float(), dim=1)  # float: bf16 masks would not sum to 1
        frames_B3HW = (masks_BKHW[:, :, None] * object_frames_BK3HW).sum(dim=1)
        return Rendered(frames_B3HW, masks_BKHW, lambda: object_frames_BK3HW)
