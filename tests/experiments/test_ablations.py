"""The ablation study: runs that are there, runs that are not, and more or fewer slots at test time."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from torch import nn

import textocvp
from envs.colors import COLORS
from experiments.ablations import STUDY, Args, Entrant, FollowingScene, Outcome, Sizes, slots_name, tables
from experiments.report.rows import Row, figure_rows
from experiments.study.ablation_runs import PREDICTORS, RUNS, find_run, load_run
from experiments.study.pool import Worker
from experiments.study.run import run
from experiments.study.scenes import study_scenes
from tests.experiments.oracle import LoadOracle
from textocvp import WorldModel
from textocvp.model import TextOCVP

SHIPPED = Path(textocvp.__file__).parent / "checkpoints" / "tabletop-small"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`base` is there, `layers-1` was trained with other settings, `layers-2` stopped half-way."""
    folder = tmp_path_factory.mktemp("runs")
    model = TextOCVP.from_pretrained(SHIPPED)  # with the preset's window, and without foresight
    predictor = replace(model.config.predictor, window=24)
    model.config, model.outcome = replace(model.config, predictor=predictor, outcome=None), None
    model.predictor.ages = nn.Parameter(model.predictor.ages[:24])
    for name in ("base", "layers-1"):
        model.save_pretrained(folder / name / "checkpoint")
        (folder / name / "following.json").write_text("{}")
    for name in ("base", "layers-2"):
        (folder / name / "state").mkdir(parents=True)
    (folder / "base" / "state" / "step.json").write_text('{"next_step": 123}')
    return folder


