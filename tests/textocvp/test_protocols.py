"""How others get a model."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import torch

from tests.textocvp.conftest import PLACED, build
from textocvp import WorldModel
from textocvp.baselines.mage import MageVideoModel
from textocvp.protocols import LoadCheckpoint, LoadModel, LoadWorldModel, SlotModel, load_model

TEXT = "put the red block in the blue bowl"


def test_every_architecture_is_loaded_by_its_name(tmp_path: Path, scene: np.ndarray) -> None:
    build(PLACED).save_pretrained(tmp_path)
    model = load_model(tmp_path)
    assert isinstance(model, WorldModel) and model.checkpoint.name == str(tmp_path)
    frames = model.imagine(scene, TEXT, horizon=2)
    assert torch.equal(frames, model.rollout(scene, TEXT, horizon=2).frames)
    assert isinstance(LoadCheckpoint("mage-small")(), MageVideoModel)


def test_loaders_of_the_same_model_are_equal_in_every_process(tmp_path: Path) -> None:
    build(PLACED).save_pretrained(tmp_path)
    load: LoadModel[SlotModel] = LoadWorldModel(str(tmp_path))
    sent = pickle.loads(pickle.dumps(load))
    assert sent == load and hash(sent) == hash(load) and load != LoadWorldModel("tabletop-small")
    assert sent().checkpoint == load().checkpoint
