"""From sentences to tokens: one file a family of text encoders, and the table that names them."""

from __future__ import annotations

from pathlib import Path

from textocvp.text.base import TextConfig, TextEncoder, TextTokens, WordBatch
from textocvp.text.pretrained import PretrainedEncoder
from textocvp.text.words import WordEncoder

__all__ = ["ENCODERS", "TextConfig", "TextEncoder", "TextTokens", "WordBatch", "build_text_encoder"]

ENCODERS: dict[str, type[TextEncoder]] = {
    "lexicon": WordEncoder,  # words, trained from scratch; colour words carry their RGB: the encoder that ships
    "transformer": WordEncoder,  # words, trained from scratch
    "t5": PretrainedEncoder,  # subwords, the paper's default
    "minilm": PretrainedEncoder,  # subwords, a sentence model
}


def build_text_encoder(config: TextConfig, files: Path | None = None) -> TextEncoder:
    """The text encoder that `config.kind` names.

    `files` is the folder that `save_files` was given, of a checkpoint that is being loaded. A fine-tuned encoder is
    built from it alone, for the checkpoint's tensors to fill.

    Raises:
        WeightsError: if pretrained weights are missing or not those of the configuration; it says where to get them.
    """
    return ENCODERS[config.kind](config, files)
