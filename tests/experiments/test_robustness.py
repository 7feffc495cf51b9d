"""The robustness study: drops by hand, and the study as a whole with doubles."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from experiments.report.results import Results
from experiments.report.rows import Row
from experiments.report.tables import as_percent
from experiments.robustness import (
    BARS,
    REPARSED,
    SPLITS,
    STUDY,
    RobustOutcome,
    RobustScene,
    Sizes,
    Values,
    bars_table,
    by_name,
    cases,
    difference_rows,
    drop,
    drop_difference,
    headline,
    rows_of,
    verdict,
)
from experiments.study.frame_metrics import Measures
from experiments.study.methods import Model
from experiments.study.pictures import CHANGES, WORDS
from experiments.study.pool import Worker
from experiments.study.run import Run, ScenesArgs, run
from experiments.study.scenes import study_scenes
from tests.experiments.oracle import LoadOracle
from tests.experiments.still import LoadStill
from textocvp.checkpoint import Checkpoint

ST_LPIPS = Measures(("st_lpips",), None, (), (("lpips", "no weights here"),))
BARE = Measures()
STILL = Model("MAGE", LoadStill(), False, "still", "1" * 64, 12)


def values(test: list[float], unseen: list[float]) -> Values:
    return {"test": np.array(test), "unseen_colors": np.array(unseen)}


def test_a_drop_is_how_much_worse_a_figure_is() -> None:
    """.75 is a quarter less than 1; a distance of .06 is a fifth more than .05. Both are drops."""
    success = values([1, 1, 1, 1], [1, 1, 1, 0])
    fallen = drop("closed_loop_success", success, "unseen_colors")
    assert fallen is not None and fallen.value == pytest.approx(0.25)
    found = drop("st_lpips", values([0.05, 0.05], [0.05, 0.07]), "unseen_colors")
    assert found is not None and found.value == pytest.approx(0.2)
    assert (found.low, found.high) == pytest.approx((0.0, 0.4)) and found.n == 2
    better = drop("ssim", values([0.8, 0.8], [0.88, 0.88]), "unseen_colors")
    assert better is not None and (better.low, better.value, better.high) == pytest.approx((-0.1,) * 3)
    assert drop("iou", values([0.0, 0.0], [0.5]), "unseen_colors") is None  # nothing to fall from
    assert drop("closed_loop_success", success, "more_objects") is None


def test_drops_are_compared_scene_by_scene() -> None:
    """Ours grows from .1 by a half and by nothing, MAGE by as much and a fifth more of its .2 in every scene."""
    ours, mage = values([0.1, 0.1], [0.15, 0.1]), values([0.2, 0.2], [0.34, 0.24])
    found = drop_difference("st_lpips", ours, mage, "unseen_colors")
    assert found is not None and (found.low, found.value, found.high) == pytest.approx((-0.2,) * 3)
    place = "9 frames", "st_lpips"
    (row,) = difference_rows({("ours", *place): ours, ("MAGE", *place): mage})
    assert row.key == ("ours minus MAGE", "unseen_colors", "9 frames", "st_lpips_drop_difference")
    ssim, other = values([0.8, 0.8], [0.6, 0.6]), values([0.8, 0.8], [0.4, 0.4])
    difference = drop_difference("ssim", ssim, other, "unseen_colors")
    assert difference is not None and difference.value == pytest.approx(-0.25)
    assert drop_difference("st_lpips", ours, values([0.1], [0.1]), "unseen_colors") is None


def test_rows_of_a_figure() -> None:
    rows = rows_of(("ours", "9 frames", "closed_loop_success"), values([1, 1, 1, 1], [1, 1, 1, 0]))
    assert [(r.split, r.metric, r.n) for r in rows] == [
        ("test", "closed_loop_success", 4),
        ("unseen_colors", "closed_loop_success", 4),
        ("unseen_colors", "closed_loop_success_drop", 4),
    ]
    assert rows[1].value == 0.75 and rows[1].high < 1  # Wilson


def outcome(split: str, number: int, ssim: float, good: bool) -> RobustOutcome:
    scene = study_scenes(split, number + 1, 0)[number]
    return RobustOutcome(scene, {"ours": {"ssim": np.full(24, ssim), "iou": np.full(24, 0.5)}}, {"ours": good})


def test_worst_cases_are_failures_first_and_never_of_the_test_set(tmp_path: Path) -> None:
    outcomes = [
        outcome("test", 0, 0.1, False),
        outcome("unseen_colors", 0, 0.9, True),
        outcome("unseen_colors", 1, 0.2, True),
        outcome("more_objects", 0, 0.8, False),
        outcome("more_objects", 1, 0.7, True),
    ]
    sizes = Sizes(imagined=2, loop=0, controls=0, changed=0, clips=2, acted=0)
    this = Run(STUDY, ScenesArgs(out=tmp_path), load=LoadOracle(), sizes=sizes, loads={}, measures=BARE)
    clips = cases(this, {"frames and masks": outcomes, "closed loop": []})["imagined clips"]
    shown = [(clip.best, clip.scene.split, clip.good) for clip in clips]  # type: ignore[attr-defined]
    assert shown == [
        (True, "unseen_colors", True),
        (True, "more_objects", True),
        (False, "more_objects", False),
        (False, "unseen_colors", True),
    ]
    found = by_name((one.scene.split, one.figures()) for one in outcomes)
    assert found["ours", "whole episode", "predicted_success"]["more_objects"].tolist() == [0.0, 1.0]
    assert found["ours", "19 frames", "ssim"]["unseen_colors"] == pytest.approx([0.9, 0.2])


def results(**figures: float) -> Results:
    return Results("robustness", Checkpoint("a", ""), {}, {}, False, 1.0, [], figures)


def test_bars_are_passed_missed_or_undecided() -> None:
    unseen, more, drop, _ = BARS
    assert verdict(unseen, results(closed_loop_unseen_colors=0.75)) == "pass"
    assert verdict(unseen, results(closed_loop_unseen_colors=0.74)) == "miss"
    assert verdict(more, results(closed_loop_more_objects=0.79)) == "miss"
    assert verdict(more, results()) == "not measured"
    assert verdict(drop, results(lpips_drop_unseen_colors=0.1, lpips_drop_unseen_colors_mage=0.2)) == "pass"
    assert verdict(drop, results(lpips_drop_unseen_colors=0.2, lpips_drop_unseen_colors_mage=0.2)) == "miss"
    assert verdict(drop, results(lpips_drop_unseen_colors=0.2)) == "undecided: no MAGE"
    assert verdict(drop, results()) == "undecided: no LPIPS"
    assert as_percent(-0.064) == "-6.4 %" and as_percent(-0.0) == "0.0 %"


@pytest.mark.parametrize(("low", "high", "said"), [(0.7, 0.9, "within the interval"), (0.76, 0.9, ""), (0.5, 0.7, "")])
def test_a_verdict_that_the_interval_leaves_open_says_so(low: float, high: float, said: str) -> None:
    value = (low + high) / 2
    row = Row("ours", "unseen_colors", "whole episode", "closed_loop_success", value, low, high, 8)
    study = Results("robustness", Checkpoint("a", ""), {}, {}, False, 1.0, [row], {BARS[0].name: value})
    cell = bars_table(study, ST_LPIPS).rows[0].cells[-1]
    assert cell.text == verdict(BARS[0], study) and cell.interval == said


def test_without_a_learned_distance_its_headline_is_absent(tmp_path: Path) -> None:
    rows = rows_of(("ours", "9 frames", "ssim"), values([1, 1], [1, 1]))
    args = ScenesArgs(out=tmp_path)
    assert Run(STUDY, args, load=LoadOracle(), loads={}, measures=BARE).headline(rows) == {}
    with_it = Run(STUDY, args, load=LoadOracle(), loads={}, measures=ST_LPIPS)
    assert headline(with_it)["lpips_drop_unseen_colors_mage"] == (
        "MAGE", "unseen_colors", "9 frames", "st_lpips_drop",
    )  # fmt: skip


def test_a_model_that_is_always_right_is_judged_right_with_and_without_its_own_masks() -> None:
    (scene,) = study_scenes("more_objects", 1, 0)
    outcome = RobustScene(scene, (STILL,), BARE, 0).run(Worker(LoadOracle()()))
    assert outcome.success == {
        "ours": True, REPARSED: True, "true frames": True, "wrong text": False, "copy frame": True,
    }  # fmt: skip
    # The double's parser knows what happened whatever it is shown, so REPARSED and `copy frame` are right here too.
    found = outcome.figures()
    assert ("ours", "19 frames", "iou") in found and ("MAGE", "19 frames", "iou") not in found
    assert len(outcome.curves["ours"]["ssim"]) == 19
    assert len(outcome.curves["MAGE"]["iou"]) == 12 and "MAGE" not in outcome.success


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "results"
    run(
        STUDY,
        ScenesArgs(out=out, quick=True, workers=1),
        load=LoadOracle(),
        sizes=Sizes(imagined=1, loop=1, controls=1, changed=1, clips=1, acted=2),
        loads={"MAGE": LoadStill(24)},
        measures=ST_LPIPS,
    )
    return out


def test_the_study_as_a_whole(folder: Path) -> None:
    found = Results.read(folder / "results.json")
    assert set(found.headline) == {
        "closed_loop_test", "closed_loop_unseen_colors", "closed_loop_more_objects",
        "lpips_drop_unseen_colors", "lpips_drop_more_objects",
        "lpips_drop_unseen_colors_mage", "lpips_drop_more_objects_mage",
    }  # fmt: skip
    assert [found.headline[f"closed_loop_{split}"] for split in SPLITS] == [1.0, 1.0, 1.0]
    by_split = {r.split for r in found.rows if r.metric == "closed_loop_success" and r.method == "expert"}
    assert by_split == set(SPLITS)
    changed = [row for row in found.rows if row.metric == "reached"]
    assert {(row.method, row.variant) for row in changed} == set(product(WORDS, CHANGES))
    assert len(changed) == len(WORDS) * len(CHANGES) and {row.value for row in changed} == {1.0}
    test, unseen = (found.find("ours", "9 frames", "st_lpips", s) for s in ("test", "unseen_colors"))
    assert test is not None and unseen is not None
    assert found.headline["lpips_drop_unseen_colors"] == pytest.approx(unseen.value / test.value - 1, abs=1e-4)


def test_the_page_shows_bars_paper_and_clips(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    for words in ("paper, MAGE-DINO", "37.5 %", "at least 0.75", "LPIPS is absent: no weights here", "Quick run"):
        assert words in page
    files = {str(path.relative_to(folder)) for path in folder.rglob("*.*")}
    assert {"clips/robustness-best-1.gif", "clips/robustness-worst-1.gif", "plots/drops.png"} <= files
    assert any(name.startswith("clips/closed-loop-") for name in files)
