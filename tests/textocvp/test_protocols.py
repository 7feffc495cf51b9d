"""How others get a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from tests.textocvp.conftest import PLACED, build
from textocvp import WorldModel
from textocvp.baselines.mage import MageVideoModel
from textocvp.protocols import load_model

TEXT = "put the red block in the blue bowl"


def test_every_architecture_is_loaded_by_its_name(tmp_path: Path, scene: np.ndarray) -> None:
    build(PLACED).save_pretrained(tmp_path)
    model = load_model(tmp_path)
    assert isinstance(model, WorldModel) and model.checkpoint.name == str(tmp_path)
    frames = model.imagine(scene, TEXT, horizon=2)
    assert torch.equal(frames, model.rollout(scene, TEXT, horizon=2).frames)
    assert isinstance(load_model("mage-small"), MageVideoModel)
