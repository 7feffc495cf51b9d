"""The renderer that ships: every slot is drawn in its own coordinates and pasted where the slot is.

A slot that knows its place and size can be described in its own coordinates: the same block looks the same wherever
it stands (Invariant Slot Attention, Biza et al. 2023).
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.crop import NOTHING, paste
from textocvp.renderers.base import Rendered, Renderer, RendererConfig
from textocvp.slots import SlotLayout, SlotState


@dataclass(frozen=True)
class PictureConfig(RendererConfig):
    """Options of the canonical pictures of slots."""

    hidden: int = 256  # width of the decoder's fully connected layers
    crop_cells: int = 24  # side in cells of the canonical picture of a slot
    crop_extent: float = 2.6  # how many standard deviations that picture reaches to each side


@dataclass(frozen=True)
class GlimpseConfig(PictureConfig):
    """Options of `GlimpseRenderer`."""

    kind: Literal["glimpse"] = "glimpse"


class GlimpseRenderer(Renderer):
    """Draws every slot as a canonical picture in its own colour, at its own place and size, over one canvas.

    The content becomes `crop_cells`^2 cells of (alpha logit, shading). An object's colour is the slot's explicit
    colour times its shading, so colours never seen in training are drawn as well as others. The canvas, the picture
    behind everything for the fixed camera, is the background slot's colour times a learned shading.
    """

    Config: ClassVar[type[RendererConfig]] = GlimpseConfig

    def __init__(self, config: PictureConfig, layout: SlotLayout, image_size: int) -> None:
        super().__init__()
        self.layout, self.image_size = layout, image_size
        self.cells, self.extent = config.crop_cells, config.crop_extent
        self.decoder = nn.Sequential(
            nn.Linear(layout.content, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, 2 * self.cells**2),
        )
        self.canvas = nn.Parameter(torch.zeros(image_size, image_size))

    def forward(self, slots: Tensor) -> Rendered:
        state = SlotState.split(slots, self.layout)
        logits_BKHW, shading_BKHW = self._pictures(state, self.image_size).unbind(2)
        masks_BKHW = self._compete(logits_BKHW, state)
        shading_BKHW = torch.where(state.is_background[..., None], self.canvas, shading_BKHW)
        light_BKHW = 1 + shading_BKHW
        rgb_BK3 = (state.color + 1) / 2
        # The masks sum to 1, so the frame is one matrix product over the slots, without K coloured pictures.
        frames_B3N = 2 * rgb_BK3.transpose(1, 2) @ (masks_BKHW * light_BKHW).flatten(2) - 1

        def draw_objects() -> Tensor:
            return 2 * rgb_BK3[..., None, None] * light_BKHW[:, :, None] - 1

        return Rendered(frames_B3N.unflatten(2, masks_BKHW.shape[2:]), masks_BKHW, draw_objects)

    def masks(self, slots: Tensor) -> Tensor:
        """As `Renderer.masks`, at half the cost of `forward`."""
        state = SlotState.split(slots, self.layout)
        return self._compete(self._pictures(state, self.image_size, channels=1)[:, :, 0], state)

    def _pictures(self, state: SlotState, size: int, channels: int = 2) -> Tensor:
        """Alpha logits and shading (B, K, channels, size, size) of the slots where they are."""
        B, K, _ = state.content.shape
        cells = self.decoder(state.content).view(B, K, 2, self.cells, self.cells)[:, :, :channels]
        # Drawn relative to NOTHING, so that the zeros outside of a glimpse mean "nothing here".
        offset = torch.tensor([NOTHING, 0.0], device=cells.device, dtype=cells.dtype)[:channels, None, None]
        return paste(cells - offset, state.position, state.scale, size, size, self.extent) + offset

    def _compete(self, logits_BKHW: Tensor, state: SlotState) -> Tensor:
        logits_BKHW = logits_BKHW.masked_fill(state.is_unused[..., None], NOTHING)
        logits_BKHW = logits_BKHW.masked_fill(state.is_background[..., None], 0.0)
        return F.softmax(logits_BKHW, dim=1)
