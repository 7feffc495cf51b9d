"""MAGE's own text encoder: a small post-norm transformer over words, with learned positions.

"Make It Move" (CVPR 2022), section 3.3; its sizes and the order of its norms are those of the published configuration.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from textocvp.baselines.mage.layers import BiasedAttention, FeedForward
from textocvp.layers import mask_bias
from textocvp.text import ENCODERS
from textocvp.text.base import TextEncoder, TextTokens, WordBatch
from textocvp.text.words import PAD, UNKNOWN, WordEncoder, WordsConfig

FIRST_WORD = 1 + max(PAD, UNKNOWN)  # its row in the embedding: no word here stands for all colours


@dataclass(frozen=True)
class PublishedTextConfig(WordsConfig):
    """Options of `PublishedText`."""

    kind: Literal["published"] = "published"  # type: ignore[assignment]
    dim: int = 512
    max_tokens: int = 32
    heads: int = 16
    hidden: int = 2048
    rows: int = 30  # of the word embedding; as published more than there are words: the rest is never used

    def __post_init__(self) -> None:
        super().__post_init__()
        wanted = FIRST_WORD + len(self.vocabulary)
        if self.rows < wanted:
            raise ValueError(f"text.rows must be at least {wanted} for text.vocabulary, not {self.rows}")


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


class PublishedText(WordEncoder):
    """Splits sentences into words as `WordEncoder` does, and encodes them with a network of its own."""

    Config = PublishedTextConfig  # type: ignore[assignment]
    config: PublishedTextConfig

    def __init__(self, config: PublishedTextConfig, files: Path | None = None) -> None:
        TextEncoder.__init__(self, config)  # without the weights of a `WordEncoder`
        self._vocabulary = {word: row for row, word in enumerate(config.vocabulary, start=FIRST_WORD)}
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


TEXT_ENCODERS: dict[str, type[TextEncoder]] = {**ENCODERS, "published": PublishedText}
"""What `text.kind` of a MAGE names: its own encoder, or any of TextOCVP's."""
