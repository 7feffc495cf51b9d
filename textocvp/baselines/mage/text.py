"""MAGE's own text encoder: a small post-norm transformer over words, with learned positions.

"Make It Move" (CVPR 2022), section 3.3; its sizes and the order of its norms are those of the published configuration.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor, nn

from textocvp.baselines.mage.attention import BiasedAttention, FeedForward
from textocvp.baselines.mage.config import PublishedTextConfig
from textocvp.layers import MASKED
from textocvp.text import TextConfig, build_text_encoder
from textocvp.text.base import RGB, TextEncoder, TextTokens, WordBatch
from textocvp.text.words import GRAMMAR, TRAIN_COLORS

WORDS = ("<pad>", "<unk>", *GRAMMAR, *TRAIN_COLORS)
"""Row by row; the order is part of every checkpoint: append."""
PAD, UNKNOWN = 0, 1

_WORD = re.compile(r"[a-z0-9']+")


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
    """Words to tokens. Padding is masked, so what a sentence means does not depend on its neighbours in the batch.

    Raises:
        ValueError: if the embedding has fewer rows than there are words.
    """

    pad = PAD
    config: PublishedTextConfig  # type: ignore[assignment]

    def __init__(self, config: PublishedTextConfig) -> None:
        super().__init__(config)  # type: ignore[arg-type]
        if config.vocabulary < len(WORDS):
            raise ValueError(f"text.vocabulary must be at least {len(WORDS)}, not {config.vocabulary}")
        self.config = config
        self._numbers = {word: row for row, word in enumerate(WORDS)}
        self.embedding = nn.Embedding(config.vocabulary, config.dim, padding_idx=PAD)
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
        bias_B11L = torch.zeros_like(mask_BL, dtype=x_BLC.dtype).masked_fill(~mask_BL, MASKED)[:, None, None]
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
