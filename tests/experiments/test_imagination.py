"""Imagination: what is measured, with the shipped model in a few scenes."""

import json
from pathlib import Path

import numpy as np
import pytest

from envs.tasks.rearrange import FAMILIES
from experiments.imagination import (
    ATTEMPTS,
    CASES,
    LINES,
    OURS,
    STUDY,
    Episode,
    Foresight,
    Sizes,
    family_scene,
    goal_of,
)
from experiments.study.pool import Worker
from experiments.study.run import StudyArgs, UsageError, run
from planning import Goal, PictureGoal
from textocvp import WorldModel


@pytest.fixture(scope="module")
def worker() -> Worker:
    return Worker(WorldModel.from_pretrained())


def test_a_whole_study(tmp_path: Path) -> None:
    args = StudyArgs(out=tmp_path, quick=True, workers=1)
    run(STUDY, args, sizes=Sizes(scenes=1, outcomes=6, clips=2))
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["headline"]["occupied_simulator"] == data["headline"]["plain"] == 1.0
    assert data["headline"]["occupied_no_imagination"] == data["headline"]["occupied_believes"] == 0.0
    assert {f"outcome_{case}" for case in CASES[:3]} <= set(data["headline"])
    lines = json.loads((tmp_path / "episodes.json").read_text())
    again = {}
    for line in lines:
        again.setdefault((line["method"], line["family"]), []).append(line["success"])
    for row in data["rows"]:
        if row["metric"] == "closed_loop_success" and row["method"] in LINES:
            assert row["value"] == np.mean(again[row["method"], row["variant"]])
    page = (tmp_path / "report.html").read_text()
    assert "Goals that need foresight" in page and (tmp_path / "clips/imagination-1.gif").exists()


def test_an_episode_comes_out_the_same_again_and_keeps_to_its_attempts(worker: Worker) -> None:
    for family in ("occupied", "picture"):
        for key in ("random", OURS):
            first, again = (Episode(key, family_scene(family, 5_000), seed=0).run(worker) for _ in range(2))
            assert (first.said, first.success) == (again.said, again.success)
            assert len(first.said) <= ATTEMPTS[family]


def test_goals_are_sentences_or_pictures(worker: Worker) -> None:
    for family in FAMILIES:
        scene = family_scene(family, 5_000)
        goal = goal_of(*worker.environment(scene).reset(seed=scene.seed, options=dict(scene.options)))
        assert isinstance(goal, PictureGoal if family == "picture" else Goal)


def test_foresight_is_judged_by_what_the_simulator_says(worker: Worker) -> None:
    """A model that foresees that nothing ever moves is right only where nothing does."""

    class Still:
        def __init__(self, model: WorldModel) -> None:
            self.parse, self.outcome = model.parse, lambda obs, text: obs

    scenes = [family_scene(family, 5_000) for family in ("covered", "plain", "tower")]
    found = [
        [one for scene in scenes for its in Foresight(scene, seed=0).run(who).right.values() for one in its]
        for who in (worker, Worker(Still(worker.world_model), worker._environments))
    ]
    assert len(found[0]) == len(found[1]) == 18
    assert np.mean(found[0]) > 0.7 > 0.5 > np.mean(found[1])


def test_a_model_without_foresight_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot foresee outcomes"):
        run(STUDY, StudyArgs(checkpoint="ocvp-seq-small", out=tmp_path, quick=True, workers=1))
