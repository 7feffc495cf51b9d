"""Films of a scene and what is measured of them: doubles whose figures are known beforehand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from envs import Expert
from experiments.protocol.contenders import BASELINES, Contender, LoadVideo, absent_text, find_contenders
from experiments.protocol.film_gallery import FilmPicture, extremes
from experiments.protocol.films import Film, film, slots_of
from experiments.protocol.frame_scores import BOTTOM_ROWS, PSNR_CAP, UPPER, Measures, Scorer
from experiments.protocol.scenes import test_scenes
from experiments.protocol.workers import Worker
from tests.experiments.oracle import LoadOracle
from textocvp.checkpoint import CheckpointError
from textocvp.metrics.frames import psnr
from textocvp.metrics.perceptual import load_st_lpips
from textocvp.world_model import Checkpoint

MEASURES = Measures(("st_lpips",), None, (), ())


@dataclass(frozen=True)
class LoadStill:
    """Makes a model that sees no things and imagines that nothing happens, for at most `longest` frames."""

    longest: int | None = 12

    def __call__(self) -> Still:
        return Still(self.longest)


@dataclass
class Still:
    longest_horizon: int | None
    checkpoint = Checkpoint("still", "1" * 64)
    image_size = (64, 64)

    def imagine(
        self, obs: Mapping[str, Any] | np.ndarray, text: str | Sequence[str], *, horizon: int, seed: int = 0
    ) -> Tensor:
        assert self.longest_horizon is None or horizon <= self.longest_horizon
        frame = torch.from_numpy(np.array(obs)).permute(2, 0, 1).float() / 255
        return frame.expand(1, horizon + 1, -1, -1, -1)


STILL = Contender("MAGE", LoadStill(), False, "still", "1" * 64, 12)


@pytest.fixture(scope="module")
def worker() -> Worker:
    return Worker(LoadOracle()())


@pytest.fixture(scope="module")
def filmed(worker: Worker):
    (scene,) = test_scenes("test", 1, 0)
    return film(worker, scene, (STILL,), horizon=30, seed=0)


def test_everybody_imagines_the_scene_before_it_is_played(filmed) -> None:
    happened, films = filmed
    assert [one.method for one in films] == ["ours", "MAGE", "true frames", "wrong text", "copy frame"]
    assert [len(one.frames) for one in films] == [25, 13, 31, 25, 31]  # the double looks 24 frames ahead
    assert happened.frames.shape == (31, 64, 64, 3) and (happened.frames[25:] == happened.frames[24]).all()
    assert happened.text != happened.wrong_text
    ours, _, true, wrong, copy = (one.frames for one in films)
    assert torch.equal(copy, happened.film[:1].expand_as(copy))
    assert torch.equal(true[24], true[30])
    assert torch.equal(ours[0], wrong[0]) and not torch.equal(ours[24], wrong[24])


def test_the_arm_rests_when_an_episode_is_over() -> None:
    """Why the real film may stand still after its last frame: the simulator goes on and nothing happens."""
    (scene,) = test_scenes("test", 1, 0)
    env = gym.make("PutBlockInBowl-v0", control="ee", record_frames=True)
    env.reset(seed=scene.seed, options=dict(scene.options))
    action = np.zeros(5, np.float32)
    for action in Expert(env).actions():
        last = env.step(action)[-1]["frames"][-1].astype(int)
    for _ in range(16):
        now = env.step(np.zeros_like(action))[-1]["frames"][-1].astype(int)
        assert np.abs(now - last).mean() < 0.2
    env.close()


def test_scores_are_those_of_the_metrics(filmed) -> None:
    happened, films = filmed
    scorer = Scorer(happened.film, MEASURES, upper=True)
    ours = scorer.score(films[0])
    real = happened.film
    assert set(ours.curves) == {m + v for m in ("psnr", "ssim", "st_lpips") for v in ("", UPPER)}
    assert all(curve.shape == (24,) for curve in ours.curves.values())
    assert ours.curves["psnr"] == pytest.approx(psnr(films[0].frames[1:], real[1:25]).numpy())
    expected = load_st_lpips()(films[0].frames[5], real[5])
    assert ours.curves["st_lpips"][4] == pytest.approx(float(expected), rel=1e-4)
    upper = psnr(films[0].frames[1:, :, :-BOTTOM_ROWS], real[1:25, :, :-BOTTOM_ROWS])
    assert ours.curves["psnr" + UPPER] == pytest.approx(upper.numpy())
    assert ours.mean("psnr", 9) == pytest.approx(float(ours.curves["psnr"][:9].mean()))
    still = scorer.score(films[1])
    assert len(still.curves["ssim"]) == 12 and still.mean("ssim", 12) and still.mean("ssim", 13) is None


def test_equal_films_are_perfect_and_finite(filmed) -> None:
    happened, _ = filmed
    found = Scorer(happened.film, MEASURES, upper=False).score(Film("true", happened.film)).curves
    assert (found["psnr"] == PSNR_CAP).all() and (found["st_lpips"] == 0).all()
    assert found["ssim"] == pytest.approx(np.ones(30)) and set(found) == {"psnr", "ssim", "st_lpips"}


def test_ours_is_told_what_to_do_and_a_wrong_text_is_worse(filmed) -> None:
    """The double draws other pictures than the simulator, but moves the right things."""
    happened, films = filmed
    scorer = Scorer(happened.film, MEASURES, upper=False)
    scores = {one.method: scorer.score(one).mean("psnr", 24) for one in films if one.method != "MAGE"}
    assert scores["ours"] > scores["wrong text"] and scores["true frames"] > scores["wrong text"]


def test_a_model_without_slots_is_looked_at_by_our_parser(worker: Worker, filmed) -> None:
    _, films = filmed
    assert slots_of(worker, films[0], 0) is films[0].rollout
    assert slots_of(worker, Film("MAGE", films[1].frames[:1]), 0).slots.shape[:2] == (1, 1)


def test_a_clip_shows_everybody_above_their_masks(worker: Worker) -> None:
    (scene,) = test_scenes("test", 1, 0)
    clip = FilmPicture(scene, (), 0, "prediction", 2, False, "SSIM 0.5").run(worker)
    assert clip.panels == ("real", "ours") and clip.name == "prediction-worst-2.gif"
    assert clip.badge == "worst 2" and clip.caption == f"SSIM 0.5; seed {scene.seed}"
    assert clip.gif[:6] == b"GIF89a"


def test_no_case_is_among_the_best_and_the_worst() -> None:
    assert extremes("abcde", [3, 1, 5, 2, 4], 10) == (["b", "d", "a"], ["c", "e"])
    assert extremes("a", [3], 10) == (["a"], [])
    assert extremes("abcde", [3, 1, 5, 2, 4], 1) == (["b"], ["c"])


def test_a_baseline_that_is_not_trained_is_absent_with_the_command(tmp_path) -> None:
    loads = {"MAGE": LoadVideo("mage-nowhere"), "Non-OC": LoadStill(None)}
    with pytest.raises(CheckpointError, match="mage-nowhere"):  # somebody asked for that one
        find_contenders(loads)


def test_bundled_ones_may_be_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str) -> None:
        raise CheckpointError(f"unknown checkpoint {name!r}")

    monkeypatch.setattr("experiments.protocol.contenders.load_video_model", nothing)
    mage = next(baseline for baseline in BASELINES if baseline.method == "MAGE")
    present, absent = find_contenders({"MAGE": LoadVideo(mage.checkpoint), "Non-OC": LoadStill(None)})
    assert [(one.method, one.longest, one.slots) for one in present] == [("Non-OC", None, False)]
    assert absent_text(absent) == f"MAGE is absent: not trained: `{mage.train}`."
