"""From the slots of some frames and a text to the slots of the next: one file a predictor, and the table."""

from __future__ import annotations

from textocvp.config import PredictorConfig
from textocvp.predictors.base import Imagined, SlotPredictor
from textocvp.predictors.ocvp_seq import OcvpSeq
from textocvp.predictors.textocvp import Predictor
from textocvp.slots import SlotLayout

__all__ = ["Imagined", "Predictor", "SlotPredictor", "build_predictor"]


def build_predictor(config: PredictorConfig, layout: SlotLayout, text_dim: int) -> SlotPredictor:
    """The predictor that `config.kind` names.

    Args:
        config: its kind and sizes.
        layout: what the numbers of one slot mean.
        text_dim: width of the text tokens.

    Raises:
        ValueError: if there is no such kind, or it does not fit the layout.
    """
    if config.kind == "textocvp":
        return Predictor(config, layout, text_dim)
    if config.kind == "ocvp-seq":
        return OcvpSeq(config, layout)
    raise ValueError(f"unknown predictor.kind {config.kind!r}; known: textocvp, ocvp-seq")
