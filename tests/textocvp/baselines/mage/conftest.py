"""A tiny MAGE with random weights."""

from __future__ import annotations

import pytest
import torch

from textocvp.baselines.mage import Mage, MageConfig
from textocvp.baselines.mage.axial import AxialConfig
from textocvp.baselines.mage.vqvae import VQVAEConfig
from textocvp.presets import TABLETOP_WORDS
from textocvp.text.words import WordsConfig

TEXTS = ["put the red block in the blue bowl", "put the green block in the yellow bowl"]
TINY = MageConfig(
    name="tiny",
    vqvae=VQVAEConfig(image_size=32, channels=8, blocks=1, codebook_size=12, code_dim=4),
    text=WordsConfig(dim=24, layers=1, heads=2, hidden=24, vocabulary=TABLETOP_WORDS),
    axial=AxialConfig(dim=24, layers=6, heads=2, hidden=24, frames=6),
)


@pytest.fixture
def model() -> Mage:
    torch.manual_seed(0)
    model = Mage(TINY).eval()
    with torch.no_grad():  # as they start, layers that add next to nothing would let any mistake pass
        for parameter in model.axial.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return model
