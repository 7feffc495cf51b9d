"""The predictor of whole sentences learns beside all else, and is not spoiled by what is trained after it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import WorldModel
from textocvp.data import open_episodes
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.training.evaluate_predictor import HeldOut, Outcomes, measure_outcomes
from textocvp.training.predictor import PredictorTraining, train
from textocvp.training.run import SettingsError

TEXT = "put the red block in the blue bowl"


@pytest.fixture
def args(tmp_path: Path) -> PredictorTraining:
    """Learns outcomes, for two updates."""
    build(PLACED).save_pretrained(tmp_path / "films")
    data = write_toy_episodes(tmp_path / "train.h5", [9, 8, 7])
    return PredictorTraining(
        parser=tmp_path / "films", data=data, val=data, out=tmp_path / "outcome", outcome=True, steps=2, batch=2,
        warmup=1, autoregressive=0.0, parse_every=3,
    )  # fmt: skip


def test_only_the_outcome_learns_and_the_text_encoder_knows_the_captions(args: PredictorTraining):
    train(args)
    before, after = (WorldModel.from_pretrained(folder).model for folder in (args.parser, args.out / "checkpoint"))
    assert before.outcome is None and after.outcome is not None
    kept = after.state_dict()
    assert all(torch.equal(kept[name], tensor) for name, tensor in before.state_dict().items())
    assert before.config.text.forms == () and after.config.text.forms == ("put the {} block in the {} bowl",)


def test_films_trained_later_leave_the_outcome_as_it_is(args: PredictorTraining, scene: np.ndarray):
    train(args)
    ready = args.out / "checkpoint"
    train(replace(args, parser=ready, out=args.out.parent / "tuned", outcome=False, parse_every=1, finetune=True))
    old, new = (WorldModel.from_pretrained(folder) for folder in (ready, args.out.parent / "tuned" / "checkpoint"))
    assert torch.equal(new.outcome(scene, TEXT).slots, old.outcome(scene, TEXT).slots)
    assert not torch.equal(new.rollout(scene, TEXT, horizon=8).slots, old.rollout(scene, TEXT, horizon=8).slots)


def test_held_out_episodes_are_judged_at_their_own_end(args: PredictorTraining, monkeypatch: pytest.MonkeyPatch):
    longer = write_toy_episodes(args.out.parent / "val.h5", [14, 5])
    seen = []

    def measure(model: TextOCVP, held: HeldOut, *count: int) -> Outcomes:
        seen.append(held)
        return measure_outcomes(model, held, *count)

    monkeypatch.setattr("textocvp.training.predictor.measure_outcomes", measure)
    train(replace(args, val=longer, parse_every=1))
    with open_episodes(longer) as episodes:
        model = TextOCVP.from_pretrained(args.parser)
        for index, held_2KD in enumerate(seen[-1].slots_ETKD):
            true_TKD = model.parser(to_frames(episodes.frames(index)[None])).slots_BTKD[0]
            torch.testing.assert_close(held_2KD, true_TKD[[0, -1]], atol=0.01, rtol=0.01)
            assert (true_TKD[0] - true_TKD[-1]).abs().max() > 0.1


def test_frames_are_skipped_for_outcomes_only(args: PredictorTraining):
    with pytest.raises(SettingsError, match="--parse-every goes with --outcome"):
        train(replace(args, outcome=False))
    with pytest.raises(SettingsError, match="--parse-every is 0: must be at least 1"):
        replace(args, parse_every=0)
