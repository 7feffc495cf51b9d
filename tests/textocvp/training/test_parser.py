"""Stage 1: it learns, continues exactly, and reports what it can."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED
from tests.textocvp.toy_episodes import write_toy_episodes
from tests.textocvp.training.runs import parser_run, same_weights, train, train_killed_after
from textocvp.data.episodes import EpisodeFile
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.training.losses import thing_weights
from textocvp.training.parser import ParserStage, ParserTraining
from textocvp.training.run import SettingsError


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
    assert metrics.object_miou is None and metrics.psnr.value > 0 and metrics.below_threshold() == []
    printed = capsys.readouterr().out
    assert printed.count("the held-out episodes have no masks: only the redrawn frames are measured") == 3
    assert [path.name for path in sorted((args.out / "samples").iterdir())] == ["000001.png", "000002.png"]


def test_clips_longer_than_every_episode_are_refused(folder: Path) -> None:
    with pytest.raises(SettingsError, match=r"need episodes of 13 frames, the longest of .* has 9"):
        train(placed_run(folder, "out", clip=4, stride=4))
