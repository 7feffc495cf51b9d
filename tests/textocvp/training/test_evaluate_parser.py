"""What a parser is measured by."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest
import torch

from tests.textocvp.conftest import PLACED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.data.episodes import EpisodeFile
from textocvp.metrics.intervals import Interval
from textocvp.renderers.base import Rendered
from textocvp.training.evaluate_parser import ParserMetrics, measure_own_frames, measure_parser


@pytest.fixture
def val(tmp_path: Path) -> Path:
    return write_toy_episodes(tmp_path / "val.h5", [9, 9], seed=1)


def test_metrics_are_perfect_for_masks_that_are_the_segmentation(val: Path) -> None:
    model = build(PLACED)
    with EpisodeFile(val) as episodes:
        for index in range(2):
            truth = torch.from_numpy(episodes.truth(index).segmentation)
            masks = torch.nn.functional.one_hot(truth.long(), 6).permute(0, 3, 1, 2).float()
            rendered = Rendered(torch.zeros(len(masks), 3, 32, 32), masks, lambda masks=masks: masks)
            model.renderer.forward = lambda slots, rendered=rendered: rendered
            metrics = measure_parser(model, episodes, [index], frame_step=1)
            assert metrics.object_miou.value == 1 and metrics.object_found.value == 1
            assert metrics.followed.value == 1 and metrics.foreground_ari.value == 1


def test_masks_of_nothing_are_left_out(val: Path) -> None:
    with h5py.File(val, "a") as file:
        file["segmentation"][:9] = 0
    with EpisodeFile(val) as episodes:
        assert measure_parser(build(PLACED), episodes, range(2)).object_miou.n == 1
        alone = measure_parser(build(PLACED), episodes, [0])
    assert alone.object_miou is None and "no masks" in alone.left_out
    assert set(alone.as_metrics()) == {"quality/psnr"}


def test_own_frames_are_the_first_ones(val: Path) -> None:
    with EpisodeFile(val) as episodes:
        before = measure_own_frames(build(PLACED), episodes)
    with h5py.File(val, "a") as file:
        file["frames"][1:9] = 0  # later ones do not count
    with EpisodeFile(val) as episodes:
        assert measure_own_frames(build(PLACED), episodes) == before
    assert before.count == 2 and before.hue and not before.gray


def test_gray_videos_have_no_hue(val: Path) -> None:
    with h5py.File(val, "a") as file:
        file["frames"][:] = file["frames"][:].mean(-1, keepdims=True).astype("uint8")
    with EpisodeFile(val) as episodes:
        own = measure_own_frames(build(PLACED), episodes)
    assert own.hue == "" and own.gray


def test_thresholds_name_what_is_not_good_enough() -> None:
    def metrics(miou: float, found: float) -> ParserMetrics:
        values = [Interval(value, value, value, 1) for value in (miou, found, 0.95, 0.5, 20.0)]
        return ParserMetrics(*values)

    assert metrics(0.80, 0.93).below_threshold() == []
    assert metrics(0.79, 0.93).below_threshold() == ["object_miou is 0.790, below its threshold of 0.80"]
    assert len(metrics(0.5, 0.5).below_threshold()) == 2
