"""Long goals: what is measured, with a world model that is always right and one that is wrong."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from envs import parse_instruction
from experiments.long_horizon import Args, Sizes, column_rows, main
from experiments.protocol.arguments import UsageError
from experiments.protocol.long_goals import (
    LONG_COLUMNS,
    METHODS,
    LongEpisode,
    LongOutcome,
    choose_long,
    long_scenes,
    taken_scene,
)
from experiments.protocol.scenes import draw
from experiments.protocol.workers import Worker
from tests.experiments.oracle import LoadOracle

BY_NAME = {method.name: method for method in METHODS}
COLUMNS = {column.name: column for column in LONG_COLUMNS}


@pytest.fixture(scope="module")
def worker() -> Worker:
    return Worker(LoadOracle()())


def play(worker: Worker, method: str, column: str, number: int = 0) -> LongOutcome:
    scene = long_scenes(COLUMNS[column], number + 1, 0)[number]
    return LongEpisode(BY_NAME[method], scene).run(worker)


def test_a_whole_study(tmp_path: Path) -> None:
    args = Args(out=tmp_path, quick=True, workers=1)
    main(args, load=LoadOracle(), sizes=Sizes(one=1, two=1, three=0, taken=1, clips=1))
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["study"] == "long_horizon" and data["quick"] is True
    assert data["headline"]["closed_loop_one_step"] == data["headline"]["closed_loop_two_steps"] == 1.0
    assert data["headline"]["expert_bowl_taken"] == 1.0
    assert "closed_loop_three_steps" not in data["headline"]
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert {"report.html", "timings.json", "plots/success.png", "clips/long-1.gif"} <= written
    page = (tmp_path / "report.html").read_text()
    assert "Quick run." in page and "random order, one plan" in page


def test_in_a_taken_bowl_only_one_order_works(worker: Worker) -> None:
    works = play(worker, "expert", "bowl taken")
    fails = play(worker, "expert, order as written", "bowl taken")
    assert (works.success, works.gained, works.empties_first) == (True, 1.0, True)
    assert (fails.success, fails.gained, fails.empties_first) == (False, 0.0, False)
    assert works.instructions == fails.instructions[::-1]


def test_the_second_block_lies_in_the_first_ones_bowl(worker: Worker) -> None:
    scenes = long_scenes(COLUMNS["bowl taken"], 3, 0)
    assert len({scene.seed for scene in scenes}) == 3 and scenes[0] == taken_scene(scenes[0].seed)
    for scene in scenes:
        drawn = draw(worker.environment(scene), scene)
        first, second = parse_instruction(drawn.texts[0])
        place = {(o["kind"], o["color"]): o["position"][:2] for o in drawn.info["objects"]}
        off = place["block", second.block] - place["bowl", first.bowl]
        assert abs(off).max() < 0.02, "in metres"
        assert not drawn.info["is_success"]


def test_columns_share_no_scene() -> None:
    seeds = [{scene.seed for scene in long_scenes(column, 100, 0)} for column in LONG_COLUMNS]
    assert sum(map(len, seeds)) == len(set().union(*seeds)) == 400


def test_random_order_gets_the_goals_steps_and_random_sequence_does_not(worker: Worker) -> None:
    told = [play(worker, "random order, one plan", "two steps", i) for i in range(4)]
    goals = [
        {f"put the {p.block} block in the {p.bowl} bowl" for p in parse_instruction(o.text)} for o in told
    ]
    assert [set(outcome.instructions) for outcome in told] == goals
    assert all(outcome.success for outcome in told)
    drawn = [play(worker, "random sequence, one plan", "two steps", i) for i in range(4)]
    assert [set(outcome.instructions) for outcome in drawn] != goals
    assert not all(outcome.success for outcome in drawn)


def test_rows_are_of_what_happened(worker: Worker) -> None:
    scene = long_scenes(COLUMNS["two steps"], 1, 0)[0]
    outcome = LongEpisode(BY_NAME["ours, one plan"], scene).run(worker)
    half = replace(outcome, success=False, gained=0.5, believes_reached=True)
    rows = column_rows(BY_NAME["ours, one plan"], COLUMNS["two steps"], [outcome, half])
    assert {row.metric: row.value for row in rows} == {
        "closed_loop_success": 0.5,
        "subgoals_reached": 0.75,
        "steps": 2.0,
        "wrong_belief": 0.5,
    }
    assert {row.n for row in rows} == {2}
    pictures = choose_long([outcome, half], 1)
    assert [picture.outcome.success for picture in pictures] == [False, True]


def test_quick_and_full_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="--quick and --full"):
        Args(quick=True, full=True)
