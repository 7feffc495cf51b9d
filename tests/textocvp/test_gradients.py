"""Stage 2's gradients: from drawn frames through the frozen renderer into what is trained, and into nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.textocvp.conftest import NON_OC, PLACED, PUBLISHED, build
from textocvp.config import ModelConfig, with_settings
from textocvp.training.predictor import PredictorStage, PredictorTraining, assemble


@pytest.mark.parametrize(
    "config",
    [
        PLACED,
        PUBLISHED,
        NON_OC,
        with_settings(PLACED, ["predictor.kind=ocvp-seq"]),
        with_settings(PUBLISHED, ["predictor.kind=ocvp-seq"]),
    ],
    ids=lambda config: f"{config.name}-{config.predictor.kind}",
)
def test_drawn_frames_teach_the_predictor_alone(config: ModelConfig) -> None:
    nowhere = Path()
    texts = ["put the red block in the blue bowl", "put the green block in the gray bowl"]
    model = assemble(PredictorTraining(nowhere, nowhere, nowhere, parser=nowhere), build(config), texts)
    frames_B1 = torch.rand(2, 1, 3, 32, 32) * 2 - 1
    frames_B1[:, :, :, 8:16, 8:16] = torch.tensor([0.9, -0.9, -0.9])[:, None, None]
    slots_B1KD = model.parser(frames_B1).slots_BTKD
    words = model.text.lookup(texts)
    predicted_BSKD, _ = PredictorStage(model)(slots_B1KD, words, 2)
    drawn = model.renderer(predicted_BSKD[:, -1]).frames_B3HW
    (drawn - frames_B1[:, 0].flip(-1)).square().mean().backward()

    def touched(part: torch.nn.Module) -> list[str]:
        return [name for name, p in part.named_parameters() if p.grad is not None and p.grad.any()]

    assert touched(model.parser) == touched(model.renderer) == []
    parts = {name.split(".")[0] for name in touched(model.predictor)}
    assert parts == {"slot_in", "layers", "slot_out", "ages"}
    assert bool(touched(model.text)) == model.predictor.uses_text
