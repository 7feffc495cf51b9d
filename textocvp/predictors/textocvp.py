"""From the slots of some frames and a text to the slots of the next: the language-conditioned transformer.

The published predictor (TextOCVP, TMLR 2026, section 3.2), and `build_predictor`, the one place that picks a kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from textocvp.config import PredictorConfig
from textocvp.layers import MASKED, FeedForward, KeyValueCache, SelfAttention, TextAttention
from textocvp.predictors.base import Caches, Memory, SlotPredictor, mask_bias
from textocvp.slots import SlotLayout, SlotState
from textocvp.text.base import TextTokens


@dataclass
class _TextMemory(Memory):
    """Keys and values of the words for each layer, and logit terms."""

    keys_values: list[tuple[Tensor, Tensor]]
    mask_bias_B11L: Tensor
    match_BKL: Tensor | None


class Predictor(SlotPredictor):
    """All slots of all frames attend to each other and to the words, layer by layer.

    Args:
        config: sizes and form.
        layout: what the numbers of a slot mean.
        text_dim: width of the text tokens.

    Raises:
        ValueError: if `color_bias` is asked for without explicit slot colours.
    """

    hears_text = True

    def __init__(self, config: PredictorConfig, layout: SlotLayout, text_dim: int) -> None:
        if config.color_bias and not layout.explicit:
            raise ValueError("color_bias needs slots with explicit colour (layout.explicit)")
        super().__init__(config, layout, (PredictorLayer(config, text_dim) for _ in range(config.layers)))

    def _remember(self, text: TextTokens, slots_BKD: Tensor, caches: Caches | None) -> _TextMemory:
        keys_values = [layer.remember(text.embeddings_BLC) for layer in self.layers]  # type: ignore[operator]
        match_BKL = None
        if self.config.color_bias:
            color_BKD = SlotState.split(slots_BKD, self.layout).color
            match_BKL = color_match(color_BKD, self._present(slots_BKD), text)
        return _TextMemory(caches, keys_values, mask_bias(~text.mask_BL)[:, None, None], match_BKL)

    def _transform(
        self,
        x_BTKC: Tensor,
        absent_BMK: Tensor,
        frame_bias: Tensor | None,
        memory: Memory,
        *,
        newest_only: bool,
    ) -> tuple[Tensor, Tensor]:
        assert isinstance(memory, _TextMemory)
        frames, slots = x_BTKC.shape[1:3]
        x_BNC = x_BTKC.flatten(1, 2)
        bias = mask_bias(absent_BMK.flatten(1))[:, None, None]
        if frame_bias is not None:
            bias = bias + frame_bias.repeat_interleave(slots, 1).repeat_interleave(slots, 2)[:, None]
        maps = []
        for index, layer in enumerate(self.layers):
            cut = newest_only and frames > 1 and index == len(self.layers) - 1
            if cut:  # nobody asks the last layer for older frames
                bias, frames = bias[..., -slots:, :], 1
            match_BNL = None if memory.match_BKL is None else memory.match_BKL.repeat(1, frames, 1)
            x_BNC, map_BhNL = layer(
                x_BNC,
                bias,
                memory.keys_values[index],
                memory.mask_bias_B11L,
                match_BNL,
                newest=slots if cut else None,
                cache=None if memory.caches is None else memory.caches.layers[index],
            )
            maps.append(map_BhNL[:, :, -slots:])
        return x_BNC.unflatten(1, (frames, slots)), torch.stack(maps, dim=1)


class PredictorLayer(nn.Module):
    """Self-attention, text-to-slot cross-attention and one or two feed-forward nets, all pre-norm and
    residual.

    The authors' code has two feed-forward nets a layer, the paper's text one.
    """

    def __init__(self, config: PredictorConfig, text_dim: int) -> None:
        super().__init__()
        self.norm_self = nn.LayerNorm(config.dim, eps=1e-6)
        self.self_attention = SelfAttention(config.dim, config.heads)
        self.norm_text = nn.LayerNorm(config.dim, eps=1e-6)
        self.text_attention = TextAttention(config.dim, config.heads, text_dim)
        self.feed_forwards = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(config.dim, eps=1e-6), FeedForward(config.dim, config.hidden))
            for _ in range(config.feed_forwards)
        )
        # How much a slot of the wrong colour loses of a colour word's attention, per unit of squared RGB
        # distance.
        self.color_gain_h = nn.Parameter(torch.full((config.heads,), 4.0)) if config.color_bias else None

    def remember(self, text_BLC: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values of the words, (B, h, L, d) each, for `forward`."""
        return self.text_attention.keys_values(text_BLC)

    def forward(
        self,
        x_BMC: Tensor,
        self_bias: Tensor,
        keys_values: tuple[Tensor, Tensor],
        text_bias: Tensor,
        match_BNL: Tensor | None,
        *,
        newest: int | None = None,
        cache: KeyValueCache | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The `newest` last tokens (default: all) after the layer, and how they attended to the text."""
        attended_BNC = self.self_attention(self.norm_self(x_BMC), self_bias, newest=newest, cache=cache)
        x_BNC = attended_BNC + (x_BMC if newest is None else x_BMC[:, -newest:])
        if match_BNL is not None and self.color_gain_h is not None:
            text_bias = text_bias + self.color_gain_h[:, None, None] * match_BNL[:, None]
        told_BNC, weights_BhNL = self.text_attention(self.norm_text(x_BNC), keys_values, text_bias)
        x_BNC = x_BNC + told_BNC
        for feed_forward in self.feed_forwards:
            x_BNC = x_BNC + feed_forward(x_BNC)
        return x_BNC, weights_BhNL


def color_match(color_BK3: Tensor, present_BK: Tensor, text: TextTokens) -> Tensor:
    """How well each slot's colour fits each word: minus the squared RGB distance, the best present slot of a
    word at 0.

    0 everywhere for words that name no colour. The shift makes it a comparison between the things of the
    scene, so a lexicon's idea of a colour need not be the camera's.

    Returns:
        (B, K, L), at most 0 for present slots.
    """
    match_BKL = -(color_BK3[:, :, None] - text.colors_BL3[:, None]).square().sum(dim=-1)
    best_B1L = match_BKL.masked_fill(~present_BK[..., None], MASKED).amax(dim=1, keepdim=True)
    return ((match_BKL - best_B1L) * text.names_color_BL[:, None]).clamp(max=0.0)
