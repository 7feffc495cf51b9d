"""Tiny models with random weights: what the code must do whatever the weights are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from textocvp.config import ModelConfig
from textocvp.model import TextOCVP
from textocvp.parsers.holistic import HolisticConfig
from textocvp.parsers.placed import PlacedConfig
from textocvp.parsers.savi import SaviConfig
from textocvp.parsers.votes import VotesConfig
from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.presets import TABLETOP_COLORS, TABLETOP_WORDS
from textocvp.renderers.broadcast import BroadcastConfig
from textocvp.renderers.glimpse import GlimpseConfig
from textocvp.renderers.upsample import UpsampleConfig
from textocvp.slots import SlotLayout
from textocvp.text.words import WordsConfig
from textocvp.world_model import WorldModel

SMALL_TEXT = WordsConfig(dim=16, layers=1, heads=2, hidden=16, vocabulary=TABLETOP_WORDS)

PLACED = ModelConfig(
    name="tiny-placed",
    parser=PlacedConfig(image_size=32, num_slots=5, layout=SlotLayout(content=8), hidden=16, crop_cells=8),
    renderer=GlimpseConfig(hidden=16, crop_cells=8),
    text=SMALL_TEXT,
    predictor=TextOCVPConfig(
        dim=16, layers=2, heads=2, hidden=16, attention="causal", window=8, color_bias=True, feed_forwards=1
    ),
)

VOTES = replace(
    PLACED,
    name="tiny-votes",
    parser=VotesConfig(
        image_size=32, num_slots=6, layout=SlotLayout(content=8), hidden=16, crop_cells=8, channels=4, channels_full=4
    ),
)

PUBLISHED = ModelConfig(
    name="tiny-published",
    parser=SaviConfig(
        image_size=32,
        num_slots=4,
        layout=SlotLayout(content=12, explicit=False),
        initializer="gaussian",
        iterations_first=2,
        encoder_channels=8,
        encoder_stride=2,
        transition_hidden=16,
    ),
    renderer=BroadcastConfig(channels=8),
    text=replace(SMALL_TEXT, kind="transformer", vocabulary=TABLETOP_WORDS + TABLETOP_COLORS),
    predictor=TextOCVPConfig(dim=16, layers=2, heads=2, hidden=16, attention="window", window=4),
)

NON_OC = ModelConfig(
    name="tiny-non-oc",
    parser=HolisticConfig(
        image_size=32, layout=SlotLayout(content=24, explicit=False), encoder_channels=8, pool_cells=2
    ),
    renderer=UpsampleConfig(channels=8),
    text=SMALL_TEXT,
    predictor=TextOCVPConfig(dim=16, layers=2, heads=2, hidden=16, attention="causal", window=8, standardize=True),
)


def build(config: ModelConfig) -> TextOCVP:
    """The model with random weights that are the same in every test."""
    torch.manual_seed(0)
    return TextOCVP(config).eval()


@pytest.fixture(params=[PLACED, PUBLISHED], ids=lambda config: config.name)
def config(request: pytest.FixtureRequest) -> ModelConfig:
    """Each of the two families in turn."""
    return request.param


@pytest.fixture
def model(config: ModelConfig) -> TextOCVP:
    return build(config)


@pytest.fixture
def world_model(model: TextOCVP) -> WorldModel:
    return WorldModel(model)


@pytest.fixture
def placed_world_model() -> WorldModel:
    return WorldModel(build(PLACED))


@pytest.fixture
def scene() -> np.ndarray:
    """(32, 32, 3) uint8: a red and a blue square on a dark table."""
    image = np.full((32, 32, 3), 47, np.uint8)
    image[4:10, 5:11] = (255, 87, 89)
    image[18:28, 16:26] = (78, 121, 167)
    return image
