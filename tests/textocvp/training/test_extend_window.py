"""A longer window leaves what was learned as it is, and is trained from there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import WorldModel
from textocvp.config import ModelConfig, with_settings
from textocvp.training.predictor import PredictorTraining, extend, train

TEXT = "put the red block in the blue bowl"


def variant(config: ModelConfig, **changes: object) -> ModelConfig:
    return replace(config, predictor=replace(config.predictor, **changes))


@pytest.mark.parametrize("encoding", ["learned", "sinusoidal"])
@pytest.mark.parametrize("kind", ["textocvp", "ocvp-seq"])
def test_rollouts_within_the_old_window_stay_as_they_are(kind, encoding, scene: np.ndarray):
    model = build(with_settings(PLACED, [f"predictor.kind={kind}", f"predictor.age_encoding={encoding}"]))
    world_model = WorldModel(model)
    before = world_model.rollout(scene, TEXT, horizon=8)
    extend(model, ["predictor.window=20"])
    assert torch.equal(world_model.rollout(scene, TEXT, horizon=8).slots, before.slots)
    assert world_model.longest_horizon == 20
    further = world_model.rollout(scene, TEXT, horizon=20)
    torch.testing.assert_close(further.slots[:, :9], before.slots)
    if encoding == "learned":
        assert model.predictor.ages.shape[0] == 20
        assert (model.predictor.ages[8:] == model.predictor.ages[7]).all()


def test_codes_that_training_never_reached_are_not_copied():
    model = build(PUBLISHED)
    before = model.predictor.ages
    extend(model, ["predictor.window=7"])
    after = model.predictor.ages
    assert after.shape[0] == 8 and before.shape[0] == 5
    assert torch.equal(after[:4], before[:4])
    assert (after[4:] == before[3]).all()  # before[4] is the age that no window of 4 has


def test_other_changes_and_shorter_windows_are_refused():
    model = build(PLACED)
    with pytest.raises(ValueError, match=r"'predictor.layers=4'.*only predictor.window may grow"):
        extend(model, ["predictor.layers=4"])
    with pytest.raises(ValueError, match="grow, not shrink: it is 8 frames, 6 were asked for"):
        extend(model, ["predictor.window=6"])
    with pytest.raises(ValueError, match="type int"):
        extend(model, ["predictor.window=long"])
    published = build(PUBLISHED)
    with pytest.raises(ValueError, match=r"predictor\.direct needs predictor\.attention=causal"):
        extend(published, ["predictor.direct=true"])
    assert not published.predictor.config.direct


def test_what_imagined_from_frame_to_frame_can_imagine_from_the_first(scene: np.ndarray):
    model = build(PLACED)
    world_model = WorldModel(model)
    before = world_model.rollout(scene, TEXT, horizon=3).slots
    extend(model, ["predictor.direct=true"])
    after = world_model.rollout(scene, TEXT, horizon=3).slots
    assert torch.equal(after[:, 1], before[:, 1])
    assert (after[:, 2] - before[:, 2]).abs().max() > 1e-3
    assert model.config.predictor.direct


def test_fine_tuning_learns_longer_rollouts(tmp_path: Path, scene: np.ndarray):
    model = build(PLACED)
    model.predictor.content_std_C.fill_(3.0)
    model.save_pretrained(tmp_path / "old")
    write_toy_episodes(tmp_path / "train.h5", [9, 8, 12])
    args = PredictorTraining(
        parser=tmp_path / "old",
        data=tmp_path / "train.h5",
        val=tmp_path / "train.h5",
        out=tmp_path / "run",
        finetune=True,
        set=("predictor.window=12",),
        steps=3,
        batch=2,
        warmup=1,
        learning_rate=1e-4,
        autoregressive=1.0,
        horizon=12,
    )
    train(args)
    tuned = WorldModel.from_pretrained(tmp_path / "run" / "checkpoint")
    assert tuned.longest_horizon == 12 and tuned.rollout(scene, TEXT, horizon=12).slots.shape[1] == 13
    ages, old = tuned.model.predictor.ages, model.predictor.ages
    assert 0 < (ages[:8] - old).abs().max() < 1e-3 and (ages[8:] - old[-1]).abs().max() < 1e-3
    assert (ages[8:] - old[-1]).abs().amax(dim=1).min() > 0  # every new code is trained
    assert (tuned.model.predictor.content_std_C == 3.0).all()
    with pytest.raises(ValueError, match="leave out preset"):
        train(replace(args, out=tmp_path / "other", preset="tabletop-small"))
