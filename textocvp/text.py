"""From sentences to tokens: word-level text encoders trained from scratch.

Two kinds (`TextConfig.kind`). `transformer`: a learned embedding for every word of the caption grammar and
every training colour, then a small transformer (the paper finds such an encoder equal to T5 on CATER).
`lexicon`: the same, but all colour words share one embedding and differ only in the RGB that a public lexicon
gives for their name, so a colour that no caption ever named is understood like any other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from textocvp.attention import FeedForward, SelfAttention
from textocvp.config import TextConfig
from textocvp.lexicon import longest_name, palette

# Row 0 is padding, so that a padded batch needs no other bookkeeping. The order is part of every checkpoint:
# append.
SPECIAL = ("<pad>", "<unk>", "<color>")
GRAMMAR = (
    "put",
    "the",
    "block",
    "in",
    "bowl",
    "and",
    "then",
    "into",
    "a",
    "on",
    "place",
    "move",
    "of",
    "with",
    "to",
)
TRAIN_COLORS = ("blue", "green", "red", "brown", "cyan", "gray", "yellow")
PAD, UNKNOWN, COLOR = range(3)

_WORD = re.compile(r"[a-z0-9']+")


@dataclass
class TextTokens:
    """A batch of encoded sentences.

    Attributes:
        embeddings_BLC: contextual token embeddings; zero where there is no word.
        mask_BL: True where there is a word.
        colors_BL3: RGB in -1..1 of the colour that a word names (`lexicon` only; zeros elsewhere).
        names_color_BL: True where `colors_BL3` means something.
    """

    embeddings_BLC: Tensor
    mask_BL: Tensor
    colors_BL3: Tensor
    names_color_BL: Tensor

    def select(self, index: Tensor | slice) -> TextTokens:
        """A sub-batch."""
        return TextTokens(
            self.embeddings_BLC[index],
            self.mask_BL[index],
            self.colors_BL3[index],
            self.names_color_BL[index],
        )

    def __len__(self) -> int:
        return self.mask_BL.shape[0]


@dataclass
class WordBatch:
    """Sentences before encoding: what the lexicon says about every word, still free of learned parameters.

    Attributes:
        ids_BL: row in the vocabulary; 0 is padding.
        colors_BL3, names_color_BL: as in `TextTokens`.
    """

    ids_BL: Tensor
    colors_BL3: Tensor
    names_color_BL: Tensor

    def select(self, index: Tensor | slice) -> WordBatch:
        """A sub-batch."""
        return WordBatch(self.ids_BL[index], self.colors_BL3[index], self.names_color_BL[index])

    def permute_channels(self, order_B3: Tensor) -> WordBatch:
        """Each sentence's colours with their RGB channels reordered (training augmentation)."""
        index_BL3 = order_B3[:, None, :].expand_as(self.colors_BL3)
        return replace(self, colors_BL3=self.colors_BL3.gather(-1, index_BL3))

    def to(self, device: torch.device | str) -> WordBatch:
        return WordBatch(self.ids_BL.to(device), self.colors_BL3.to(device), self.names_color_BL.to(device))


class _Block(nn.Module):
    """Pre-norm transformer encoder block over the words of a sentence."""

    def __init__(self, config: TextConfig) -> None:
        super().__init__()
        self.norm_attention = nn.LayerNorm(config.dim, eps=1e-6)
        self.attention = SelfAttention(config.dim, config.heads)
        self.norm_feed_forward = nn.LayerNorm(config.dim, eps=1e-6)
        self.feed_forward = FeedForward(config.dim, config.hidden)

    def forward(self, x_BLC: Tensor, bias_B11L: Tensor) -> Tensor:
        x_BLC = x_BLC + self.attention(self.norm_attention(x_BLC), bias_B11L)
        return x_BLC + self.feed_forward(self.norm_feed_forward(x_BLC))


