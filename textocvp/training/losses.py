"""What the parser (stage 1) and the predictor (stage 2) are trained for."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from textocvp.renderers.base import Rendered, Renderer
from textocvp.slots import SlotLayout, SlotState, moments

ACTS = 0.1  # it acts when it gets further than this from its place, -1..1: three pixels of 64,
REACHED = 0.07  # or when one that moves comes to rest so near to it
TURNS = 0.1  # it may have turned when its content changes by so many of its deviations, in the mean square
MOVES = 0.015  # a slot moves when its centre shifts by more than this in a frame, -1..1: half a pixel of 64
UNIT = 0.03  # position errors are counted in these, about a pixel of 64: quadratic below, linear above


@dataclass
class ParserLoss:
    """The terms of stage 1, each a scalar, 0 where a model has nothing to compare."""

    image: Tensor  # `image_loss` of the redrawn frames
    mask: Tensor  # `mask_loss`, the agreement between drawn masks and attention
    place: Tensor  # `place_loss`; for slots without explicit places `read_place_loss`
    feature: Tensor  # mean squared error of the reconstructed features
    lesson: Tensor  # what a parser that is taught gets wrong

    def total(self) -> Tensor:
        """The weighted sum that is minimised."""
        return self.image + 0.1 * self.mask + 0.1 * self.place + self.feature + self.lesson


def thing_weights(target: Tensor, thing_weight: float) -> Tensor:
    """Weights (B, 1, H, W) of the pixels of frames (B, 3, H, W) in -1..1: 1, and `thing_weight` more on things."""
    # A pixel shows a thing where it differs from its image's median colour: no labels needed.
    median = target.flatten(-2).median(-1).values[..., None, None]
    thing = (target - median).abs().amax(-3, keepdim=True) > 0.08
    return 1 + thing_weight * thing.to(target.dtype)


def image_loss(rendered: Rendered, target: Tensor, weights: Tensor, whole: Tensor | None = None) -> Tensor:
    """Weighted mean squared error of the composed frames against frames (B, 3, H, W).

    Args:
        weights: from `thing_weights`.
        whole: their sum over the whole batch, where these frames are a part of it; the parts' losses then add up.
    """
    whole = weights.sum() if whole is None else whole
    return (weights * (rendered.frames_B3HW - target).square()).sum() / (3 * whole)


def mask_loss(rendered: Rendered, attention_BKHW: Tensor, weights: Tensor, whole: Tensor | None = None) -> Tensor:
    """Weighted cross-entropy of the drawn masks against the attention's winners (self-distillation, as in SPOT, 2024).

    No gradient enters the attention. `weights` and `whole` are as in `image_loss`.
    """
    # The attention sees the pixels, the renderer only the slots: this teaches it early where a slot ends.
    log_masks = rendered.masks_BKHW.clamp_min(1e-6).log()
    per_pixel = F.nll_loss(log_masks, attention_BKHW.argmax(1), reduction="none")
    return (weights[:, 0] * per_pixel).sum() / (weights.sum() if whole is None else whole)


def place_loss(expected: SlotState, found: SlotState) -> Tensor:
    """Squared error of expected places and log-sizes, the mean over each clip's things, then over the clips (B, T, K).

    No gradient enters `found`.
    """
    wanted = torch.cat([found.position, found.scale.log()], dim=-1).detach()
    error = (torch.cat([expected.position, expected.scale.log()], dim=-1) - wanted).square().mean(-1)
    things = found.is_thing[..., 0]
    sum_B = torch.where(things, error, torch.zeros_like(error)).sum((1, 2))
    return (sum_B / things.sum((1, 2)).clamp_min(1)).mean()


def read_place_loss(position_BK2: Tensor, scale_BK2: Tensor, attention_BKHW: Tensor) -> Tensor:
    """Mean squared error of places and log-sizes against those of the attention, which no gradient enters."""
    center_BK2, deviation_BK2 = moments(attention_BKHW.detach())
    return ((position_BK2 - center_BK2).square() + (scale_BK2 / deviation_BK2).log().square()).mean()


@dataclass
class SlotLoss:
    """The terms of stage 2, each a scalar averaged over slots."""

    position: Tensor  # Huber loss of the centre, in units of about a pixel
    scale: Tensor  # squared error of the log-scale, in tenths
    content: Tensor  # squared error of the content, or of the whole slot if it has no explicit channels

    def total(self, content_weight: float) -> Tensor:
        """The weighted sum that is minimised."""
        return self.position + 0.1 * self.scale + content_weight * self.content


def slot_loss(
    predicted_BTKD: Tensor, target_BTKD: Tensor, weights_BTK: Tensor, layout: SlotLayout, content_std_C: Tensor | None
) -> SlotLoss:
    """Compare predicted slots with the parser's.

    Args:
        weights_BTK: how much each slot counts, see `moving_weights`; they sum to 1 over a batch.
        content_std_C: standard deviation of each content channel over the training slots, in which its error is
            counted; None for slots without explicit channels that are compared as they are.
    """
    if not layout.explicit:
        error_BTKD = predicted_BTKD - target_BTKD
        if content_std_C is not None:
            error_BTKD = error_BTKD / content_std_C
        error_BTK = error_BTKD.square().mean(dim=-1)
        zero = error_BTK.new_zeros(())
        return SlotLoss(zero, zero, (weights_BTK * error_BTK).sum())
    assert content_std_C is not None
    predicted, target = SlotState.split(predicted_BTKD, layout), SlotState.split(target_BTKD, layout)
    off = (predicted.position - target.position) / UNIT
    position_BTK = F.smooth_l1_loss(off, torch.zeros_like(off), reduction="none").sum(dim=-1)
    scale_BTK = ((predicted.scale / target.scale.clamp(min=1e-3)).log() / 0.1).square().sum(dim=-1)
    # Where the parser lost a slot for a frame its size jumps: such frames must not drown the others.
    scale_BTK = scale_BTK.clamp(max=25.0)
    content_BTK = ((predicted.content - target.content) / content_std_C).square().mean(dim=-1)
    return SlotLoss(
        (weights_BTK * position_BTK).sum(), (weights_BTK * scale_BTK).sum(), (weights_BTK * content_BTK).sum()
    )


def moving_weights(slots_BTKD: Tensor, layout: SlotLayout, moving: float, *, ever: bool) -> Tensor:
    """How much each true slot of frames 1 to T - 1 counts (B, T - 1, K): `moving` where it moves, else 1; 0 if unused.

    Args:
        ever: weigh a slot that moves anywhere in these frames alike in all of them. For rollouts, where a
            slot that has come to rest in the wrong place is still wrong.
    """
    # Most slots of most frames stand still; unweighted, "nothing moves" is almost the best answer.
    if not layout.explicit:
        return slots_BTKD.new_ones(slots_BTKD[:, 1:, :, 0].shape)
    state = SlotState.split(slots_BTKD, layout)
    moves_BTK = (state.position[:, 1:] - state.position[:, :-1]).norm(dim=-1) > MOVES
    if ever:
        moves_BTK = moves_BTK.any(dim=1, keepdim=True).expand_as(moves_BTK)
    present_BTK = state.presence[:, 1:, :, 0] >= 0.5
    return present_BTK * (1.0 + (moving - 1.0) * moves_BTK)


def acting(slots_BTKD: Tensor, layout: SlotLayout, content_std_C: Tensor) -> tuple[Tensor, Tensor]:
    """Which slots act in their frames (B, K) bool: that move, or that one that moves is put onto; and who may act.

    The second also has those that look otherwise at the end: they may have turned, or something else stands before
    them.
    """
    state = SlotState.split(slots_BTKD, layout)
    things_BK = state.is_thing[:, 0, :, 0]
    moves_BK = ((state.position - state.position[:, :1]).norm(dim=-1).amax(1) > ACTS) & things_BK
    ends_BKK = torch.cdist(state.position[:, 0], state.position[:, -1])  # from each slot to where each ends
    acting_BK = moves_BK | ((ends_BKK < REACHED) & moves_BK[:, None]).any(2) & things_BK
    turned_BKC = (state.content[:, -1] - state.content[:, 0]) / content_std_C.to(slots_BTKD.device)
    return acting_BK, acting_BK | (turned_BKC.square().mean(-1) > TURNS) & things_BK


def drawn_loss(renderer: Renderer, predicted_BSKD: Tensor, drawn_BF: NDArray[np.int64], true_BF3HW: Tensor) -> Tensor:
    """Mean squared error of the frames `drawn_BF` of the S predicted ones; its gradient flows through the renderer."""
    slots_BFKD = predicted_BSKD[torch.arange(len(drawn_BF))[:, None], torch.from_numpy(drawn_BF)]
    frames = renderer(slots_BFKD.flatten(0, 1)).frames_B3HW
    return (frames - true_BF3HW.to(frames.device).flatten(0, 1)).square().mean()
