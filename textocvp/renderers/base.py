"""From slots to frames and masks: what every renderer is."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from textocvp.slots import SlotLayout


@dataclass(frozen=True)
class RendererConfig:
    """What every renderer is built from; a subclass adds its own options and refuses values that make no sense.

    Attributes:
        kind: name in `textocvp.renderers.RENDERERS`.
    """

    kind: str


@dataclass
class Rendered:
    """What slots look like.

    Attributes:
        frames_B3HW: the composed frame, -1..1 (a renderer may overshoot slightly; `Rollout` clamps).
        masks_BKHW: each slot's share of each pixel; sums to 1 over the slots.
        draw_objects: makes `object_frames_BK3HW`.
        features_BLF: the image features that the frame was drawn from, of L patches row by row; None for renderers
            that draw pixels from slots.
    """

    frames_B3HW: Tensor
    masks_BKHW: Tensor
    draw_objects: Callable[[], Tensor]
    features_BLF: Tensor | None = None

    @property
    def object_frames_BK3HW(self) -> Tensor:
        """Each slot drawn alone, made when asked for, being K frames large.

        The frame is their mask-weighted sum; with features, it is drawn from the mask-weighted sum of theirs.
        """
        return self.draw_objects()


class Renderer(nn.Module):
    """Slots to pixels. Subclasses set `Config` and write `forward` and, where colours cost much, a cheaper `masks`.

    Attributes:
        Config: the class of its configuration.

    Args:
        config: its sizes.
        layout: what the numbers of one slot mean.
        image_size: side of the square frames in pixels.
    """

    Config: ClassVar[type[RendererConfig]]

    def __init__(self, config: RendererConfig, layout: SlotLayout, image_size: int) -> None:
        super().__init__()
        self.layout, self.image_size = layout, image_size

    @abstractmethod
    def forward(self, slots_BKD: Tensor) -> Rendered:
        """Draw one frame for each set of slots."""
        raise NotImplementedError

    def masks(self, slots_BKD: Tensor) -> Tensor:
        """Only the masks (B, K, H, W), for callers that look at no colours: a planner scores masks."""
        return self(slots_BKD).masks_BKHW

    def places(self, slots_BKD: Tensor) -> tuple[Tensor, Tensor] | None:
        """Where a renderer that has to read this off unexplained slots takes them to be; None for all others.

        Returns:
            centres (x, y) in -1..1 and standard deviations along x and y in that unit, each (B, K, 2).
        """
        return None
