"""Predictors: from the slots of some frames and a text to the slots of the next frames. One file each."""

from textocvp.predictors.base import Imagined, PredictorConfig, SlotPredictor
from textocvp.predictors.ocvp_seq import OCVPSeqPredictor
from textocvp.predictors.textocvp import TextOCVPPredictor
from textocvp.slots import SlotLayout

PREDICTORS: dict[str, type[SlotPredictor]] = {"textocvp": TextOCVPPredictor, "ocvp-seq": OCVPSeqPredictor}


def build_predictor(config: PredictorConfig, layout: SlotLayout, text_dim: int) -> SlotPredictor:
    """The predictor that `config.kind` names, for text tokens of width `text_dim`.

    Raises:
        ValueError: if there is no such kind, or the options do not fit each other.
    """
    if config.kind not in PREDICTORS:
        raise ValueError(f"unknown predictor.kind {config.kind!r}; known: {', '.join(PREDICTORS)}")
    return PREDICTORS[config.kind](config, layout, text_dim)
