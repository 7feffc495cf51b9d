"""From slots to frames and masks: what every renderer is."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn


@dataclass(frozen=True)
class RendererConfig:
    """What every renderer is built from; a subclass adds its own options and refuses values that make no sense."""

    kind: str  # a name in `textocvp.renderers.RENDERERS`


@dataclass
class Rendered:
    """What slots look like."""

    frames_B3HW: Tensor  # the composed frame, -1..1; a renderer may overshoot slightly, `Rollout` clamps
    masks_BKHW: Tensor  # each slot's share of each pixel; sums to 1 over the slots
    # Draws each slot alone (B, K, 3, H, W); the frame is their mask-weighted sum, or drawn from that of their features.
    draw_objects: Callable[[], Tensor]
    # What the frame was drawn from, of L patches row by row; None for renderers that draw pixels from slots.
    features_BLF: Tensor | None = None


@dataclass(frozen=True)
class Seen:
    """What a renderer keeps of the first frame of one sequence, H and W its side: a multiple of the model's."""

    frame_3HW: Tensor  # -1..1
    clean_3HW: Tensor  # the same without robot and things; what they hide is filled in from what they do not
    labels_HW: Tensor  # the number of the slot that each pixel belongs to, int64
    slots_KD: Tensor  # the slots of that frame


class Renderer(nn.Module):
    """Slots to pixels. Subclasses set `Config` and write `forward` and, where colours cost much, a cheaper `masks`.

    They are built from (config, layout, image_size).
    """

    Config: ClassVar[type[RendererConfig]]
    keeps_size: ClassVar[bool] = False  # whether it draws at the size of first frames that are larger than the model's

    @abstractmethod
    def forward(self, slots_BKD: Tensor) -> Rendered:
        """Draw one frame for each set of slots."""
        raise NotImplementedError

    def masks(self, slots_BKD: Tensor) -> Tensor:
        """Only the masks (B, K, H, W), for callers that look at no colours: a planner scores masks."""
        return self(slots_BKD).masks_BKHW

    def remember(self, frames_B3HW: Tensor, attention_BKhw: Tensor, slots_BKD: Tensor) -> tuple[Seen, ...] | None:
        """What it keeps of B first frames, to draw the rest of each sequence with: `forward(slots_TKD, seen)`.

        Args:
            frames_B3HW: -1..1, their side the model's `image_size` or a whole multiple of it.
            attention_BKhw, slots_BKD: what the parser made of them.

        Returns:
            one `Seen` a sequence; None if it draws from slots alone.
        """
        return None

    def places(self, slots_BKD: Tensor) -> tuple[Tensor, Tensor] | None:
        """Centres and standard deviations (x, y), each (B, K, 2) in -1..1, if it reads them off unexplained slots."""
        return None
