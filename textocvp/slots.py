"""What the numbers of a slot mean.

Everywhere between the rooms a set of slots is one tensor `slots_BKD` (or `slots_BTKD` for a sequence). In the
published model all D numbers are one unexplained vector. Our shipped model also gives a slot an explicit colour,
place, size and presence, so that the same tensor can be rolled out by the predictor, drawn by the renderer and
read by a planner. `SlotLayout` says which of the D numbers are which; nothing else in the code base knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from textocvp.layers import full_precision, pixel_grid

PRESENCE_BACKGROUND = 2.0
"""Value of a slot's presence that marks it as the canvas behind everything (1 is a thing, 0 an unused slot)."""

MIN_SCALE = 0.012
"""Smallest standard deviation of a slot, in -1..1: about a third of a pixel at 64x64."""


@dataclass(frozen=True)
class SlotLayout:
    """How the last axis of a slot tensor is divided: `[content | colour 3 | position 2 | scale 2 | presence 1]`.

    Attributes:
        content: number of learned, unexplained channels.
        explicit: whether the 8 explicit channels follow the content. Without them (the published form) D = content.
    """

    content: int
    explicit: bool = True

    @property
    def dim(self) -> int:
        """D, the width of one slot."""
        return self.content + (8 if self.explicit else 0)


@dataclass
class SlotState:
    """A slot tensor taken apart. Leading axes `...` are any of (B, K), (B, T, K).

    Attributes:
        content: (..., C) learned channels.
        color: (..., 3) mean RGB of the slot's pixels, -1..1 as in the model's frames.
        position: (..., 2) centre of mass (x, y), -1..1 from left to right and top to bottom.
        scale: (..., 2) standard deviation of the slot's pixels along x and y, same unit as position, positive.
        presence: (..., 1) 1 for a slot that holds something, 0 for an unused one.
    """

    content: Tensor
    color: Tensor
    position: Tensor
    scale: Tensor
    presence: Tensor

    @property
    def is_unused(self) -> Tensor:
        """(..., 1) bool: holds nothing."""
        return self.presence < 0.5

    @property
    def is_thing(self) -> Tensor:
        """(..., 1) bool: neither unused nor the canvas."""
        return (self.presence >= 0.5) & (self.presence < 1.5)

    @property
    def is_background(self) -> Tensor:
        """(..., 1) bool: the canvas behind everything."""
        return self.presence >= 1.5

    def join(self) -> Tensor:
        """The slot tensor (..., C + 8)."""
        return torch.cat([self.content, self.color, self.position, self.scale, self.presence], dim=-1)

    @classmethod
    def split(cls, slots: Tensor, layout: SlotLayout) -> SlotState:
        """Take a slot tensor (..., D) apart.

        Raises:
            ValueError: if the layout has no explicit channels, or its width is not D.
        """
        if not layout.explicit:
            raise ValueError(
                "these slots have no explicit colour, position or scale (layout.explicit is False)"
            )
        if slots.shape[-1] != layout.dim:
            raise ValueError(f"slots are {slots.shape[-1]} wide, the layout says {layout.dim}")
        content, color, position, scale, presence = slots.split([layout.content, 3, 2, 2, 1], dim=-1)
        return cls(content, color, position, scale, presence)


def moments(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Centre of mass and standard deviation, each (B, K, 2) as (x, y) in -1..1, of masks (B, K, H, W)."""
    grid_N2 = pixel_grid(masks.shape[-2], masks.shape[-1], device=masks.device).flatten(0, 1)
    # The difference of squares of a small thing far from the centre is lost in 8 bits.
    with full_precision(masks.device):
        masks = masks.float()
        weights_BKN = masks.flatten(2) / masks.sum((2, 3))[..., None].clamp_min(1e-6)
        position = weights_BKN @ grid_N2
        variance = weights_BKN @ grid_N2.square() - position.square()
    return position, variance.clamp_min(MIN_SCALE**2).sqrt()
