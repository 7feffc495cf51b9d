"""What the parser is trained for (stage 1). The predictor's losses live beside its loop."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from textocvp.placed import moments
from textocvp.renderer import Rendered
from textocvp.slots import SlotState


@dataclass
class ParserLoss:
    """The terms of stage 1, each a scalar.

    Attributes:
        image: mean squared error of the reconstruction, things weighted above the canvas.
        mask: cross-entropy of the drawn masks against the parser's attention.
        place: squared error of the places that the transition expected against those the corrector found; for slots
            without explicit places, of those that the renderer reads off them against those of their attention.
        feature: mean squared error of the reconstructed features, for renderers that have any.
    """

    image: Tensor
    mask: Tensor
    place: Tensor
    feature: Tensor

    def total(self, mask_weight: float, place_weight: float, feature_weight: float) -> Tensor:
        """The weighted sum that is minimised."""
        return (
            self.image + mask_weight * self.mask + place_weight * self.place + feature_weight * self.feature
        )

    def figures(self) -> dict[str, Tensor]:
        """The terms, named for a log."""
        return {f"loss/{name}": getattr(self, name).detach() for name in self.__dataclass_fields__}


def thing_weights(target: Tensor, thing_weight: float, threshold: float = 0.08) -> Tensor:
    """Weights (B, 1, H, W) of the pixels of frames (B, 3, H, W) in -1..1: 1, and `thing_weight` more on things.

    A pixel shows a thing where it differs from its image's median colour by more than `threshold`: no labels needed.
    """
    median = target.flatten(-2).median(-1).values[..., None, None]
    thing = (target - median).abs().amax(-3, keepdim=True) > threshold
    return 1 + thing_weight * thing.to(target.dtype)


def image_loss(rendered: Rendered, target: Tensor, weights: Tensor, whole: Tensor | None = None) -> Tensor:
    """Weighted mean squared error of the composed frames against frames (B, 3, H, W).

    Args:
        whole: the sum of the weights of the whole batch, when these are a part of it: the losses of all parts then add
            up to that of the batch.
    """
    whole = weights.sum() if whole is None else whole
    return (weights * (rendered.frames_B3HW - target).square()).sum() / (3 * whole)


def mask_loss(
    rendered: Rendered, attention_BKHW: Tensor, weights: Tensor, whole: Tensor | None = None
) -> Tensor:
    """Weighted cross-entropy of the drawn masks against the attention's winners; no gradient enters the attention.

    The renderer sees only the slots, the attention also the pixels: agreeing with it teaches the renderer where a
    slot ends long before the image loss alone would, and without labels (self-distillation, as in SPOT, 2024).
    `whole` is as in `image_loss`.
    """
    log_masks = rendered.masks_BKHW.clamp_min(1e-6).log()
    per_pixel = F.nll_loss(log_masks, attention_BKHW.argmax(1), reduction="none")
    return (weights[:, 0] * per_pixel).sum() / (weights.sum() if whole is None else whole)


def place_loss(expected: SlotState, found: SlotState) -> Tensor:
    """Mean squared error of expected places and log-sizes, over the things of each clip, then over the clips (B, T, K).

    No gradient enters `found`.
    """
    wanted = torch.cat([found.position, found.scale.log()], dim=-1).detach()
    error = (torch.cat([expected.position, expected.scale.log()], dim=-1) - wanted).square().mean(-1)
    things = found.is_thing[..., 0]
    error_B = torch.where(things, error, torch.zeros_like(error)).sum((1, 2)) / things.sum((1, 2)).clamp_min(
        1
    )
    return error_B.mean()


def read_place_loss(position_BK2: Tensor, scale_BK2: Tensor, attention_BKHW: Tensor) -> Tensor:
    """Mean squared error of places and log-sizes against mean and deviation of the grid under the attention.

    No gradient enters the attention.
    """
    center_BK2, deviation_BK2 = moments(attention_BKHW.detach())
    return ((position_BK2 - center_BK2).square() + (scale_BK2 / deviation_BK2).log().square()).mean()
