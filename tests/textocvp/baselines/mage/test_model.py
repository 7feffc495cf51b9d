"""MAGE as a whole: sizes, words, checkpoints, and the model that is bundled."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.baselines.mage.conftest import TEXTS
from textocvp.baselines.mage import Mage, mage_preset
from textocvp.baselines.mage.text import PublishedTextConfig
from textocvp.checkpoint import CheckpointError
from textocvp.protocols import load_model
from textocvp.world_model import WorldModel


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


def test_second_stage_of_mage_dino_has_the_papers_parameters() -> None:
    with torch.device("meta"):
        model = Mage(mage_preset("mage-dino"))
    assert count(model.text) + count(model.axial) == 32_113_664


def test_a_checkpoint_comes_back_and_a_damaged_one_is_refused(model: Mage, tmp_path: Path) -> None:
    model.save(tmp_path)
    again = Mage.load(tmp_path)
    first = torch.rand(2, 3, 32, 32) * 2 - 1
    assert torch.equal(again.imagine(first, TEXTS, 3), model.imagine(first, TEXTS, 3))

    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "axial": {**config["axial"], "depth": 3}}))
    with pytest.raises(CheckpointError, match="depth"):
        Mage.load(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({**config, "axial": {**config["axial"], "hidden": 32}}))
    with pytest.raises(CheckpointError, match="feed_forward"):
        Mage.load(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(config))
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="damaged"):
        Mage.load(tmp_path)


def test_the_bundled_one_is_its_preset_and_imagines_through_the_common_door() -> None:
    model = load_model("mage-small")
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    frames = model.imagine(picture, TEXTS[0], horizon=2)
    assert frames.shape == (1, 3, 3, 64, 64) and frames.min() >= 0 and frames.max() <= 1
    config, preset = model.model.config, mage_preset("mage-small")  # type: ignore[attr-defined]
    assert replace(config, text=replace(config.text, untrained=(), forms=())) == preset
    assert config.text.untrained == config.text.vocabulary[5:]  # all but "put the block in bowl"
    with pytest.raises(ValueError, match="horizon"):
        model.imagine(picture, TEXTS[0], horizon=25)
    with pytest.raises(CheckpointError, match="load_model"):
        WorldModel.from_pretrained("mage-small")


def test_the_published_encoder_needs_a_row_for_each_word() -> None:
    PublishedTextConfig(vocabulary=("put", "it"), rows=4)
    with pytest.raises(ValueError, match=r"text\.rows must be at least 4"):
        PublishedTextConfig(vocabulary=("put", "it"), rows=3)