@pytest.fixture(scope="module")
def results(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    args = Args(out=out, runs=runs, quick=True, workers=1)
    sizes = Sizes(following=2, unseen=1, acted=1, parsing=1, slots=1, clips=1, slot_counts=(4, 12))
    run(STUDY, args, sizes=sizes)
    return out


def test_what_there_is_of_every_run(runs: Path) -> None:
    found = [load_run(find_run(run, runs)) for run in RUNS]
    states = {one.run.key: one.state for one in found}
    assert states.pop("base") == "trained" and find_run(PREDICTORS[0], runs).updates == 123
    assert states.pop("layers-1") == "other settings"
    assert states.pop("layers-2") == "not finished"
    assert set(states.values()) == {"not trained"}
    assert {one.run.key: len(one.sha256) for one in found if one.sha256} == {"base": 16}


def test_figures_of_episodes_without_masks_count_too(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs / "base", tmp_path / "base")
    (tmp_path / "base" / "following.json").rename(tmp_path / "base" / "slot_errors.json")
    assert find_run(PREDICTORS[0], tmp_path).state == "trained"
    (tmp_path / "base" / "slot_errors.json").unlink()
    assert find_run(PREDICTORS[0], tmp_path).state == "not finished"


def test_figures_of_what_is_there(results: Path) -> None:
    data = json.loads((results / "results.json").read_text())
    assert data["study"] == "ablations" and data["quick"] is True
    assert set(name for name in data["versions"] if name.startswith("run ")) == {"run base"}
    models, controls = {"shipped", "base"}, {"random candidate", "expert"}
    assert {r["method"] for r in data["rows"]} == models | controls | {slots_name(4), slots_name(12)}
    acted = {r["method"] for r in data["rows"] if r["metric"] == "closed_loop_success"}
    assert acted == models | controls
    found = {(r["method"], r["split"], r["variant"], r["metric"]): r["value"] for r in data["rows"]}
    # The same weights give the same figures, and the trained number of slots is that of the shipped model.
    for (method, *rest), value in found.items():
        shipped = ("shipped", *rest)
        assert method != "base" or value == found[shipped]
        assert method != slots_name(12) or value == found.get(shipped, value)
    # With 4 slots, background and arm included, most of 6 objects have none.
    few, enough = (found[slots_name(k), "test", "true frames", "miou"] for k in (4, 12))
    assert few < 0.5 < enough
    assert data["headline"]["shipped_miou"] == round(enough, 4)


def test_the_page_says_what_is_missing_and_how_to_train_it(results: Path) -> None:
    page = (results / "report.html").read_text()
    assert page.count("not trained; train it: ") == 9 and "--only text-minilm" in page
    assert "predictor.layers is 3, wanted 1" in page and "not finished" in page
    assert "; 123 updates" in page


def outcomes(figures: list[dict]) -> list[Row]:
    """Rows of scenes with these figures of `base`."""
    scenes = [
        Outcome(scene, {("base", *names): value for names, value in its.items()})
        for scene, its in zip(study_scenes("controllability", len(figures), 0), figures, strict=True)
    ]
    return figure_rows((one.scene.split, one.figures) for one in scenes)


def test_rows_count_scenes() -> None:
    made = [
        {
            ("original", "predicted_success"): own[0],
            ("variants mean", "predicted_success"): own[1:],
            ("original", "ends_within_6_px"): True,
            ("variants mean", "ends_within_6_px"): [True, True],
            ("wrong text", "ends_within_6_px"): wrong,
            ("9 frames", "psnr"): psnr,
        }
        for own, wrong, psnr in (
            ([True, True, False], [False] * 3, 20.0),
            ([False, True, True], [True, False, False], 21.0),
        )
    ]
    rows = {(row.variant, row.metric): row for row in outcomes(made)}
    assert rows["original", "predicted_success"].value == 0.5
    assert rows["variants mean", "predicted_success"].value == 0.75
    assert rows["original", "ends_within_6_px"].value == rows["variants mean", "ends_within_6_px"].value == 1.0
    assert rows["wrong text", "ends_within_6_px"].value == pytest.approx(1 / 6)
    assert rows["9 frames", "psnr"].value == 20.5
    assert {row.n for row in rows.values()} == {2}
    assert rows["wrong text", "ends_within_6_px"].low > 0  # a rate has Wilson's interval, a mean a bootstrap's
    assert (rows["9 frames", "psnr"].low, rows["9 frames", "psnr"].high) == (20.0, 21.0)


def test_a_scene_is_followed_by_a_model_that_is_always_right_and_by_one_that_never_is() -> None:
    (scene,) = study_scenes("controllability", 1, 0)
    stubborn = LoadOracle((*COLORS,))
    who = (Entrant("right"), Entrant("stubborn", stubborn))
    figures = FollowingScene(scene, who, 3, 0).run(Worker(LoadOracle()())).figures
    for metric in ("predicted_success", "ends_within_6_px"):
        for name, good in (("right", True), ("stubborn", False)):
            assert figures[name, "original", metric] == good
            assert figures[name, "variants mean", metric].tolist() == [good] * 3
    assert figures["right", "wrong text", "ends_within_6_px"].tolist() == [False] * 4
    assert set(FollowingScene(scene, who[:1], 0, 0).run(Worker(LoadOracle()())).figures) == {
        ("right", "original", "predicted_success"),
        ("right", "original", "ends_within_6_px"),
    }


def test_a_scene_is_imagined_with_as_many_slots_as_asked() -> None:
    (scene,) = study_scenes("test", 1, 0)
    who = (Entrant("few", num_slots=3), Entrant("enough", num_slots=12))
    figures = FollowingScene(scene, who, 0, 0).run(Worker(WorldModel.from_pretrained())).figures
    # Background and arm take two of them, so one is left for a block and a bowl.
    reached = {name: bool(figures[name, "original", "ends_within_6_px"]) for name in ("few", "enough")}
    assert reached == {"few": False, "enough": True}


def test_a_table_without_any_figure_is_a_table(tmp_path: Path) -> None:
    table = tables([find_run(run, tmp_path).line for run in PREDICTORS], (), ())[0].table([])
    assert {cell.text for row in table.rows for cell in row.cells} == {"\u2013"}
    assert [row.note.split(";")[0] == "not trained" for row in table.rows] == [False, *[True] * 8, False, False]
