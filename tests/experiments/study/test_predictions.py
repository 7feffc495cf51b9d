"""What is imagined of a scene and what is measured of it: doubles whose figures are known beforehand."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

from envs import Expert
from experiments.study.clips import PredictionClip, extreme_clips
from experiments.study.frame_metrics import BOTTOM_ROWS, PSNR_CAP, UPPER, Measures, Scorer
from experiments.study.methods import METHODS, Model, find_models
from experiments.study.pool import Worker
from experiments.study.predictions import Prediction, predict, slots_of
from experiments.study.scenes import study_scenes
from tests.experiments.oracle import LoadOracle
from tests.experiments.still import LoadStill
from textocvp.checkpoint import CheckpointError
from textocvp.metrics.frames import psnr
from textocvp.metrics.perceptual import load_st_lpips
from textocvp.protocols import LoadCheckpoint

MEASURES = Measures(("st_lpips",))


STILL = Model("MAGE", LoadStill(), False, "still", "1" * 64, 12)


@pytest.fixture(scope="module")
def worker() -> Worker:
    return Worker(LoadOracle()())


@pytest.fixture(scope="module")
def predicted(worker: Worker):
    (scene,) = study_scenes("test", 1, 0)
    return predict(worker, scene, (STILL,), horizon=30, seed=0)


def test_everybody_imagines_the_scene_before_it_is_played(predicted) -> None:
    truth, predictions = predicted
    assert [one.method for one in predictions] == ["ours", "MAGE", "true frames", "wrong text", "copy frame"]
    assert [len(one.frames_T3HW) for one in predictions] == [25, 13, 31, 25, 31]  # the double looks 24 frames ahead
    assert truth.frames_THW3.shape == (31, 64, 64, 3) and (truth.frames_THW3[25:] == truth.frames_THW3[24]).all()
    assert truth.text != truth.wrong_text
    ours, _, true, wrong, copy = (one.frames_T3HW for one in predictions)
    assert torch.equal(copy, truth.frames_T3HW[:1].expand_as(copy))
    assert torch.equal(true[24], true[30])
    assert torch.equal(ours[0], wrong[0]) and not torch.equal(ours[24], wrong[24])


def test_the_arm_rests_when_an_episode_is_over() -> None:
    """Why the real film may stand still after its last frame: the simulator goes on and nothing happens."""
    (scene,) = study_scenes("test", 1, 0)
    env = gym.make("PutBlockInBowl-v0", control="ee", record_frames=True)
    env.reset(seed=scene.seed, options=dict(scene.options))
    action = np.zeros(5, np.float32)
    for action in Expert(env).actions():
        last = env.step(action)[-1]["frames"][-1].astype(int)
    for _ in range(16):
        now = env.step(np.zeros_like(action))[-1]["frames"][-1].astype(int)
        assert np.abs(now - last).mean() < 0.2
    env.close()


def test_scores_are_those_of_the_metrics(predicted) -> None:
    truth, predictions = predicted
    scorer = Scorer(truth.frames_T3HW, MEASURES, upper=True)
    ours = scorer.score(predictions[0])
    real = truth.frames_T3HW
    assert set(ours.curves) == {m + v for m in ("psnr", "ssim", "st_lpips") for v in ("", UPPER)}
    assert all(curve.shape == (24,) for curve in ours.curves.values())
    assert ours.curves["psnr"] == pytest.approx(psnr(predictions[0].frames_T3HW[1:], real[1:25]).numpy())
    expected = load_st_lpips()(predictions[0].frames_T3HW[5], real[5])
    assert ours.curves["st_lpips"][4] == pytest.approx(float(expected), rel=1e-4)
    upper = psnr(predictions[0].frames_T3HW[1:, :, :-BOTTOM_ROWS], real[1:25, :, :-BOTTOM_ROWS])
    assert ours.curves["psnr" + UPPER] == pytest.approx(upper.numpy())
    still = scorer.score(predictions[1])
    assert len(still.curves["ssim"]) == 12


def test_equal_films_are_perfect_and_finite(predicted) -> None:
    truth, _ = predicted
    found = Scorer(truth.frames_T3HW, MEASURES, upper=False).score(Prediction("true", truth.frames_T3HW)).curves
    assert (found["psnr"] == PSNR_CAP).all() and (found["st_lpips"] == 0).all()
    assert found["ssim"] == pytest.approx(np.ones(30)) and set(found) == {"psnr", "ssim", "st_lpips"}


def test_ours_is_told_what_to_do_and_a_wrong_text_is_worse(predicted) -> None:
    """The double draws other pictures than the simulator, but moves the right things."""
    truth, predictions = predicted
    scorer = Scorer(truth.frames_T3HW, MEASURES, upper=False)
    scores = {one.method: scorer.score(one).curves["psnr"].mean() for one in predictions if one.method != "MAGE"}
    assert scores["ours"] > scores["wrong text"] and scores["true frames"] > scores["wrong text"]


def test_a_model_without_slots_is_looked_at_by_our_parser(worker: Worker, predicted) -> None:
    _, predictions = predicted
    assert slots_of(worker, predictions[0], 0) is predictions[0].rollout
    assert slots_of(worker, Prediction("MAGE", predictions[1].frames_T3HW[:1]), 0).slots.shape[:2] == (1, 1)


def test_a_clip_shows_everybody_above_their_masks(worker: Worker) -> None:
    (scene,) = study_scenes("test", 1, 0)
    clip = PredictionClip(scene, (), 0, "prediction", "SSIM 0.5", best=False, rank=2).run(worker)
    assert clip.panels == ("real", "ours") and clip.name == "prediction-worst-2.gif"
    assert clip.badge == "worst 2" and clip.caption == f"SSIM 0.5; seed {scene.seed}"
    assert clip.gif[:6] == b"GIF89a"


@pytest.mark.parametrize(
    ("badness", "count", "best", "worst"),
    [([3, 1, 5, 2, 4], 10, "bda", "ce"), ([3], 10, "a", ""), ([3, 1, 5, 2, 4], 1, "b", "c")],
)
def test_no_case_is_among_the_best_and_the_worst(badness: list[float], count: int, best: str, worst: str) -> None:
    (scene,) = study_scenes("test", 1, 0)
    clips = [PredictionClip(scene, (), 0, "prediction", "abcde"[i]) for i in range(len(badness))]
    found = [(clip.caption, clip.place) for clip in extreme_clips(clips, badness, count)]
    assert found == [
        *((case, f"best {rank}") for rank, case in enumerate(best, start=1)),
        *((case, f"worst {rank}") for rank, case in enumerate(worst, start=1)),
    ]


def test_a_baseline_that_is_not_trained_is_absent_with_the_command(tmp_path) -> None:
    loads = {"MAGE": LoadCheckpoint("mage-nowhere"), "Non-OC": LoadStill(None)}
    with pytest.raises(CheckpointError, match="mage-nowhere"):  # somebody asked for that one
        find_models(loads)


def test_bundled_ones_may_be_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str) -> None:
        raise CheckpointError(f"unknown checkpoint {name!r}")

    monkeypatch.setattr("textocvp.protocols.load_model", nothing)
    mage = METHODS["MAGE"]
    present, missing = find_models({"MAGE": LoadCheckpoint(mage.model), "Non-OC": LoadStill(None)})
    assert [(one.key, one.longest, one.slots) for one in present] == [("Non-OC", None, False)]
    assert missing == {"MAGE": f"not trained: `{mage.train}`"}
