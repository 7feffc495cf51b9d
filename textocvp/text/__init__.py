"""From sentences to tokens: one file a family of text encoders, and the table that names them.

Four kinds (`TextConfig.kind`). `transformer` and `lexicon` read words and are trained from scratch
(`textocvp.text.words`); `t5` and `minilm` read subwords and come pretrained (`textocvp.text.pretrained`).
"""

from __future__ import annotations

from pathlib import Path

from textocvp.config import TextConfig
from textocvp.text.base import TextEncoder, TextTokens, WordBatch
from textocvp.text.pretrained import PretrainedEncoder
from textocvp.text.words import WordEncoder

__all__ = ["TextEncoder", "TextTokens", "WordBatch", "build_text_encoder"]


def build_text_encoder(config: TextConfig, files: Path | None = None) -> TextEncoder:
    """The text encoder that `config.kind` names.

    Args:
        files: the folder that `save_files` was given, of a checkpoint that is being loaded. A fine-tuned encoder is
            then built from it alone, for the checkpoint's tensors to fill.

    Raises:
        ValueError: if there is no such kind, or its pretrained weights are missing or others than the configuration
            says; the message says where to get them.
    """
    if config.kind in ("transformer", "lexicon"):
        return WordEncoder(config)
    if config.kind in ("t5", "minilm"):
        return PretrainedEncoder(config, files)
    raise ValueError(f"unknown text.kind {config.kind!r}; known: transformer, lexicon, t5, minilm")
