"""MAGE's own text encoder: a small post-norm transformer over words, with learned positions.

"Make It Move" (CVPR 2022), section 3.3; its sizes and the order of its norms are those of the published configuration.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from textocvp.baselines.mage.layers import BiasedAttention, FeedForward
from textocvp.config import TextConfig
from textocvp.predictors.base import mask_bias
from textocvp.text import build_text_encoder
from textocvp.text.base import RGB, TextEncoder, TextTokens, WordBatch
from textocvp.text.words import GRAMMAR, TRAIN_COLORS

SPECIAL = ("<pad>", "<unk>")
PAD, UNKNOWN = range(2)

_WORD = re.compile(r"[a-z0-9']+")


@dataclass(frozen=True)
class PublishedTextConfig:
    """Words to tokens with a transformer from scratch.

    Attributes:
        kind: always `published`; tells this from the encoders of `textocvp.text`.
        dim: token width.
        layers: of the transformer.
        heads: of its attention.
        hidden: width of its feed-forward nets.
        max_tokens: longest sentence in words; a longer one is an error.
        vocabulary: words with an embedding each, in the order of its rows, after the special tokens.
        rows: of the word embedding. Published are more than there are words; the rest is never used.
    """

    kind: Literal["published"] = "published"
    dim: int = 512
    layers: int = 2
    heads: int = 16
    hidden: int = 2048
    max_tokens: int = 32
    vocabulary: tuple[str, ...] = GRAMMAR + TRAIN_COLORS
    rows: int = 30

    def __post_init__(self) -> None:
        wanted = len(SPECIAL) + len(self.vocabulary)
        if self.rows < wanted:
            raise ValueError(f"text.rows must be at least {wanted} for this text.vocabulary, not {self.rows}")


class _PostNormBlock(nn.Module):
    def __init__(self, config: PublishedTextConfig) -> None:
        super().__init__()
        self.attention = BiasedAttention(config.dim, config.heads)
        self.norm_attention = nn.LayerNorm(config.dim)
        self.feed_forward = FeedForward(config.dim, config.hidden)
        self.norm_feed_forward = nn.LayerNorm(config.dim)

    def forward(self, x_BLC: Tensor, bias_B11L: Tensor) -> Tensor:
        x_BLC = self.norm_attention(x_BLC + self.attention(x_BLC, bias_B11L))
        return self.norm_feed_forward(x_BLC + self.feed_forward(x_BLC))


class PublishedText(TextEncoder):
    """Words to tokens. Padding is masked, so what a sentence means does not depend on its neighbours in the batch."""

    pad = PAD
    config: PublishedTextConfig  # type: ignore[assignment]

    def __init__(self, config: PublishedTextConfig) -> None:
        super().__init__()
        self.config = config
        self._numbers = {word: row for row, word in enumerate((*SPECIAL, *config.vocabulary))}
        self.embedding = nn.Embedding(config.rows, config.dim, padding_idx=PAD)
        self.positions_LC = nn.Parameter(torch.empty(config.max_tokens, config.dim))
        for weight in (self.embedding.weight, self.positions_LC):
            nn.init.normal_(weight, std=0.02)
        with torch.no_grad():
            self.embedding.weight[PAD].zero_()
        self.norm_words = nn.LayerNorm(config.dim, eps=1e-8)
        self.blocks = nn.ModuleList(_PostNormBlock(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(config.dim)
        self.project = nn.Linear(config.dim, config.dim)

    @property
    def device(self) -> torch.device:
        return self.embedding.weight.device

    def words(self, text: str) -> list[str]:
        """The words of a sentence, lower case, one a token."""
        return _WORD.findall(text.lower())

    def unknown_words(self, text: str) -> list[str]:
        return list(dict.fromkeys(word for word in self.words(text) if word not in self._numbers))

    def _rows(self, text: str) -> list[tuple[int, RGB | None]]:
        return [(self._numbers.get(word, UNKNOWN), None) for word in self.words(text)]

    def encode(self, words: WordBatch) -> TextTokens:
        mask_BL = words.ids_BL != PAD
        length = mask_BL.shape[1]
        self._check_length(length, "this batch")
        x_BLC = self.norm_words(self.embedding(words.ids_BL) + self.positions_LC[:length])
        bias_B11L = mask_bias(~mask_BL)[:, None, None]
        for block in self.blocks:
            x_BLC = block(x_BLC, bias_B11L)
        x_BLC = self.project(self.norm(x_BLC)) * mask_BL[..., None]
        return TextTokens(x_BLC, mask_BL, words.colors_BL3, words.names_color_BL)


def build_text(config: TextConfig | PublishedTextConfig, files: Path | None = None) -> TextEncoder:
    """The text encoder of a MAGE: its own, or any of TextOCVP's.

    Raises:
        ValueError: as `textocvp.text.build_text_encoder`.
    """
    if isinstance(config, PublishedTextConfig):
        return PublishedText(config)
    return build_text_encoder(config, files)