class TextEncoder(nn.Module):
    """Sentences to `TextTokens`.

    Padding is masked everywhere (the authors' code does not mask it in the cross-attention), so what a
    sentence means does not depend on its neighbours in the batch.
    """

    positions_LC: Tensor

    def __init__(self, config: TextConfig) -> None:
        super().__init__()
        self.config = config
        vocabulary = SPECIAL + GRAMMAR + (TRAIN_COLORS if config.kind == "transformer" else ())
        self._rows = {word: row for row, word in enumerate(vocabulary)}
        self.embedding = nn.Embedding(len(vocabulary), config.dim, padding_idx=PAD)
        nn.init.normal_(self.embedding.weight, std=0.5)
        with torch.no_grad():
            self.embedding.weight[PAD].zero_()
        self.color_projection = nn.Linear(3, config.dim, bias=False) if config.kind == "lexicon" else None
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(config.dim, eps=1e-6)
        self.register_buffer("positions_LC", sinusoids(config.max_tokens, config.dim), persistent=False)

    @property
    def device(self) -> torch.device:
        return self.embedding.weight.device

    @property
    def words_have_rgb(self) -> bool:
        """Whether colour words carry their RGB. Only then do they still fit a scene whose colours are changed."""
        return self.config.kind == "lexicon"

    def words(self, text: str) -> list[str]:
        """The words of a sentence as the encoder sees them, lower case, one a token.

        A colour name of several words ("light blue") is one token of the `lexicon` encoder.
        """
        found = _WORD.findall(text.lower())
        if self.config.kind != "lexicon":
            return found
        merged, at = [], 0
        while at < len(found):
            # Words of the grammar stay words, also where some palette calls a colour by one of them.
            length = 1 if found[at] in self._rows else self._color_length(found, at)
            merged.append(" ".join(found[at : at + length]))
            at += length
        return merged

    def _color_length(self, words: list[str], at: int) -> int:
        for length in range(min(longest_name(), len(words) - at), 1, -1):
            if tuple(words[at : at + length]) in palette():
                return length
        return 1

    def _row_and_color(self, word: str) -> tuple[int, tuple[float, float, float] | None]:
        if word in self._rows:
            return self._rows[word], None
        color = palette().get(tuple(word.split())) if self.config.kind == "lexicon" else None
        return (UNKNOWN, None) if color is None else (COLOR, color)

    def unknown_words(self, text: str) -> list[str]:
        """The words that mean nothing to this encoder, in order, each once: for a warning that names them."""
        return list(dict.fromkeys(w for w in self.words(text) if self._row_and_color(w)[0] == UNKNOWN))

    def lookup(self, texts: Sequence[str]) -> WordBatch:
        """Vocabulary rows and lexicon colours of the sentences, padded to the longest.

        Raises:
            ValueError: if a sentence has no word at all or more than `max_tokens`.
        """
        if isinstance(texts, str):
            raise TypeError("texts must be a sequence of sentences, not one string")
        sentences = [self.words(text) for text in texts]
        for text, sentence in zip(texts, sentences, strict=True):
            if not sentence:
                raise ValueError(f"a text needs at least one word, got {text!r}")
            if len(sentence) > self.config.max_tokens:
                raise ValueError(
                    f"a text may have at most {self.config.max_tokens} words, this has {len(sentence)}"
                )
        shape = (len(sentences), max(map(len, sentences), default=1))
        ids_BL, colors_BL3 = torch.full(shape, PAD), torch.zeros(*shape, 3)
        names_color_BL = torch.zeros(shape, dtype=torch.bool)
        for b, sentence in enumerate(sentences):
            for position, word in enumerate(sentence):
                row, color = self._row_and_color(word)
                ids_BL[b, position] = row
                if color is not None:
                    colors_BL3[b, position] = torch.tensor(color) * 2 - 1
                    names_color_BL[b, position] = True
        return WordBatch(ids_BL, colors_BL3, names_color_BL).to(self.device)

    def encode(self, words: WordBatch) -> TextTokens:
        """Embed looked-up words."""
        mask_BL = words.ids_BL != PAD
        length = mask_BL.shape[1]
        if length > self.config.max_tokens:
            raise ValueError(
                f"a text may have at most {self.config.max_tokens} words, this batch has {length}"
            )
        x_BLC = self.embedding(words.ids_BL)
        if self.color_projection is not None:
            x_BLC = x_BLC + self.color_projection(words.colors_BL3) * words.names_color_BL[..., None]
        x_BLC = x_BLC + self.positions_LC[:length]
        bias_B11L = torch.zeros_like(mask_BL, dtype=x_BLC.dtype).masked_fill(~mask_BL, -math.inf)[
            :, None, None
        ]
        for block in self.blocks:
            x_BLC = block(x_BLC, bias_B11L)
        x_BLC = self.norm(x_BLC) * mask_BL[..., None]
        return TextTokens(x_BLC, mask_BL, words.colors_BL3, words.names_color_BL)

    def forward(self, texts: Sequence[str]) -> TextTokens:
        """Encode sentences.

        Raises:
            ValueError: see `lookup`.
        """
        return self.encode(self.lookup(texts))


def sinusoids(length: int, dim: int) -> Tensor:
    """Sinusoidal position codes (length, dim), as in "Attention Is All You Need" (2017)."""
    position_L1 = torch.arange(length, dtype=torch.float32)[:, None]
    rate_c = torch.exp(-math.log(10_000.0) * torch.arange(0, dim, 2, dtype=torch.float32) / dim)
    codes_LC = torch.zeros(length, dim)
    codes_LC[:, 0::2] = torch.sin(position_L1 * rate_c)
    codes_LC[:, 1::2] = torch.cos(position_L1 * rate_c[: dim // 2])
    return codes_LC
