"""One layer of the predictor, and the colour-matching term of its attention to the text."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from textocvp.attention import NEVER, FeedForward, KeyValueCache, SelfAttention, TextAttention
from textocvp.config import PredictorConfig
from textocvp.text import TextTokens


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
    best_B1L = match_BKL.masked_fill(~present_BK[..., None], NEVER).amax(dim=1, keepdim=True)
    return ((match_BKL - best_B1L) * text.names_color_BL[:, None]).clamp(max=0.0)
