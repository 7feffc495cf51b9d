"""Long goals: what is measured, with a world model that is always right and one that is wrong."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.long_horizon import LINES, PLACES, STUDY, LongEpisode, Sizes, cases, long_scenes, taken_scene
from experiments.study.closed_loop import LoopOutcome
from experiments.study.methods import METHODS, PLANNERS
from experiments.study.pool import Worker
from experiments.study.run import FullArgs, Run, run
from experiments.study.scenes import sample_scene
from planning import Goal
from tests.experiments.oracle import LoadOracle


@pytest.fixture(scope="module")
def worker() -> Worker:
    return Worker(LoadOracle()())


def play(worker: Worker, key: str, column: str, number: int = 0) -> LoopOutcome:
    return LongEpisode(key, long_scenes(PLACES[column], number + 1, 0)[number]).run(worker)


def test_a_whole_study(tmp_path: Path) -> None:
    args = FullArgs(out=tmp_path, quick=True, workers=1)
    run(STUDY, args, load=LoadOracle(), sizes=Sizes(scenes=(1, 1, 0, 1), clips=1))
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["study"] == "long_horizon" and data["quick"] is True
    assert data["headline"]["closed_loop_one_step"] == data["headline"]["closed_loop_two_steps"] == 1.0
    assert data["headline"]["expert_bowl_taken"] == 1.0
    assert "closed_loop_three_steps" not in data["headline"]
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert {"report.html", "timings.json", "plots/success.png", "clips/closed-loop-1.gif"} <= written
    page = (tmp_path / "report.html").read_text()
    assert "Quick run." in page and "random order, one plan" in page


def test_in_a_taken_bowl_only_one_order_works(worker: Worker) -> None:
    works = play(worker, "expert", "bowl taken")
    fails = play(worker, "expert, order as written", "bowl taken")
    assert (works.success, works.gained) == (True, 1.0)
    assert (fails.success, fails.gained) == (False, 0.0)
    assert works.instructions == fails.instructions[::-1]
    for outcome in (works, fails):
        (row,) = [row for row in rows_of(outcome) if row.metric == "empties_first"]
        assert row.value == outcome.success


def test_the_second_block_lies_in_the_first_ones_bowl(worker: Worker) -> None:
    scenes = long_scenes(PLACES["bowl taken"], 3, 0)
    assert len({scene.seed for scene in scenes}) == 3 and scenes[0] == taken_scene(scenes[0].seed)
    for scene in scenes:
        sampled = sample_scene(worker.environment(scene), scene)
        first, second = Goal.parse(sampled.texts[0]).instructions
        place = {(o["kind"], o["color"]): o["position"][:2] for o in sampled.info["objects"]}
        off = place["block", second.thing.color] - place["bowl", first.target.color]
        assert abs(off).max() < 0.02, "in metres"
        assert not sampled.info["is_success"]


def test_columns_share_no_scene() -> None:
    seeds = [{scene.seed for scene in long_scenes(split, 100, 0)} for split in PLACES.values()]
    assert sum(map(len, seeds)) == len(set().union(*seeds)) == 400


def test_random_order_gets_the_goals_steps_and_random_sequence_does_not(worker: Worker) -> None:
    told = [play(worker, "random order, one plan", "two steps", i) for i in range(4)]
    goals = [{one.text for one in Goal.parse(o.text).instructions} for o in told]
    assert [set(outcome.instructions) for outcome in told] == goals
    assert all(outcome.success for outcome in told)
    drawn = [play(worker, "random sequence, one plan", "two steps", i) for i in range(4)]
    assert [set(outcome.instructions) for outcome in drawn] != goals
    assert not all(outcome.success for outcome in drawn)


def rows_of(*outcomes: LoopOutcome) -> list:
    """The rows of outcomes of one column."""
    split = outcomes[0].episode.scene.split
    found = {title: list(outcomes) if PLACES[title] == split else [] for title in PLACES}
    return list(STUDY.rows(None, found))  # type: ignore[arg-type]


def test_rows_are_of_what_happened(worker: Worker, tmp_path: Path) -> None:
    outcome = play(worker, "ours, one plan", "two steps")
    half = replace(outcome, success=False, gained=0.5, believes_reached=True)
    rows = rows_of(outcome, half)
    assert {row.metric: row.value for row in rows} == {
        "closed_loop_success": 0.5,
        "subgoals_reached": 0.75,
        "steps": 2.0,
        "wrong_belief": 0.5,
    }
    assert {row.n for row in rows} == {2}
    this = Run(STUDY, FullArgs(out=tmp_path), load=LoadOracle(), sizes=Sizes((), clips=1))
    clips = cases(this, {title: [outcome, half] if title == "two steps" else [] for title in PLACES})["clips"]
    assert [clip.outcome.success for clip in clips] == [False, True]


def test_every_planner_of_all_studies_is_measured_in_some_form() -> None:
    renamed = {"random candidate": "random sequence"}
    for key in PLANNERS:
        if not (METHODS[key].expert or METHODS[key].privileged):
            name = renamed.get(key, key)
            assert LINES[f"{name}, replanning"].replan and not LINES[f"{name}, one plan"].replan
