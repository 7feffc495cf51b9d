"""A trained predictor made ready for more frames than it was trained for: what fine-tuning starts from then."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import nn

from textocvp.config import with_settings
from textocvp.model import TextOCVP
from textocvp.predictor_base import SlotPredictor
from textocvp.text import sinusoids


def with_longer_window(predictor: SlotPredictor, window: int) -> SlotPredictor:
    """A copy that takes up to `window` frames. Within the old window it predicts what the original does.

    The learned time codes of the new frames start as copies of the last one that training reached, so that the first
    guess for frame 25 is what was learned about frame 24.

    Raises:
        ValueError: if the window would become shorter.
    """
    config = predictor.config
    if window < config.window:
        raise ValueError(
            f"the window can grow, not shrink: it is {config.window} frames, {window} were asked for"
        )
    grown = copy.deepcopy(predictor)
    grown.config = replace(config, window=window)
    rows = window + (config.attention == "window")
    if config.age_encoding == "learned":
        # The published form has one code more than its window has frames: no training ever reached that one.
        reached = predictor.ages.detach()[: config.window]
        grown.ages = nn.Parameter(torch.cat([reached, reached[-1:].expand(rows - config.window, -1)]))
    else:
        grown.register_buffer("ages", sinusoids(rows, config.dim).to(predictor.ages.device), persistent=False)
    return grown


def grow_window(model: TextOCVP, settings: Iterable[str]) -> None:
    """Change the trained model as `settings` say, which may be `predictor.window=FRAMES` only.

    Raises:
        ValueError: if a setting is another one, makes no sense, or would shorten the window.
    """
    settings = tuple(settings)
    for setting in settings:
        if not setting.startswith("predictor.window="):
            raise ValueError(
                f"{setting!r}: fine-tuning keeps the checkpoint's architecture; only predictor.window may grow"
            )
    config = with_settings(model.config, settings)
    model.predictor = with_longer_window(model.predictor, config.predictor.window)
    model.config = config
