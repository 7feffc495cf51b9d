"""The ablation study: runs that are there, runs that are not, and more or fewer slots at test time."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import textocvp
from experiments.ablations import Args, Sizes, look, main
from experiments.protocol.ablation_report import predictor_plot, predictor_table
from experiments.protocol.ablation_rows import following_rows, parsing_rows, slots_name
from experiments.protocol.ablation_runs import find_run, run_named
from experiments.protocol.ablation_scenes import (
    Followed,
    FollowingOutcome,
    Parsed,
    ParsingOutcome,
)
from experiments.protocol.scenes import test_scenes

SHIPPED = Path(textocvp.__file__).parent / "checkpoints" / "tabletop-small"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`base` is there, `layers-1` was trained with other settings, `layers-2` stopped half-way."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("base", "layers-1"):
        shutil.copytree(SHIPPED, folder / name / "checkpoint")
        (folder / name / "following.json").write_text("{}")
    for name in ("base", "layers-2"):
        (folder / name / "state").mkdir(parents=True)
    (folder / "base" / "state" / "step.json").write_text('{"next_step": 123}')
    return folder


@pytest.fixture(scope="module")
def results(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    args = Args(out=out, runs=runs, quick=True, workers=1)
    main(args, sizes=Sizes(following=2, unseen=1, acted=1, parsing=1, slots=1, clips=1), slot_counts=(4, 12))
    return out


def test_what_there_is_of_every_run(runs: Path) -> None:
    found, hashes = look(runs)
    states = {one.run.name: one.state for one in found}
    assert states.pop("base") == "trained" and find_run(run_named("base"), runs).updates == 123
    assert states.pop("layers-1") == "other settings"
    assert states.pop("layers-2") == "unfinished"
    assert set(states.values()) == {"missing"}
    assert list(hashes) == ["base"] and len(hashes["base"]) == 16


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
    assert page.count("not trained") >= 4 and "--only text-minilm" in page
    assert "predictor.layers is 3, wanted 1" in page and "not finished" in page
    assert "of 123 updates" in page
    assert (results / "plots" / "following.png").is_file() and (results / "plots" / "slots.png").is_file()


def test_rows_count_scenes() -> None:
    scenes = test_scenes("controllability", 2, 0)
    outcomes = [
        FollowingOutcome(
            scene,
            (),
            {"base": Followed(np.array(own), np.array(own) | True, np.array(wrong), {"psnr": 20.0 + i})},
        )
        for i, (scene, own, wrong) in enumerate(
            zip(
                scenes,
                ([True, True, False], [False, True, True]),
                ([False] * 3, [True, False, False]),
                strict=True,
            )
        )
    ]
    rows = {(row.variant, row.metric): row for row in following_rows(outcomes)}
    assert rows["original", "predicted_success"].value == 0.5
    assert rows["variants mean", "predicted_success"].value == 0.75
    assert (
        rows["original", "ends_within_6_px"].value == rows["variants mean", "ends_within_6_px"].value == 1.0
    )
    assert rows["wrong text", "ends_within_6_px"].value == pytest.approx(1 / 6)
    assert rows["9 frames", "psnr"].value == 20.5
    assert {row.n for row in rows.values()} == {2}
    parsed = [ParsingOutcome(scene, {"savi-cluster": Parsed(0.5, 0.4, 0.3, 20.0)}) for scene in scenes]
    assert {row.metric: row.value for row in parsing_rows(parsed)} == {
        "miou": 0.5,
        "kept": 0.4,
        "ari": 0.3,
        "psnr": 20,
    }


def test_the_plot_shows_the_columns_that_it_names(runs: Path) -> None:
    found, _ = look(runs)
    outcomes = [
        FollowingOutcome(
            scene, (), {"base": Followed(np.zeros(2, bool), np.ones(2, bool), np.zeros(2, bool), {})}
        )
        for scene in test_scenes("controllability", 2, 0)
    ]
    (figure,) = predictor_plot(following_rows(outcomes), found)
    assert "original: base 1.00" in figure.alt and "three other bowls: base 1.00" in figure.alt


def test_a_table_without_any_figure_is_a_table(tmp_path: Path) -> None:
    found, _ = look(tmp_path)
    table = predictor_table([], found, "text")
    assert [row.cells[0].text for row in table.rows] == ["\u2013", *["not trained"] * 4, "\u2013", "\u2013"]
