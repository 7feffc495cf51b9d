"""Models compute where their weights are. PyTorch's meta device stands in for a GPU: it, too, refuses CPU tensors."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED
from tests.textocvp.training.both_stages import MAGE
from textocvp.baselines.mage.model import Mage
from textocvp.baselines.mage.train_mage import MageStage as MageDynamics
from textocvp.config import ModelConfig
from textocvp.model import TextOCVP
from textocvp.presets import PRESETS
from textocvp.text.base import WordBatch
from textocvp.training.losses import moving_weights, slot_loss, thing_weights
from textocvp.training.parser import ParserStage
from textocvp.training.predictor import PredictorStage

TEXTS = ["put the red block in the blue bowl", "put the red block in the light blue bowl"]
SMALL = ["savi-small", "non-oc-small", "ocvp-seq-small"]
CONFIGS = [PLACED, PUBLISHED, *(PRESETS[name] for name in SMALL)]


def looked_up(model: TextOCVP | Mage) -> WordBatch:
    """Sentences are looked up on the CPU, as training does."""
    return model.text.lookup(TEXTS).to("meta")


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.name)
def test_both_stages_stay_on_the_device(config: ModelConfig) -> None:
    model = TextOCVP(config)
    words = looked_up(model)
    model = model.to("meta")
    side, layout = config.parser.image_size, config.parser.layout
    frames = torch.empty(2, 3, 3, side, side, device="meta")
    weights = thing_weights(frames, 4.0)
    generators = [torch.Generator().manual_seed(seed) for seed in range(2)]
    redrawing = ParserStage(model)
    loss = redrawing(frames, weights.flatten(0, 1), whole=weights.sum(), weight=0.5, generator=generators)
    loss.total().backward()
    assert {p.grad.device.type for p in redrawing.parameters() if p.grad is not None} == {"meta"}

    slots = torch.empty(2, 4, config.parser.num_slots, layout.dim, device="meta")
    dynamics = PredictorStage(model)
    if config.predictor.causal:
        predicted, _ = dynamics(slots[:, :3], words, 0)
    else:  # a rollout picks the slots that are used, which needs numbers
        predicted = model.predictor(slots[:, :3], model.text.encode(words))
    true = slots[:, 3 - predicted.shape[1] :]
    std = torch.ones(layout.content, device="meta")
    counted = moving_weights(true, layout, 20.0, ever=False)
    slot_loss(predicted, true[:, 1:], counted, layout, std).total(0.3).backward()
    assert {p.grad.device.type for p in dynamics.parameters() if p.grad is not None} == {"meta"}
    assert model.renderer(slots[:, 0]).masks_BKHW.device.type == "meta"


def test_mage_stays_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "autocast", lambda *args, **kwargs: nullcontext())  # there is none for meta
    model = Mage(MAGE)
    words = looked_up(model)
    model = model.to("meta")
    drawn, found = model.vqvae(torch.empty(4, 3, 32, 32, device="meta"))
    (drawn.mean() + found.commitment_loss).backward()
    codes = found.codes_Nhw.unflatten(0, (2, 2))
    scores = MageDynamics(model)(codes, words, torch.ones(2, device="meta"), 0)
    scores.mean().backward()
    assert scores.device.type == drawn.device.type == "meta"
