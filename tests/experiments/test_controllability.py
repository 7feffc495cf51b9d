import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.controllability import HEADLINE, LOOP_PLACES, STUDY, PredictedScene, Sizes, column_of, predicted_clips
from experiments.study.clips import episode_clips
from experiments.study.closed_loop import LoopEpisode
from experiments.study.pool import Worker
from experiments.study.run import FullArgs, Run, run
from experiments.study.scenes import study_scenes
from tests.experiments.oracle import LoadOracle
from textocvp.checkpoint import CheckpointError

TINY = Sizes(predicted=1, slot_seeds=2, loop=1, other=0, long=0, controls=1, clips=1)
REPO = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "results"
    run(STUDY, FullArgs(out=out, quick=True, workers=1), load=LoadOracle(), sizes=TINY)
    return out


def test_a_world_model_that_is_always_right_gets_full_marks(folder: Path) -> None:
    data = json.loads((folder / "results.json").read_text())
    assert set(data["headline"]) == {
        "predicted_original",
        "predicted_variants_mean",
        "wrong_text",
        "copy_frame",
        "true_frames",
        "closed_loop_original",
        "closed_loop_variants_mean",
        "closed_loop_random",
        "candidate_ranking",
    }
    assert {name: value for name, value in data["headline"].items() if name != "closed_loop_random"} == {
        "predicted_original": 1.0,
        "predicted_variants_mean": 1.0,
        "wrong_text": 0.0,
        "copy_frame": 0.0,
        "true_frames": 1.0,
        "closed_loop_original": 1.0,
        "closed_loop_variants_mean": 1.0,
        "candidate_ranking": 1.0,
    }
    assert data["study"] == "controllability" and data["quick"] is True
    assert data["checkpoint"] == {"name": "oracle", "sha256": "0" * 64}
    assert data["seeds"]["slots"] == [0, 1]


def test_the_folder_is_complete(folder: Path) -> None:
    names = {str(p.relative_to(folder)) for p in folder.rglob("*.*")}
    wanted = {"results.json", "report.html", "timings.json", "plots/predicted.png", "plots/closed_loop.png"}
    assert wanted | {"clips/predicted-best-1.gif", "clips/predicted-worst-1.gif"} <= names
    assert not any(".partial" in name for name in names)
    page = (folder / "report.html").read_text()
    assert "paper, TextOCVP" in page and "best 1: success" in page


def test_more_processes_change_no_figure(folder: Path, tmp_path: Path) -> None:
    """The same seed in other processes: identical but for the seconds."""
    code = (
        "from pathlib import Path; from experiments.controllability import STUDY;"
        "from experiments.study.run import FullArgs, run;"
        "from tests.experiments.oracle import LoadOracle; from tests.experiments.test_controllability import TINY;"
        f"run(STUDY, FullArgs(out=Path({str(tmp_path)!r}), quick=True, workers=2), load=LoadOracle(), sizes=TINY)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=REPO, check=True, capture_output=True, timeout=600)
    first, second = (json.loads((f / "results.json").read_text()) for f in (folder, tmp_path))
    assert first.pop("seconds") > 0 and second.pop("seconds") > 0
    assert first == second


def test_what_is_imagined_wrongly_is_judged_wrong() -> None:
    """Blocks that the world model leaves where they are never count as placed, and are seen as worst cases."""
    colors = ("blue", "green", "red", "brown", "cyan", "gray", "yellow")
    (scene,) = study_scenes("controllability", 1, 0)
    outcome = PredictedScene(scene, 1, (0,)).run(Worker(LoadOracle(colors)()))
    ours = outcome.verdicts["ours"]
    assert not ours.success_SV.any()
    assert outcome.verdicts["true frames"].success_SV.all()
    assert (ours.miss_SV > 5).all()
    worst = [clip for clip in predicted_clips([outcome], 0, 1) if not clip.best]
    assert [clip.good for clip in worst] == [False]
    assert f"ends {ours.miss_SV.max():.1f} px" in worst[0].caption


def test_failures_are_shown() -> None:
    (scene,) = study_scenes("controllability", 1, 0)
    won = LoopEpisode("expert", scene).run(Worker(LoadOracle()()))
    assert won.success and won.steps == 1
    ours = replace(won, episode=LoopEpisode("ours", scene))
    lost = replace(ours, success=False)
    shown = episode_clips([ours, lost, won, ours], column_of, 1)
    assert [clip.outcome.success for clip in shown] == [False, True]
    assert {clip.column for clip in shown} == {"original"}


def test_a_long_goal_is_reached() -> None:
    (scene,) = study_scenes("two_steps", 1, 0)
    outcome = LoopEpisode("ours", scene).run(Worker(LoadOracle()()))
    assert outcome.success and outcome.steps == 2 and outcome.ranked_first is None


def test_the_random_candidate_does_not_depend_on_the_order_of_episodes() -> None:
    scenes = study_scenes("controllability", 2, 0)
    worker = Worker(LoadOracle()())
    episodes = [LoopEpisode("random candidate", scene, 0, 3, 7) for scene in scenes]
    forward = [episode.run(worker) for episode in episodes]
    backward = [episode.run(worker) for episode in reversed(episodes)][::-1]
    for a, b in zip(forward, backward, strict=True):
        assert replace(a, planning_seconds=None) == replace(b, planning_seconds=None)


def test_sizes_are_bounded_by_the_controls() -> None:
    sizes = Sizes(predicted=1, slot_seeds=1, loop=8, other=6, long=4, controls=3, clips=1)
    counts = [
        [sizes.scenes(split, method) for split, _ in LOOP_PLACES.values()] for method in ("ours", "random candidate")
    ]
    assert counts == [[8, 8, 8, 8, 6, 6, 4, 4], [3, 3, 3, 3, 3, 3, 2, 2]]


def test_an_unknown_checkpoint_is_an_early_error(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no-such-model"):
        run(STUDY, FullArgs(checkpoint="no-such-model", out=tmp_path / "r"))
    assert list((tmp_path / "r").iterdir()) == []


@pytest.mark.parametrize("how", [["experiments/controllability.py"], ["-m", "experiments.controllability"]])
def test_the_command_line_says_what_is_wrong(how: list[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    command = [sys.executable, *how, "--quick", "--out", str(tmp_path / "file")]
    # The path stands for `pip install -e .`, which may not have been run where the tests are.
    env = {**os.environ, "PYTHONPATH": str(REPO)}
    done = subprocess.run(command, cwd=REPO, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode != 0
    assert "cannot write to" in done.stderr and "Traceback" not in done.stderr


def test_the_headline_needs_every_row(tmp_path: Path) -> None:
    assert STUDY.headline is HEADLINE
    with pytest.raises(ValueError, match="'predicted_original' was not measured"):
        Run(STUDY, FullArgs(out=tmp_path), load=LoadOracle()).headline([])


def test_verdicts_have_the_shape_of_seeds_and_instructions() -> None:
    (scene,) = study_scenes("controllability", 1, 0)
    outcome = PredictedScene(scene, 2, (0, 1)).run(Worker(LoadOracle()()))
    for method, seeds in (("ours", 2), ("wrong text", 2), ("copy frame", 2), ("true frames", 1)):
        assert outcome.verdicts[method].success_SV.shape == (seeds, 3)
        assert outcome.verdicts[method].success_SV.dtype == np.bool_
    assert outcome.imagined_TV.shape == (25, 3)
