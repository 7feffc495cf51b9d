"""Timing: turns, medians, what is left out, and a whole study with the shipped checkpoint at its smallest."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.runtime import (
    OURS,
    PLANNING,
    QUERY,
    STUDY,
    UNCACHED,
    WINDOW,
    Sizes,
    Subject,
    Timing,
    all_timings,
    published_form,
)
from experiments.study.run import StudyArgs, run
from experiments.study.scenes import SampledScene, StudyScene
from experiments.study.timing import machine_in_words, median_interval, race
from tests.textocvp.conftest import PLACED, build
from textocvp.world_model import WorldModel


def rows_of(seconds: dict) -> list:
    return list(STUDY.rows(None, {"phases": [seconds]}))  # type: ignore[arg-type]


class Watch:
    """A clock that only work moves on."""

    def __init__(self) -> None:
        self.now, self.turns = 0.0, []

    def takes(self, name: str, seconds: float):
        def work() -> None:
            self.turns.append(name)
            self.now += seconds

        return work

    def __call__(self) -> float:
        return self.now


def test_all_have_their_turn_in_every_round() -> None:
    watch = Watch()
    timed = race({"a": watch.takes("a", 1.0), "b": watch.takes("b", 2.0)}, 4, 100, watch)
    assert timed["a"].tolist() == [1.0] * 4 and timed["b"].tolist() == [2.0] * 4
    # One round that does not count, and then another one starts each time.
    assert "".join(watch.turns) == "ab" + "ab" + "ba" + "ab" + "ba"


def test_slow_work_is_cut_short_after_three_rounds() -> None:
    watch = Watch()
    assert len(race({"a": watch.takes("a", 50.0)}, 20, 100, watch)["a"]) == 3
    assert len(race({"a": watch.takes("a", 10.0)}, 20, 100, watch)["a"]) == 10


def test_slow_work_does_not_cut_short_what_is_quick() -> None:
    watch = Watch()
    timed = race({"slow": watch.takes("a", 50.0), "quick": watch.takes("b", 2.0)}, 15, 100, watch)
    assert {name: len(rounds) for name, rounds in timed.items()} == {"slow": 3, "quick": 15}
    what = Timing("predict", 9, 1, 1)
    rows = rows_of({(OURS, what): timed["quick"], (WINDOW, what): timed["slow"]})
    (ratio,) = [row for row in rows if row.method == f"{WINDOW} / {OURS}"]
    assert (ratio.value, ratio.n) == (25.0, 3)


def test_the_median_has_an_interval_of_order_statistics() -> None:
    # n = 15: the 4th smallest to the 4th largest cover 96.5 % (textbook table of the sign test).
    interval = median_interval(np.arange(15.0)[::-1])
    assert (interval.value, interval.low, interval.high, interval.n) == (7.0, 3.0, 11.0, 15)
    assert median_interval(np.arange(6.0)).low == 0.0
    few = median_interval(np.array([3.0, 1.0, 2.0]))
    assert (few.value, few.low, few.high) == (2.0, 1.0, 3.0)
    with pytest.raises(ValueError, match="no values"):
        median_interval(np.array([]))


def test_everything_is_timed_once() -> None:
    timings = all_timings((1, 9), (1, 16), (1, 2))
    assert len(timings) == len(set(timings)) == 2 * 2 * (1 + 3 * 2) + 2 * len(PLANNING)


def test_few_frames_are_drawn_where_that_is_slow() -> None:
    seen = {"rgb": np.zeros((32, 32, 3), np.uint8)}
    texts = ("put the red block in the blue bowl",)
    sampled = [SampledScene(StudyScene("test", seed, ()), seen, {}, texts) for seed in (0, 1)]
    subject = Subject("a", WorldModel(build(PLACED)), ("predict", "decode", "all"), drawn=4)
    asked = [(phase, t, b) for phase in ("encode", "predict", "decode", "all") for t in (2, 4, 9) for b in (1, 2)]
    done = {what for what in asked if subject.work(Timing(*what, 1), sampled) is not None}
    # Nine frames are beyond this model, encoding was not asked for, and 4 frames of 2 scenes are too many to draw.
    assert done == {("predict", t, b) for t in (2, 4) for b in (1, 2)} | {
        (phase, t, b) for phase in ("decode", "all") for t, b in ((2, 1), (2, 2), (4, 1))
    }


def test_ratios_are_of_rounds_not_of_medians() -> None:
    what, query = Timing("predict", 9, 1, 1), Timing("query", 24, 30, 1)
    # A burst of other work in the second round slows both alike.
    seconds = {(OURS, what): np.array([1.0, 10.0, 1.0]), (WINDOW, what): np.array([3.0, 30.0, 3.0])}
    found = {row.key: row for row in rows_of({**seconds, (OURS, query): np.array([0.5, 0.5])})}
    row = found[f"{WINDOW} / {OURS}", "1 thread", "predict, 9 x 1", "ratio"]
    assert (row.value, row.low, row.high, row.n) == (3.0, 3.0, 3.0, 3)
    assert found[OURS, "1 thread", QUERY, "queries_per_second"].value == 2.0
    assert found[OURS, "1 thread", QUERY, "candidates_per_second"].value == 60.0
    assert found[OURS, "1 thread", "predict, 9 x 1", "milliseconds"].value == 1000.0
    assert len(found) == 5


def test_a_model_is_compared_with_itself() -> None:
    def seconds(phase: str, batch: int, threads: int, value: float) -> dict:
        return {(OURS, Timing(phase, 9, batch, threads)): np.array([value])}  # type: ignore[arg-type]

    rows = rows_of(
        seconds("predict", 1, 1, 2.0)
        | seconds("decode", 1, 1, 8.0)
        | seconds("predict", 16, 1, 16.0)
        | seconds("predict", 16, 2, 10.0)
    )
    assert {(row.method, *row.key[1:3]): row.value for row in rows if row.metric == "ratio"} == {
        (f"{OURS}: decode / predict", "1 thread", "predict, 9 x 1"): 4.0,
        (f"{OURS}: a scene of a batch / a scene alone", "1 thread", "predict, 9 x 16"): 0.5,
        (f"{OURS}: 1 thread / all", "2 threads", "predict, 9 x 16"): 1.6,
    }


def test_the_published_form_has_the_same_sizes() -> None:
    ours = WorldModel(build(PLACED))
    window = published_form(ours)
    assert window.model.config.predictor.attention == "window" and window.longest_horizon is None

    def parameters(model: WorldModel) -> int:
        return sum(p.numel() for name, p in model.model.named_parameters() if name != "predictor.ages")

    assert parameters(window) == parameters(ours)


def test_a_whole_study(tmp_path: Path) -> None:
    tiny = Sizes(frames=(1, 2), batches=(1, 2), repeats=3, seconds=0.0, drawn=0, threads=(1,))
    run(STUDY, StudyArgs(out=tmp_path, quick=True), sizes=tiny)
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["study"] == "runtime" and data["versions"]["machine"] == machine_in_words()
    assert data["headline"]["planning_queries_per_second"] > 0
    assert data["seeds"] == {"slots": [0], "phases, test": [20000000, 20000001]}
    found = {(row["method"], row["split"], row["variant"]): row for row in data["rows"]}
    assert found[OURS, "1 thread", "encode, 1 x 2"]["n"] == 3
    for phase in ("predict", "decode", "all"):
        for frames in (1, 2):
            assert (OURS, "1 thread", f"{phase}, {frames} x 2") in found
            assert ("MAGE", "1 thread", f"{phase}, {frames} x 2") in found
    assert (WINDOW, "1 thread", "decode, 1 x 1") not in found
    # What a planner's time goes into, and the predictor without its cache.
    assert {(OURS, "1 thread", "imagine, 24 x 30"), (OURS, "1 thread", "masks, 24 x 30")} <= set(found)
    assert (UNCACHED, "1 thread", "predict, 2 x 2") in found
    page = (tmp_path / "report.html").read_text()
    assert "untrained, timing only" in page and "Quick run." in page
