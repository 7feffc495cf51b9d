"""All runs of the ablation study from one command: shared slots, finished runs skipped, failures told."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import tyro

import experiments.train_ablations as training
from experiments.study.ablation_runs import PARSERS, PREDICTORS, RUNS, AblationRun, differences, find_run
from experiments.train_ablations import Args, main, run_named
from tests.textocvp.conftest import PLACED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.checkpoint import read_config
from textocvp.presets import PRESETS


def tiny(key: str, label: str, *settings: str, stage: str = "predictor") -> AblationRun:
    return AblationRun(key=key, label=label, stage=stage, preset="tiny-placed", settings=settings)


TINY = (
    tiny("base", "as it is"),
    tiny("broken", "cannot be built", *("text.kind=transformer",) * 2),
    tiny("layers-1", "1 layer", "predictor.layers=1"),
    tiny("parser", "parser", stage="parser"),
)


def test_every_run_is_a_model_of_its_own() -> None:
    assert len({run.key for run in RUNS}) == len(RUNS)
    assert {run.stage for run in PREDICTORS} == {"predictor"}
    assert {run.stage for run in PARSERS} == {"parser"}
    for runs in (PREDICTORS, PARSERS):
        for run in runs:
            for other in runs:
                assert bool(differences(run, other.config)) == (run is not other), (run.key, other.key)


def test_differences_are_named() -> None:
    assert differences(run_named("layers-1"), run_named("base").config) == ["predictor.layers is 3, wanted 1"]
    with pytest.raises(ValueError, match=r"unknown run 'layer-1'; known: base, layers-1"):
        run_named("layer-1")


def test_where_pretrained_weights_came_from_is_no_difference() -> None:
    run = run_named("text-minilm")
    found = replace(run.config, text=replace(run.config.text, fingerprint="ab12", weights="somewhere"))
    assert differences(run, found) == []


@pytest.fixture
def args(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Args:
    monkeypatch.setitem(PRESETS, "tiny-placed", PLACED)
    monkeypatch.setattr(training, "RUNS", TINY)
    monkeypatch.setattr(training, "run_named", {run.key: run for run in TINY}.__getitem__)
    build(PLACED).save_pretrained(tmp_path / "shipped")
    write_toy_episodes(tmp_path / "train.h5", [9, 8, 9, 9])
    write_toy_episodes(tmp_path / "val.h5", [9, 9], seed=1)
    data = {"data": tmp_path / "train.h5", "val": tmp_path / "val.h5", "out": tmp_path / "runs"}
    return Args(parser=str(tmp_path / "shipped"), steps=2, parser_steps=1, **data)


def test_one_command_trains_all_and_tells_what_failed(args: Args, capsys: pytest.CaptureFixture) -> None:
    assert main(args) == 1  # `broken`: the colour bias needs the lexicon
    states = {run.key: find_run(run, args.out).state for run in TINY}
    assert states == {"base": "trained", "broken": "not trained", "layers-1": "trained", "parser": "trained"}
    assert "broken failed" in capsys.readouterr().out
    assert read_config(args.out / "layers-1" / "checkpoint").predictor.layers == 1
    assert find_run(TINY[0], args.out).updates == 2
    # The slots were parsed once: every predictor run has the same file, not a copy.
    slots = [args.out / folder / "slots-train" / "000000.h5" for folder in ("slots", "base", "layers-1")]
    assert len({os.stat(path).st_ino for path in slots}) == 1
    assert json.loads((args.out / "parser" / "quality.json").read_text())["object_miou"]["n"] == 2


def test_finished_runs_are_skipped(args: Args, capsys: pytest.CaptureFixture) -> None:
    args.only = ("base",)
    assert main(args) == 0
    before = (args.out / "base" / "checkpoint" / "model.safetensors").stat().st_mtime_ns
    capsys.readouterr()
    assert main(args) == 0
    assert "trained already" in capsys.readouterr().out
    assert (args.out / "base" / "checkpoint" / "model.safetensors").stat().st_mtime_ns == before


def test_a_run_with_other_settings_is_not_taken_for_this_one(args: Args, capsys: pytest.CaptureFixture) -> None:
    args.only = ("base",)
    main(args)
    (args.out / "base").rename(args.out / "layers-1")
    args.only = ("layers-1",)
    assert main(args) == 1
    assert "predictor.layers is 2, wanted 1" in capsys.readouterr().out


def test_several_runs_can_be_named() -> None:
    assert tyro.cli(Args, args=["--only", "base", "--only", "layers-1"]).only == ("base", "layers-1")


def test_nothing_is_trained_when_only_asked(args: Args, capsys: pytest.CaptureFixture) -> None:
    args.list = True
    assert main(args) == 0
    assert capsys.readouterr().out.count("not trained") == len(TINY)
    assert not args.out.exists()
