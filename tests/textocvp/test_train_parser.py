"""Stage 1: it learns, continues exactly, and its losses mean what they say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.data.episodes import EpisodeFile
from textocvp.metrics.intervals import Interval
from textocvp.model import TextOCVP
from textocvp.presets import PRESETS
from textocvp.renderers.base import Rendered
from textocvp.training import run as training
from textocvp.training.evaluate_parser import ParserMetrics, measure_parser
from textocvp.training.losses import image_loss, mask_loss, thing_weights
from textocvp.training.parser import ParserTraining, parser_loss, to_frames, train


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Arguments of a tiny stage 1 over toy episodes."""
    write_toy_episodes(tmp_path / "train.h5", [9, 8, 9, 9])
    write_toy_episodes(tmp_path / "val.h5", [9, 9], seed=1)
    for config in (PLACED, PUBLISHED):
        monkeypatch.setitem(PRESETS, config.name, config)

    def arguments(out: str, **changes) -> ParserTraining:
        settings = (
            dict(preset="tiny-placed", steps=4, batch=3, clip=2, warmup=1, evaluate_every=100) | changes
        )
        return ParserTraining(tmp_path / "train.h5", tmp_path / "val.h5", tmp_path / out, **settings)

    return arguments


@pytest.mark.parametrize("preset", ["tiny-placed", "tiny-published"])
def test_a_killed_run_continues_exactly(run, preset, monkeypatch):
    straight = run("straight", preset=preset)
    resumed = run("resumed", preset=preset, save_minutes=0.0)
    train(straight)

    save = training.save_state

    def killed_after_two(accelerator, out, next_step):
        save(accelerator, out, next_step)
        if next_step == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(training, "save_state", killed_after_two)
    with pytest.raises(KeyboardInterrupt):
        train(resumed)
    monkeypatch.setattr(training, "save_state", save)
    torch.rand(7)  # the world goes on
    train(resumed)

    one, other = (
        TextOCVP.from_pretrained(args.out / "checkpoint").state_dict() for args in (straight, resumed)
    )
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_training_lowers_the_loss_and_leaves_the_second_stage_alone(run):
    args = run("out", steps=60, learning_rate=2e-3)
    torch.manual_seed(args.seed)
    before = TextOCVP(PLACED)
    train(args)
    after = TextOCVP.from_pretrained(args.out / "checkpoint")
    with EpisodeFile(args.val) as episodes, torch.no_grad():
        frames = to_frames(np.stack([episodes.episode(0).frames[:4]]))
        weights = thing_weights(frames.flatten(0, 1), args.thing_weight)
        first, last = (parser_loss(model, frames, weights) for model in (before, after))
    assert last.image < 0.5 * first.image and last.mask < 0.9 * first.mask
    for part in ("text", "predictor"):
        old, new = getattr(before, part).state_dict(), getattr(after, part).state_dict()
        assert all(torch.equal(old[name], new[name]) for name in old)
    quality = json.loads((args.out / "quality.json").read_text())
    assert (
        0
        <= quality["object_miou"]["low"]
        <= quality["object_miou"]["value"]
        <= quality["object_miou"]["high"]
        <= 1
    )


def test_only_the_first_episodes_are_used_if_so_asked(run, monkeypatch):
    seen = []

    def spy(self, rng, count, length):
        seen.append(len(self))
        return original(self, rng, count, length)

    original = EpisodeFile.random_starts
    monkeypatch.setattr(EpisodeFile, "random_starts", spy)
    train(run("out", steps=1, episodes=2))
    assert seen == [2]


def test_quality_is_perfect_for_masks_that_are_the_segmentation(run):
    args = run("out")
    model = build(PLACED)
    with EpisodeFile(args.val) as episodes:
        truth = [torch.from_numpy(episodes.episode(k).segmentation) for k in range(2)]

        def oracle(index):
            masks = torch.nn.functional.one_hot(truth[index].long(), 6).permute(0, 3, 1, 2).float()
            return lambda slots: Rendered(torch.zeros(len(masks), 3, 32, 32), masks, lambda: masks)

        for index in range(2):
            model.renderer.forward = oracle(index)
            quality = measure_parser(model, episodes, [index], frame_step=1)
            assert quality.object_miou.value == 1 and quality.object_found.value == 1
            assert quality.followed.value == 1 and quality.foreground_ari.value == 1


def test_gates_name_what_is_not_good_enough():
    def quality(miou: float, found: float) -> ParserMetrics:
        figures = [Interval(value, value, value, 1) for value in (miou, found, 0.95, 0.5, 20.0)]
        return ParserMetrics(*figures)

    assert quality(0.80, 0.93).missed_gates() == []
    assert quality(0.79, 0.93).missed_gates() == ["object_miou is 0.790, below its gate of 0.80"]
    assert len(quality(0.5, 0.5).missed_gates()) == 2


def test_weights_single_out_what_is_not_the_canvas():
    target = torch.full((1, 3, 8, 8), -0.6)
    target[:, 0, 2:4, 2:4] = 0.8
    weights = thing_weights(target, 4.0)
    assert weights.unique().tolist() == [1, 5] and (weights == 5).sum() == 4
    drawn = Rendered(target + 0.1 * (weights == 5), torch.ones(1, 1, 8, 8), lambda: target)
    expected = 5 * 4 * 0.01 / (5 * 4 + 60)
    torch.testing.assert_close(image_loss(drawn, target, weights), torch.tensor(expected))


def test_mask_loss_is_the_log_share_of_the_winner():
    masks = torch.tensor([0.25, 0.75])[None, :, None, None].expand(1, 2, 4, 4).clone().requires_grad_()
    attention = torch.tensor([0.4, 0.6])[None, :, None, None].expand(1, 2, 4, 4).clone().requires_grad_()
    loss = mask_loss(Rendered(masks, masks, lambda: masks), attention, torch.ones(1, 1, 4, 4))
    torch.testing.assert_close(loss, -torch.tensor(0.75).log())
    loss.backward()
    assert masks.grad is not None and attention.grad is None
