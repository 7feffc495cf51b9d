"""Word-level text encoders trained from scratch.

`transformer`: a learned embedding for every word, then a small transformer (the paper finds such an encoder equal to T5
on CATER). `lexicon`: the same, but all colour words share one embedding. They differ only in the RGB that a public
lexicon gives for their name, so a colour that no caption ever named is understood like any other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from textocvp.layers import FeedForward, SelfAttention, sinusoids
from textocvp.text.base import RGB, TextConfig, TextEncoder, TextTokens, WordBatch
from textocvp.text.wording import ELSEWHERE, HOLE, compile_rules, denials, match_form, reword, split

# Row 0 is padding, so that a padded batch needs no other bookkeeping. Row 1 is not used: unknown words are left out.
SPECIAL = ("<pad>", "<unk>", "<color>")
PAD, UNKNOWN, COLOR = range(3)


_WORD = re.compile(r"-\d+|[a-z0-9']+")  # what a vocabulary may contain
MOST_FORMS = 32  # captions of more forms than these are free text, whose forms say little

# Tableau's 2016 categorical palette, which matplotlib lacks (its `tab:` colours are the older one). Tableau
# calls #76b7b2 teal; captions of tabletop scenes call it cyan. It goes by both names.
TABLEAU_10 = {
    "blue": "#4e79a7", "orange": "#f28e2b", "red": "#e15759", "teal": "#76b7b2", "cyan": "#76b7b2",
    "green": "#59a14f", "yellow": "#edc948", "purple": "#b07aa1", "pink": "#ff9da7", "brown": "#9c755f",
    "gray": "#bab0ac", "grey": "#bab0ac",
}  # fmt: skip


@cache
def palette() -> dict[tuple[str, ...], RGB]:
    """Colour name, as a tuple of lower-case words, to RGB in 0..1; without names that are no words ("blue/green")."""
    from matplotlib.colors import CSS4_COLORS, XKCD_COLORS, to_rgb  # takes longer to import than all of this package

    xkcd = {name.removeprefix("xkcd:"): value for name, value in XKCD_COLORS.items()}
    merged = {**xkcd, **CSS4_COLORS, **TABLEAU_10}  # later palettes win
    return {tuple(name.split()): to_rgb(value) for name, value in merged.items() if "/" not in name}


@cache
def _longest_name() -> int:
    return max(map(len, palette()))


@dataclass(frozen=True)
class WordsConfig(TextConfig):
    """Options of `WordEncoder`."""

    kind: Literal["lexicon", "transformer"] = "lexicon"
    layers: int = 2
    heads: int = 4
    hidden: int = 256
    vocabulary: tuple[str, ...] = ()  # the words that have an embedding of their own, in the order of its rows
    untrained: tuple[str, ...] = ()  # those that no training caption contained: their embeddings are still random
    # How other wordings become those of the captions: rules for `textocvp.text.wording.reword`.
    rewrites: tuple[str, ...] = ()
    # What the training captions looked like, with {} for a colour; none where nobody listed them.
    forms: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wrong = [word for word in self.vocabulary if not _WORD.fullmatch(word)]
        if wrong:
            raise ValueError(
                f"text.vocabulary: {wrong[0]!r} is no word of lower-case letters and digits, and no number"
            )
        if len(set(self.vocabulary)) < len(self.vocabulary):
            raise ValueError("text.vocabulary has a word twice")
        unknown = [word for word in self.untrained if word not in self.vocabulary]
        if unknown:
            raise ValueError(f"text.untrained: {unknown[0]!r} is not in text.vocabulary")
        try:
            compile_rules(self.rewrites)
        except ValueError as error:
            raise ValueError(f"text.rewrites: {error}") from None

    @property
    def words_have_rgb(self) -> bool:
        return self.kind == "lexicon"

    def for_captions(self, captions: Iterable[str], vocabulary: Iterable[str] = ()) -> WordsConfig:
        said = sorted(set(captions))
        found = {word for caption in said for word in split(caption)}
        new = [word for word in (*vocabulary, *sorted(found)) if _WORD.fullmatch(word)]
        if self.words_have_rgb:  # the lexicon's colours need no embedding
            new = [word for word in new if (word,) not in palette()]
        words = tuple(dict.fromkeys([*self.vocabulary, *new]))  # known words keep their rows
        return replace(self, vocabulary=words, untrained=words, forms=()).met(said)

    def met(self, captions: Iterable[str]) -> WordsConfig:
        """That of the same encoder after training on these captions, whose words are in the vocabulary."""
        said = sorted(set(captions))
        found = {word for caption in said for word in split(caption)}
        # Rules that would change what is trained on are those of other captions.
        own = all(reword(caption, self.rewrites) == split(caption) for caption in said)
        untrained = tuple(word for word in self.untrained if word not in found)
        config = replace(self, untrained=untrained, rewrites=self.rewrites if own else ())
        forms = dict.fromkeys([*self.forms, *(config.form(config.tokens(caption)) for caption in said)])
        return replace(config, forms=tuple(forms) if len(forms) <= MOST_FORMS else ())

    def tokens(self, text: str) -> list[str]:
        """A sentence as reworded; for the `lexicon` a name like "light blue" is one token."""
        found = reword(text, self.rewrites)
        if not self.words_have_rgb:
            return found
        merged, at = [], 0
        while at < len(found):
            # Words of the vocabulary stay words, also where some palette calls a colour by one of them.
            length = 1 if found[at] in self.vocabulary else _color_length(found, at)
            merged.append(" ".join(found[at : at + length]))
            at += length
        return merged

    def form(self, tokens: Iterable[str]) -> str:
        """What a sentence is like: its tokens, with {} for those that name a colour."""
        return " ".join(HOLE if self.is_color(token) else token for token in tokens)

    def knows(self, token: str) -> bool:
        """Whether a token has an embedding that was trained, or for the `lexicon` an RGB."""
        if token in self.vocabulary:
            return token not in self.untrained
        return self.words_have_rgb and tuple(token.split()) in palette()

    def is_color(self, token: str) -> bool:
        """Whether a token names a colour."""
        # Without RGB of their own, colours are words of the vocabulary like any other.
        return tuple(token.split()) in palette() and not (self.words_have_rgb and token in self.vocabulary)


def _color_length(words: list[str], at: int) -> int:
    for length in range(min(_longest_name(), len(words) - at), 1, -1):
        if tuple(words[at : at + length]) in palette():
            return length
    return 1


class _Block(nn.Module):
    """Pre-norm transformer encoder block over the words of a sentence."""

    def __init__(self, config: WordsConfig) -> None:
        super().__init__()
        self.norm_attention = nn.LayerNorm(config.dim, eps=1e-6)
        self.attention = SelfAttention(config.dim, config.heads)
        self.norm_feed_forward = nn.LayerNorm(config.dim, eps=1e-6)
        self.feed_forward = FeedForward(config.dim, config.hidden)

    def forward(self, x_BLC: Tensor, bias_B11L: Tensor) -> Tensor:
        x_BLC = x_BLC + self.attention(self.norm_attention(x_BLC), bias_B11L)
        return x_BLC + self.feed_forward(self.norm_feed_forward(x_BLC))


class WordEncoder(TextEncoder):
    """The kinds `transformer` and `lexicon`: one token a word."""

    Config = WordsConfig
    config: WordsConfig
    pad = PAD
    positions_LC: Tensor

    def __init__(self, config: WordsConfig, files: Path | None = None) -> None:
        super().__init__(config)
        self._vocabulary = {word: row for row, word in enumerate(config.vocabulary, start=len(SPECIAL))}
        self.embedding = nn.Embedding(len(SPECIAL) + len(config.vocabulary), config.dim, padding_idx=PAD)
        nn.init.normal_(self.embedding.weight, std=0.5)
        with torch.no_grad():
            self.embedding.weight[PAD].zero_()
        self.color_projection = nn.Linear(3, config.dim, bias=False) if config.words_have_rgb else None
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(config.dim, eps=1e-6)
        self.register_buffer("positions_LC", sinusoids(config.max_tokens, config.dim), persistent=False)

    @property
    def device(self) -> torch.device:
        return self.embedding.weight.device

    def words(self, text: str) -> list[str]:
        """The tokens of a sentence that are encoded, in order: those of `WordsConfig.tokens` that it knows.

        A sentence of no form of the captions is read as the form that says the same (`match_form`), if there is one.
        Words that it does not know are left out: one that was never trained would say something, but nothing true.
        """
        return self._read(text)[0]

    def _read(self, text: str) -> tuple[list[str], bool]:
        """The tokens that are encoded, and whether they are of a form of the captions, if anybody listed any."""
        config = self.config
        tokens = config.tokens(text)
        known = [token for token in tokens if config.knows(token)]
        formed = not config.forms or config.form(known) in config.forms
        if formed and (len(known) == len(tokens) or ELSEWHERE.isdisjoint(tokens)):
            return known, True
        said = match_form(tokens, config.forms, config.is_color, config.knows)
        return said or known, bool(said)

    def reads(self, text: str) -> str:
        return " ".join(self.words(text))

    def unknown_words(self, text: str) -> list[str]:
        return [one for one in dict.fromkeys(self.config.tokens(text)) if not self.config.knows(one)]

    def negations(self, text: str) -> list[str]:
        return [one for one in denials(text) if not self.config.knows(one)]

    def forms_but(self, text: str) -> tuple[str, ...]:
        return () if self._read(text)[1] else self.config.forms

    def color_name(self, rgb: Sequence[float]) -> str:
        return min(sorted((*TABLEAU_10, "white", "black")), key=lambda name: math.dist(palette()[name,], rgb))

    def nothing_said(self, text: str) -> str:
        known = [word for word in self.config.vocabulary if self.config.knows(word)]
        known += ["names of colours"] if self.config.words_have_rgb else []
        return f"a text needs at least one word that the model knows, got {text!r}; it knows {', '.join(known)}"

    def _row_and_color(self, word: str) -> tuple[int, RGB | None]:
        if word in self._vocabulary:
            return self._vocabulary[word], None
        return COLOR, palette()[tuple(word.split())]

    def _rows(self, text: str) -> list[tuple[int, RGB | None]]:
        return [self._row_and_color(word) for word in self.words(text)]

    def encode(self, words: WordBatch) -> TextTokens:
        mask_BL = words.ids_BL != PAD
        length = mask_BL.shape[1]
        self._check_length(length, "this batch")
        x_BLC = self.embedding(words.ids_BL)
        if self.color_projection is not None:
            x_BLC = x_BLC + self.color_projection(words.colors_BL3) * words.names_color_BL[..., None]
        words_BLC = x_BLC
        x_BLC = x_BLC + self.positions_LC[:length]
        bias_BL = torch.zeros_like(mask_BL, dtype=x_BLC.dtype).masked_fill(~mask_BL, -math.inf)
        for block in self.blocks:
            x_BLC = block(x_BLC, bias_BL[:, None, None])
        x_BLC = self.norm(x_BLC) * mask_BL[..., None]
        return TextTokens(x_BLC, mask_BL, words.colors_BL3, words.names_color_BL, words_BLC)
