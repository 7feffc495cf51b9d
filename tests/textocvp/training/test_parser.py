"""Stage 1: it learns, continues exactly, and reports what it can."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED
from tests.textocvp.toy_episodes import COLORS, write_toy_episodes
from tests.textocvp.training.runs import parser_run, predictor_run, same_weights, train, train_killed_after
from textocvp.data.episodes import EpisodeFile
from textocvp.metrics import psnr
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.training.evaluate_parser import measure_own_frames
from textocvp.training.losses import thing_weights
from textocvp.training.parser import ParserStage, ParserTraining
from textocvp.training.run import SettingsError
from textocvp.world_model import WorldModel


def placed_run(folder: Path, out: str, **changes) -> ParserTraining:
    return parser_run(folder, out, **(dict(preset=PLACED.name, steps=4, batch=3) | changes))


@pytest.mark.parametrize("preset", [PLACED.name, PUBLISHED.name])
def test_a_killed_run_continues_exactly(folder: Path, preset: str) -> None:
    straight, resumed = (placed_run(folder, name, preset=preset) for name in ("straight", "resumed"))
    train(straight)
    train_killed_after(resumed, 2)
    torch.rand(7)  # the world goes on
    train(resumed)
    assert same_weights(straight.out, resumed.out)


def test_training_lowers_the_loss_and_leaves_the_second_stage_alone(folder: Path) -> None:
    args = placed_run(folder, "out", steps=60, learning_rate=2e-3)
    torch.manual_seed(args.seed)
    before = TextOCVP(PLACED)
    train(args)
    after = TextOCVP.from_pretrained(args.out / "checkpoint")
    with EpisodeFile(args.val) as episodes, torch.no_grad():
        frames = to_frames(episodes.frames(0)[None, :4])
        weights = thing_weights(frames.flatten(0, 1), args.thing_weight)
        first, last = (ParserStage(model)(frames, weights) for model in (before, after))
    assert last.image < 0.5 * first.image and last.mask < 0.9 * first.mask
    for part in ("text", "predictor"):
        old, new = getattr(before, part).state_dict(), getattr(after, part).state_dict()
        assert all(torch.equal(old[name], new[name]) for name in old)
    miou = json.loads((args.out / "quality.json").read_text())["object_miou"]
    assert 0 <= miou["low"] <= miou["value"] <= miou["high"] <= 1


def test_only_the_first_episodes_are_used_if_so_asked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def spy(self, rng, count, length):
        seen.append(len(self))
        return original(self, rng, count, length)

    original = EpisodeFile.random_starts
    monkeypatch.setattr(EpisodeFile, "random_starts", spy)
    train(placed_run(folder, "out", steps=1, episodes=2))
    assert seen == [2]


def test_frames_and_captions_are_enough(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And so are fewer held-out episodes than the sample pictures have room for."""
    for name, lengths in (("train", [9, 8, 9]), ("val", [9])):
        write_toy_episodes(folder / f"{name}.h5", lengths, truth=False)
    args = placed_run(folder, "out", steps=2, evaluate_every=1)
    metrics = train(args)
    assert metrics.object_miou is None and 0 < metrics.psnr.value < 18
    assert metrics.below_threshold() == [f"psnr is {metrics.psnr.value:.3f}, below its threshold of 18.00"]
    printed = capsys.readouterr().out
    assert printed.count("the held-out episodes have no masks: only the redrawn frames are measured") == 3
    assert [path.name for path in sorted((args.out / "samples").iterdir())] == ["000001.png", "000002.png"]


def test_a_checkpoint_knows_how_it_redraws_its_own_frames_and_keeps_that(folder: Path) -> None:
    """From stage 1 through stage 2, fine-tuning, saving and loading."""
    args = placed_run(folder, "out", steps=1)
    train(args)
    first = args.out / "checkpoint"
    own = TextOCVP.from_pretrained(first).config.own_frames
    with EpisodeFile(args.val) as episodes:
        frames = np.stack([episodes.frames(index)[0] for index in range(len(episodes))])
        assert own == measure_own_frames(TextOCVP.from_pretrained(first), episodes)
    redrawn = WorldModel.from_pretrained(first).parse(frames[:, None]).frames[:, 0]
    real = torch.from_numpy(frames).permute(0, 3, 1, 2) / 255
    assert own.count == 2 and own.psnr == pytest.approx(psnr(redrawn, real).mean().item(), abs=0.01)
    hue, yellow = (np.array(list(bytes.fromhex(own.hue))), np.array(COLORS["yellow"]))  # the largest that all show
    assert own.psnr_low <= own.psnr and abs(hue - 255 * yellow / yellow.max()).max() < 4
    second, third = (predictor_run(folder, "second", parser=first), predictor_run(folder, "third", finetune=True))
    train(second)
    train(replace(third, parser=second.out / "checkpoint"))
    for out in (second.out, third.out):
        assert TextOCVP.from_pretrained(out / "checkpoint").config.own_frames == own
    TextOCVP.from_pretrained(third.out / "checkpoint").save_pretrained(folder / "again")  # as for the hub
    assert TextOCVP.from_pretrained(folder / "again").config.own_frames == own


def test_clips_longer_than_every_episode_are_refused(folder: Path) -> None:
    with pytest.raises(SettingsError, match=r"need episodes of 13 frames, the longest of .* has 9"):
        train(placed_run(folder, "out", clip=4, stride=4))
