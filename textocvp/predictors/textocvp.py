"""The published predictor, a transformer conditioned on the text (TextOCVP, TMLR 2026, section 3.2).

In every layer all slots of all frames attend to each other, then to the words.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor, nn

from textocvp.layers import MASKED, KeyValueCache, SelfAttention, TextAttention, mask_bias
from textocvp.predictors.appearance import Appearance, acting_loss
from textocvp.predictors.base import PredictorConfig, RolloutState, SlotPredictor, feed_forward
from textocvp.slots import SlotLayout, SlotState

if TYPE_CHECKING:
    from textocvp.text.base import TextTokens


@dataclass(frozen=True)
class TextOCVPConfig(PredictorConfig):
    """Options of the published predictor."""

    kind: Literal["textocvp"] = "textocvp"
    # Add `color_match` to the logits of the attention to the words, which the published model does not do. Needs
    # explicit slots and a text encoder whose words carry RGB.
    color_bias: bool = False
    # Add how well a slot's learned appearance fits a word, for words without RGB; needs explicit slots.
    appearance: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.color_bias and self.appearance:
            raise ValueError("predictor.appearance and predictor.color_bias exclude each other: set one to false")


class TextContext(NamedTuple):
    """What a rollout needs of the text: keys and values of the words for each layer, logit terms, colour match."""

    keys_values: list[tuple[Tensor, Tensor]]
    bias_B11L: Tensor
    match_BKL: Tensor | None


class TextOCVPPredictor(SlotPredictor):
    """Attention among all slots of all frames and from slots to words."""

    Config = TextOCVPConfig
    uses_text = True
    config: TextOCVPConfig

    def __init__(self, config: TextOCVPConfig, layout: SlotLayout, text_dim: int) -> None:
        super().__init__(config, layout, text_dim)
        if config.appearance and not layout.explicit:
            raise ValueError("predictor.appearance needs slots with explicit places: set it to false")
        self.appearance = Appearance(layout, text_dim) if config.appearance else None

    def _layer(self, text_dim: int) -> nn.Module:
        return TextOCVPLayer(self.config, text_dim)

    @property
    def learns_words(self) -> bool:
        return self.appearance is not None

    def words_loss(self, text: TextTokens, slots_BKD: Tensor, acting_BK: Tensor, known_BK: Tensor) -> Tensor:
        """What the matching of words with slots gets wrong about which slots act; 0 without such a matching."""
        if self.appearance is None:
            return slots_BKD.new_zeros(())
        shares_BKL, acts_BL = self._matched(text, slots_BKD, None)
        return acting_loss(shares_BKL, acts_BL, acting_BK, known_BK)

    def _matched(self, text: TextTokens, slots_BKD: Tensor, acting_BK: Tensor | None) -> tuple[Tensor, Tensor]:
        assert self.appearance is not None
        state = SlotState.split(slots_BKD, self.layout)
        content_BKC = (state.content - self.content_mean_C) / self.content_std_C
        words_BLC = text.embeddings_BLC if text.words_BLC is None else text.words_BLC
        return self.appearance(content_BKC, state, words_BLC, text.mask_BL, acting_BK)

    def _text_context(self, text: TextTokens, slots_BTKD: Tensor, acting_BK: Tensor | None = None) -> TextContext:
        match_BKL, slots_BKD = None, slots_BTKD[:, -1]
        if self.appearance is not None:
            match_BKL = Appearance.bias(*self._matched(text, slots_BTKD[:, 0], acting_BK))
        if self.config.color_bias:
            color_BK3 = SlotState.split(slots_BKD, self.layout).color
            match_BKL = color_match(color_BK3, self.layout.used(slots_BKD), text)
        keys_values = [layer.text_attention.keys_values(text.embeddings_BLC) for layer in self.layers]  # type: ignore
        return TextContext(keys_values, mask_bias(~text.mask_BL)[:, None, None], match_BKL)

    def _transform(self, x_BTKC: Tensor, state: RolloutState, newest_only: bool) -> tuple[Tensor, Tensor]:
        T, K = x_BTKC.shape[1:3]
        text: TextContext = state.text
        x_BNC = x_BTKC.flatten(1, 2)  # N = T * K tokens attend to M * K
        masked_BTMK = self._masked(state.unused_BMK, T)
        bias = mask_bias(masked_BTMK.flatten(2)).repeat_interleave(K, 1)[:, None]  # (B, 1, N, M * K)
        maps = []
        for index, layer in enumerate(self.layers):
            newest = None
            if newest_only and T > 1 and index == len(self.layers) - 1:
                newest, T, bias = K, 1, bias[..., -K:, :]  # nobody needs older frames after the last layer
            match_BNL = None if text.match_BKL is None else text.match_BKL.repeat(1, T, 1)
            words = (text.keys_values[index], text.bias_B11L, match_BNL)
            x_BNC, map_BhNL = layer(x_BNC, bias, *words, newest, state.caches[index])
            maps.append(map_BhNL[:, :, -K:])
        return x_BNC.unflatten(1, (T, K)), torch.stack(maps, dim=1)


class TextOCVPLayer(nn.Module):
    """Self-attention, attention from slots to words, and feed-forward nets; all pre-norm and residual."""

    def __init__(self, config: TextOCVPConfig, text_dim: int) -> None:
        super().__init__()
        self.norm_self = nn.LayerNorm(config.dim, eps=1e-6)
        self.self_attention = SelfAttention(config.dim, config.heads)
        self.norm_text = nn.LayerNorm(config.dim, eps=1e-6)
        self.text_attention = TextAttention(config.dim, config.heads, text_dim)
        self.feed_forwards = nn.ModuleList(feed_forward(config) for _ in range(config.feed_forwards))
        # How much a slot loses of a word's attention that does not fit it, per unit of squared RGB distance or
        # of the logarithm of its share.
        matched, gain = config.color_bias or config.appearance, 4.0 if config.color_bias else 1.0
        self.color_gain_h = nn.Parameter(torch.full((config.heads,), gain)) if matched else None

    def forward(
        self,
        x_BMC: Tensor,
        self_bias: Tensor,
        keys_values: tuple[Tensor, Tensor],
        text_bias: Tensor,
        match_BNL: Tensor | None,
        newest: int | None,
        cache: KeyValueCache | None,
    ) -> tuple[Tensor, Tensor]:
        """The last `newest` tokens (default: all) after the layer, and their attention to the words (B, h, N, L)."""
        attended_BNC = self.self_attention(self.norm_self(x_BMC), self_bias, newest, cache)
        x_BNC = attended_BNC + (x_BMC if newest is None else x_BMC[:, -newest:])
        if match_BNL is not None and self.color_gain_h is not None:
            text_bias = text_bias + self.color_gain_h[:, None, None] * match_BNL[:, None]
        text_update_BNC, map_BhNL = self.text_attention(self.norm_text(x_BNC), keys_values, text_bias)
        x_BNC = x_BNC + text_update_BNC
        for update in self.feed_forwards:
            x_BNC = x_BNC + update(x_BNC)
        return x_BNC, map_BhNL


def color_match(color_BK3: Tensor, used_BK: Tensor, text: TextTokens) -> Tensor:
    """How well each slot's colour fits each word (B, K, L): minus the squared RGB distance, relative to the best slot.

    It is 0 for the best used slot and for words that name no colour, below 0 otherwise.
    """
    # The slots of a scene are compared with each other: a lexicon's idea of a colour need not be the camera's.
    match_BKL = -(color_BK3[:, :, None] - text.colors_BL3[:, None]).square().sum(dim=-1)
    best_B1L = match_BKL.masked_fill(~used_BK[..., None], MASKED).amax(dim=1, keepdim=True)
    return ((match_BKL - best_B1L) * text.names_color_BL[:, None]).clamp(max=0.0)
