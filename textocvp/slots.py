"""What the numbers of a slot mean.

A set of slots is one tensor everywhere, `slots_BKD`, or `slots_BTKD` for a sequence. In the published model the D
numbers are one learned vector. In the shipped model a slot also states its colour, place, size and presence, which the
predictor moves, the renderer draws and the planner reads.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from textocvp.layers import full_precision, pixel_grid

# The values of a slot's presence. The background is the canvas behind everything.
PRESENCE_UNUSED, PRESENCE_THING, PRESENCE_BACKGROUND = 0.0, 1.0, 2.0
# Values in between count as the nearest of the three.
MIN_USED = (PRESENCE_UNUSED + PRESENCE_THING) / 2
MIN_BACKGROUND = (PRESENCE_THING + PRESENCE_BACKGROUND) / 2

ROBOT_SLOT = 1  # of parsers that tell the robot from things

MIN_SCALE = 0.012  # smallest standard deviation of a slot, in -1..1: about a third of a pixel at 64x64


@dataclass(frozen=True)
class SlotLayout:
    """How the last axis of a slot tensor is divided: `[content | colour 3 | position 2 | scale 2 | presence 1]`."""

    content: int  # number of learned channels, which have no fixed meaning
    explicit: bool = True  # whether the 8 explicit channels follow; in the published form they do not: D = content

    @property
    def dim(self) -> int:
        """D, the width of one slot."""
        return self.content + (8 if self.explicit else 0)

    def used(self, slots: Tensor) -> Tensor:
        """Which slots (..., K, D) hold something, (..., K) bool. Without explicit channels all do."""
        if not self.explicit:
            return torch.ones(slots.shape[:-1], dtype=torch.bool, device=slots.device)
        return slots[..., -1] >= MIN_USED


@dataclass
class SlotState:
    """A slot tensor taken apart. Leading axes `...` are any of (B, K), (B, T, K)."""

    content: Tensor  # (..., C) learned channels
    color: Tensor  # (..., 3) mean RGB of the slot's pixels, -1..1 as in the model's frames
    position: Tensor  # (..., 2) centre of mass (x, y), -1..1 from left to right and top to bottom
    scale: Tensor  # (..., 2) standard deviation of the slot's pixels along x and y, same unit as position, positive
    presence: Tensor  # (..., 1) `PRESENCE_UNUSED`, `PRESENCE_THING` or `PRESENCE_BACKGROUND`

    @property
    def is_unused(self) -> Tensor:
        """(..., 1) bool: holds nothing."""
        return self.presence < MIN_USED

    @property
    def is_thing(self) -> Tensor:
        """(..., 1) bool: neither unused nor the background."""
        return (self.presence >= MIN_USED) & (self.presence < MIN_BACKGROUND)

    @property
    def is_background(self) -> Tensor:
        """(..., 1) bool: the canvas behind everything."""
        return self.presence >= MIN_BACKGROUND

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
            raise ValueError("these slots have no explicit colour, position or scale (layout.explicit is False)")
        if slots.shape[-1] != layout.dim:
            raise ValueError(f"slots are {slots.shape[-1]} wide, the layout says {layout.dim}")
        content, color, position, scale, presence = slots.split([layout.content, 3, 2, 2, 1], dim=-1)
        return cls(content, color, position, scale, presence)


def moments(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Centre of mass and standard deviation, each (B, K, 2) as (x, y) in -1..1, of masks (B, K, H, W)."""
    grid_N2 = pixel_grid(masks.shape[-2], masks.shape[-1], device=masks.device).flatten(0, 1)
    # bfloat16 would lose the difference of squares of a small thing far from the centre.
    with full_precision(masks.device):
        masks = masks.float()
        weights_BKN = masks.flatten(2) / masks.sum((2, 3))[..., None].clamp_min(1e-6)
        position = weights_BKN @ grid_N2
        variance = weights_BKN @ grid_N2.square() - position.square()
    return position, variance.clamp_min(MIN_SCALE**2).sqrt()
