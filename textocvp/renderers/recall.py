"""A renderer that decodes everything and corrects it by what it got wrong about the first frame.

`carry` copies pixels of things that look the same wherever they are; in CATER they turn, and grow as they come nearer.
So each slot is decoded, as by `glimpse`, and what the first frame showed beyond that (its texture, its shading, its
exact outline) goes with the slot, the less the more the slot's picture has changed. What stands still is exact.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.crop import NOTHING
from textocvp.layers import MASKED
from textocvp.renderers.base import Rendered, Seen
from textocvp.renderers.glimpse import GlimpseRenderer, PictureConfig
from textocvp.slots import SlotLayout, SlotState

CHANGED = 0.08  # mean change of a slot's shading at which little of the correction is left
BORDER = 3  # pixels around where a thing stood in which its shadow and its mixed border lay


@dataclass(frozen=True)
class RecallConfig(PictureConfig):
    """Options of `RecallRenderer`."""

    kind: Literal["recall"] = "recall"


class RecallRenderer(GlimpseRenderer):
    """Draws with a first frame in mind, or without one like `GlimpseRenderer`. Learns as that does.

    Which of two things hides the other is learned from what and where they are: a cone that is put over a ball has the
    same place as the ball.
    """

    Config = RecallConfig

    def __init__(self, config: PictureConfig, layout: SlotLayout, image_size: int) -> None:
        super().__init__(config, layout, image_size)
        order = nn.Linear(64, 1)
        nn.init.zeros_(order.weight)
        self.front = nn.Sequential(nn.Linear(layout.content + 4, 64), nn.ReLU(), order)

    def forward(self, slots: Tensor, seen: Seen | None = None) -> Rendered:
        """Draw one frame for each set of slots (B, K, D): of any sequences, or of the one that began as `seen`."""
        drawn = super().forward(slots)
        if seen is None:
            return drawn
        first = super().forward(seen.slots_KD[None])
        correction_3HW = seen.frame_3HW - first.frames_B3HW[0]
        labels_HW, slot_THW = first.masks_BKHW[0].argmax(0), drawn.masks_BKHW.argmax(1)
        T, H, W = slot_THW.shape
        state, before = (SlotState.split(x, self.layout) for x in (slots, seen.slots_KD))
        shift_TK2 = ((state.position - before.position) * (W / 2)).round().long()
        shift_TK2 = torch.where(state.is_thing, shift_TK2, 0)

        # Each pixel gets what was wrong with the pixel of its slot that was in its place of the slot.
        t_T11 = torch.arange(T, device=slots.device)[:, None, None]
        y_HW, x_HW = torch.meshgrid(*(torch.arange(n, device=slots.device) for n in (H, W)), indexing="ij")
        from_x_THW, from_y_THW = (grid - shift_TK2[t_T11, slot_THW, axis] for axis, grid in enumerate((x_HW, y_HW)))
        inside_THW = (from_x_THW >= 0) & (from_x_THW < W) & (from_y_THW >= 0) & (from_y_THW < H)
        from_x_THW, from_y_THW = from_x_THW.clamp(0, W - 1), from_y_THW.clamp(0, H - 1)
        known_THW = inside_THW & (labels_HW[from_y_THW, from_x_THW] == slot_THW)
        # The floor where a thing stood that has left: its shadow has left with it.
        moved_TK = (shift_TK2.abs().amax(-1) > 0).float()
        own_KHW = F.one_hot(labels_HW, slots.shape[1]).permute(2, 0, 1).float()
        near_KHW = F.max_pool2d(own_KHW, 2 * BORDER + 1, 1, BORDER)
        left_THW = (moved_TK @ near_KHW.flatten(1)).unflatten(1, (H, W)) > 0
        share_THW = self._alike(state, before)[t_T11, slot_THW] * (known_THW & ~(left_THW & (slot_THW == labels_HW)))
        correction_T3HW = correction_3HW[:, from_y_THW, from_x_THW].transpose(0, 1) * share_THW[:, None]
        return Rendered(drawn.frames_B3HW + correction_T3HW, drawn.masks_BKHW, drawn.draw_objects)

    def remember(self, frames_B3HW: Tensor, attention_BKhw: Tensor, slots_BKD: Tensor) -> tuple[Seen, ...]:
        """See `Renderer.remember`; of larger frames it keeps their means at the model's size."""
        frames_B3HW = F.adaptive_avg_pool2d(frames_B3HW, self.image_size)
        labels_BHW = attention_BKhw.argmax(1)
        return tuple(map(Seen, frames_B3HW, frames_B3HW, labels_BHW, slots_BKD))

    def _compete(self, logits_BKHW: Tensor, state: SlotState) -> Tensor:
        """Masks: the background is where no thing is, and things share the rest, those in front the most of it."""
        where_BK4 = torch.cat([state.position, state.scale.clamp_min(1e-3).log()], -1)
        front_BK11 = self.front(torch.cat([state.content, where_BK4], -1))[..., None]
        logits_BKHW = logits_BKHW.masked_fill(~state.is_thing[..., None], NOTHING).float()
        free_B1HW = F.logsigmoid(-logits_BKHW).sum(1, keepdim=True).exp()
        order_BKHW = (F.logsigmoid(logits_BKHW) + front_BK11).masked_fill(~state.is_thing[..., None], MASKED)
        masks_BKHW = (1 - free_B1HW) * order_BKHW.softmax(1)
        return torch.where(state.is_background[..., None], free_B1HW, masks_BKHW)

    def _alike(self, state: SlotState, before: SlotState) -> Tensor:
        """How much of the correction is left (T, K): 1 for a slot whose picture is as it was."""
        shading_TKN, first_KN = (self.decoder(x.content).unflatten(-1, (2, -1))[..., 1, :] for x in (state, before))
        change_TK = (shading_TKN - first_KN).abs().mean(-1)
        grown_TK = (state.scale / before.scale).log().abs().amax(-1)
        alike_TK = torch.exp(-(change_TK / CHANGED).square() - (grown_TK / 0.2).square())
        return torch.where(state.is_thing[..., 0], alike_TK, 1.0)
