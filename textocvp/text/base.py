"""From sentences to tokens: what every text encoder is."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class TextConfig:
    """What every text encoder is built from; a subclass adds its own options and refuses values that make no sense."""

    kind: str  # a name in `textocvp.text.ENCODERS`
    dim: int = 128  # width of the token embeddings handed to the predictor
    max_tokens: int = 64  # of a sentence; more are an error

    @property
    def words_have_rgb(self) -> bool:
        """Whether colour words carry their RGB, so that they fit recoloured scenes and can be matched with slots."""
        return False

    def for_captions(self, captions: Iterable[str], vocabulary: Iterable[str] = ()) -> TextConfig:
        """That of a new encoder, trained on these captions; the task's sentences may contain the `vocabulary` too."""
        return self


@dataclass
class TextTokens:
    """A batch of encoded sentences."""

    embeddings_BLC: Tensor  # contextual; zero where there is no token
    mask_BL: Tensor  # True where there is a token: a word, or for the pretrained encoders a subword or end mark
    colors_BL3: Tensor  # RGB in -1..1 of the colour that a word names (`lexicon` only; zeros elsewhere)
    names_color_BL: Tensor  # True where `colors_BL3` means something
    words_BLC: Tensor | None = None  # each word without the others, from encoders that have such embeddings

    def __len__(self) -> int:
        return self.mask_BL.shape[0]


@dataclass
class WordBatch:
    """Sentences before encoding, still free of learned parameters. Colours as in `TextTokens`."""

    ids_BL: Tensor  # row in the encoder's vocabulary, `pad` of the encoder where there is no word
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


class TextEncoder(nn.Module):
    """Sentences to `TextTokens`. Subclasses set `Config` and write `device`, `words`, `_rows` and `encode`.

    Padding is masked everywhere (the authors' code does not mask it in the cross-attention), so what a sentence means
    does not depend on its neighbours in the batch.
    """

    Config: ClassVar[type[TextConfig]]
    config: TextConfig  # of a frozen pretrained encoder also with the fingerprint of its weights
    pad: int = 0  # the row in the vocabulary that stands for no token
    unit: str = "word"  # what one token is called

    def __init__(self, config: TextConfig, files: Path | None = None) -> None:
        super().__init__()
        self.config = config

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where its learned parameters are."""
        raise NotImplementedError

    @abstractmethod
    def words(self, text: str) -> list[str]:
        """What each token of a sentence stands for, in order."""
        raise NotImplementedError

    def unknown_words(self, text: str) -> list[str]:
        """The words that this encoder never learned, in order, each once: for a warning that names them."""
        return []  # subwords can spell any word

    def reads(self, text: str) -> str:
        """The sentence that is encoded in the place of this one; for an encoder without rules the same."""
        return text

    def negations(self, text: str) -> list[str]:
        """Words that deny something and that no training caption contained: their opposite would be imagined."""
        return []

    def forms_but(self, text: str) -> tuple[str, ...]:
        """What the training captions looked like, where this sentence, as it is read, looks like none of them."""
        return ()

    def color_name(self, rgb: Sequence[float]) -> str:
        """The nearest name of a colour, RGB 0..1, among common ones."""
        raise NotImplementedError(f"{type(self).__name__} knows no colours")

    def nothing_said(self, text: str) -> str:
        """What to tell someone whose sentence has no token."""
        return f"a text needs at least one word, got {text!r}"

    @abstractmethod
    def _rows(self, text: str) -> list[tuple[int, RGB | None]]:
        """Of each token its row in the vocabulary, and the RGB (0..1) that it names; nothing for an empty text."""
        raise NotImplementedError

    def lookup(self, texts: Sequence[str]) -> WordBatch:
        """Vocabulary rows and lexicon colours of the sentences, padded to the longest.

        Raises:
            ValueError: if a sentence has no word or more than `max_tokens` tokens.
        """
        if isinstance(texts, str):
            raise TypeError("texts must be a sequence of sentences, not one string")
        sentences = [self._rows(text) for text in texts]
        for text, sentence in zip(texts, sentences, strict=True):
            if not sentence:
                raise ValueError(self.nothing_said(text))
            self._check_length(len(sentence), "this")
        shape = (len(sentences), max(map(len, sentences), default=1))
        ids_BL, colors_BL3 = torch.full(shape, self.pad), torch.zeros(*shape, 3)
        names_color_BL = torch.zeros(shape, dtype=torch.bool)
        for b, sentence in enumerate(sentences):
            for position, (row, color) in enumerate(sentence):
                ids_BL[b, position] = row
                if color is not None:
                    colors_BL3[b, position] = torch.tensor(color) * 2 - 1
                    names_color_BL[b, position] = True
        return WordBatch(ids_BL, colors_BL3, names_color_BL).to(self.device)

    def _check_length(self, tokens: int, what: str) -> None:
        if tokens > self.config.max_tokens:
            most = f"{self.config.max_tokens} {self.unit}s"
            raise ValueError(f"a text may have at most {most}, {what} has {tokens}")

    @abstractmethod
    def encode(self, words: WordBatch) -> TextTokens:
        """Embed looked-up words; a ValueError if they are more than `max_tokens`."""
        raise NotImplementedError

    def forward(self, texts: Sequence[str]) -> TextTokens:
        """Encode sentences; errors as `lookup`."""
        return self.encode(self.lookup(texts))

    def save_files(self, folder: Path) -> None:
        """Write what a checkpoint needs besides tensors into `folder`, which it makes if there is anything."""
