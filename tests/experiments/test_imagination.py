"""Imagination: what is measured, with the shipped model in a few scenes."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

import textocvp
from envs.tasks.rearrange import FAMILIES
from experiments.imagination import ATTEMPTS, SEEDS, STUDY, Args, Episode, Sizes, family_scene, goal_of
from experiments.study.foresight import CASES, LINES, OURS, ByFilms, Foresight, TrueSlotsPlanner, foresight
from experiments.study.pool import Worker
from experiments.study.run import UsageError, run
from planning import Goal, PictureGoal, SegmentationGrounder, Thing, places
from textocvp import WorldModel


@pytest.fixture(scope="module")
def worker() -> Worker:
    return Worker(WorldModel.from_pretrained())


def test_a_whole_study(tmp_path: Path) -> None:
    other = str(Path(textocvp.__file__).parent / "checkpoints/tabletop-small")
    args = Args(out=tmp_path, quick=True, workers=1, retrained=(other, other))
    run(STUDY, args, sizes=Sizes(scenes=1, outcomes=6, clips=2))
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["headline"]["occupied_simulator"] == data["headline"]["plain"] == 1.0
    assert data["headline"]["occupied_no_imagination"] == data["headline"]["occupied_believes"] == 0.0
    assert {f"outcome_{case}" for case in CASES[:3]} <= set(data["headline"])
    hashes = {hashlib.sha256(line.strip(",").encode()).hexdigest()[:12]
              for line in (tmp_path / "scenes.json").read_text().splitlines()[1:-1]}  # fmt: skip
    again = {}
    for line in data["episodes"]:
        assert line["scene"] in hashes
        again.setdefault((line["method"], line["place"]), []).append(line["success"])
    for row in data["rows"]:
        if row["metric"] == "closed_loop_success" and row["method"] in LINES:
            assert row["value"] == np.mean(again[row["method"], row["variant"]])
    seeds = [(row["variant"], row["n"]) for row in data["rows"] if row["method"] == SEEDS]
    assert ("tower", 3) in seeds and len(seeds) >= len(FAMILIES) + 3
    page = (tmp_path / "report.html").read_text()
    assert "Goals that need foresight" in page and (tmp_path / "clips/imagination-1.gif").exists()


def test_an_episode_comes_out_the_same_again_and_keeps_to_its_attempts(worker: Worker) -> None:
    for family in ("occupied", "picture"):
        for key in ("random", OURS):
            first, again = (Episode(key, family_scene(family, 5_000), seed=0).run(worker) for _ in range(2))
            assert (first.instructions, first.success) == (again.instructions, again.success)
            assert first.steps <= ATTEMPTS[family]


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


def test_true_slots_are_where_the_simulator_sees_them(worker: Worker) -> None:
    scene = family_scene("plain", 5_001)
    observation, info = worker.environment(scene).reset(seed=scene.seed, options=dict(scene.options))
    planner, grounder = TrueSlotsPlanner(worker.world_model), SegmentationGrounder.from_info(info)
    parsed, grounding, _ = planner.look(observation["rgb"], goal_of(observation, info), grounder)
    things = sorted(grounding.things)
    for at_2, thing in zip(places(parsed, grounding, things)[0].numpy(), things, strict=True):
        label = next(one["label"] for one in info["objects"] if Thing(one["color"], one["kind"]) == thing)
        y, x = np.nonzero(info["segmentation"] == label)
        np.testing.assert_allclose(at_2, (x.mean() + 0.5, y.mean() + 0.5), atol=1e-3)


def test_a_model_without_foresight_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no model\.safetensors"):
        Args(retrained=(str(tmp_path),))
    with pytest.raises(UsageError, match="cannot foresee outcomes"):
        run(STUDY, Args(checkpoint="ocvp-seq-small", out=tmp_path, quick=True, workers=1))


def test_cliports_table_has_a_folder_and_a_model_of_its_own() -> None:
    simple, cliport, own = Args(), Args(scene="cliport"), Args(scene="cliport", checkpoint="runs/mine")
    assert [one.checkpoint for one in (simple, cliport, own)] == ["tabletop-small", "cliport", "runs/mine"]
    assert cliport.folder("imagination").name == "imagination-cliport" != simple.folder("imagination").name
    assert "--scene cliport" in cliport.command("imagination")


def test_episodes_on_cliports_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that foresees no outcome foresees by films; rows that imagine nothing do what they do elsewhere."""
    worker = Worker(WorldModel.from_pretrained("cliport"))
    played = {}
    for key, family in (
        ("simulator", "occupied"), ("no imagination", "occupied"), ("no imagination", "plain"), ("random", "plain"),
    ):  # fmt: skip
        scene = family_scene(family, 5_000, "cliport", 168)
        played[key, family] = Episode(key, scene, seed=0).run(worker)
    assert played["simulator", "occupied"].success and played["no imagination", "plain"].success
    assert not played["no imagination", "occupied"].success
    assert all(1 <= one.steps <= ATTEMPTS[family] for (_, family), one in played.items())
    env = worker.environment(scene, record=False)
    observation, _ = env.reset(seed=scene.seed, options=dict(scene.options))
    assert foresight(worker.world_model) is worker.world_model
    monkeypatch.setattr(WorldModel, "foresees", False)
    model = foresight(worker.world_model)
    assert isinstance(model, ByFilms)
    said = [played["no imagination", "plain"].instructions[0]] * 2
    ends = model.outcome(model.parse(observation["rgb"][None]), said)
    film = model.rollout(model.parse(observation["rgb"][None]), said[:1], horizon=model.longest_horizon)
    np.testing.assert_allclose(ends.positions[1, 1], film.positions[0, -1], atol=1e-3)
    assert ends.slots.shape[1] == 2
