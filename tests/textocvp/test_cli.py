"""The command line as a person meets it: help that teaches, files that appear, mistakes in one line."""

from __future__ import annotations

import errno
import gc
import json
import runpy
import sys
from importlib.resources import files
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from tests.textocvp.conftest import PLACED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import cli

TEXT = "put the red block in the blue bowl"


@pytest.fixture
def checkpoint(tmp_path: Path) -> str:
    build(PLACED).save_pretrained(tmp_path / "checkpoint")
    return str(tmp_path / "checkpoint")


@pytest.fixture
def picture(tmp_path: Path, scene: np.ndarray) -> str:
    iio.imwrite(tmp_path / "scene.png", scene)
    return str(tmp_path / "scene.png")


def says(capsys: pytest.CaptureFixture[str], arguments: list[str], status: int) -> str:
    """What a failing command prints; nothing of it may be a traceback."""
    assert cli.main(arguments) == status
    message = capsys.readouterr().err
    assert message.startswith("textocvp: ") and "Traceback" not in message
    return message


def test_a_picture_and_a_text_become_a_film(capsys, tmp_path, checkpoint, picture) -> None:
    out = tmp_path / "imagined.gif"
    arguments = ["rollout", picture, TEXT, "put the blue block in the red bowl", "--checkpoint", checkpoint]
    assert cli.main([*arguments, "--horizon", "3", "--out", str(out)]) == 0
    assert len(list(iio.imiter(out))) == 4
    printed = capsys.readouterr()
    assert "B=2 sequences, T=4 frames" in printed.out and str(out) in printed.out and not printed.err


def test_another_picture_size_is_refused_or_resized(capsys, tmp_path, checkpoint, picture, scene) -> None:
    iio.imwrite(tmp_path / "large.png", scene.repeat(2, axis=0).repeat(2, axis=1))
    arguments = ["rollout", str(tmp_path / "large.png"), TEXT, "--checkpoint", checkpoint, "--horizon", "2"]
    iio.imwrite(tmp_path / "odd.png", scene.repeat(3, axis=0).repeat(3, axis=1)[::2, ::2])
    refused = ["rollout", str(tmp_path / "odd.png"), *arguments[2:], "--out", str(tmp_path / "no.png")]
    message = says(capsys, refused, 1)
    assert "48x48" in message and "32x32" in message and "--resize" in message
    assert cli.main([*arguments, "--resize", "--out", str(tmp_path / "large-out.png")]) == 0
    assert cli.main(["rollout", picture, *arguments[2:], "--out", str(tmp_path / "same.png")]) == 0
    assert np.array_equal(iio.imread(tmp_path / "large-out.png"), iio.imread(tmp_path / "same.png"))


def test_words_without_quotes_are_one_sentence(capsys, tmp_path, checkpoint, picture) -> None:
    rest = ["--checkpoint", checkpoint, "--horizon", "1", "--out"]
    assert cli.main(["rollout", picture, *TEXT.split(), *rest, str(tmp_path / "words.png")]) == 0
    printed = capsys.readouterr()
    assert "B=1 sequences" in printed.out and repr(TEXT) in printed.err and "need quotes" in printed.err
    assert cli.main(["rollout", picture, TEXT, *rest, str(tmp_path / "quoted.png")]) == 0
    assert "read as" not in capsys.readouterr().out
    assert (tmp_path / "words.png").read_bytes() == (tmp_path / "quoted.png").read_bytes()


def test_what_was_done_to_picture_and_words_is_said(capsys, tmp_path, checkpoint, scene) -> None:
    wide = np.concatenate([np.full((32, 16, 3), 47, np.uint8), scene, np.full((32, 16, 3), 47, np.uint8)], axis=1)
    iio.imwrite(tmp_path / "wide.png", wide)
    iio.imwrite(tmp_path / "scene.png", scene)
    arguments = [TEXT.upper(), "--checkpoint", checkpoint, "--horizon", "1", "--out"]
    wide_out, out = str(tmp_path / "a.png"), str(tmp_path / "b.png")
    assert "or --crop" in says(capsys, ["rollout", str(tmp_path / "wide.png"), *arguments, wide_out], 1)
    assert cli.main(["rollout", str(tmp_path / "wide.png"), *arguments, wide_out, "--crop"]) == 0
    printed = capsys.readouterr().out
    assert "wide.png: cut off its edges and brought it from 64x32 to 32x32 pixels" in printed
    assert f"{TEXT.upper()!r} is read as {TEXT!r}" in printed
    assert cli.main(["rollout", str(tmp_path / "scene.png"), *arguments, out]) == 0
    assert Path(wide_out).read_bytes() == Path(out).read_bytes()


def test_unknown_words_are_a_warning_line(capsys, tmp_path, checkpoint, picture) -> None:
    arguments = ["rollout", picture, "put the flurb block in the bowl", "--checkpoint", checkpoint]
    assert cli.main([*arguments, "--horizon", "1", "--out", str(tmp_path / "a.png")]) == 0
    assert capsys.readouterr().err.startswith("textocvp: warning: the text encoder has never met 'flurb'")


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"picture": "nowhere.png"}, "no picture nowhere.png"),
        ({"picture": __file__}, "no picture that can be read"),
        ({"text": " "}, "empty text"),
        ({"text": "do not put the red block in the blue bowl"}, "says 'not'"),
        ({"horizon": "0"}, "at least 1"),
        ({"horizon": "99"}, "at most 8"),
        ({"out": "film.webm"}, ".gif, .mp4, .png"),
        ({"checkpoint": "tabletop-smal"}, "unknown checkpoint 'tabletop-smal'"),
    ],
)
def test_mistakes_are_one_line(capsys, tmp_path, checkpoint, picture, changes, part) -> None:
    given = {"picture": picture, "text": TEXT, "horizon": "2", "out": str(tmp_path / "a.gif"), "checkpoint": checkpoint}
    given.update(changes)
    arguments = ["rollout", given["picture"], given["text"], "--horizon", given["horizon"]]
    assert part in says(capsys, [*arguments, "--out", given["out"], "--checkpoint", given["checkpoint"]], 1)
    assert not (tmp_path / "a.gif").exists()


def test_a_huge_picture_is_one_line(capsys, tmp_path, checkpoint, monkeypatch) -> None:
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", 100)  # of twice as many PIL thinks that they are an attack
    iio.imwrite(tmp_path / "huge.png", np.zeros((32, 32, 3), np.uint8))
    arguments = ["rollout", str(tmp_path / "huge.png"), TEXT, "--out", str(tmp_path / "a.gif")]
    assert "no picture that can be read: Image size" in says(capsys, [*arguments, "--checkpoint", checkpoint], 1)


def test_a_film_that_finds_no_room_is_one_line(capfd, tmp_path, checkpoint, picture, monkeypatch) -> None:
    """The library that packs it must not try again, and fail again, when it is cleaned up."""
    write = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        write(path, data[:100])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    out = tmp_path / "a.gif"
    assert cli.main(["rollout", picture, TEXT, "--horizon", "2", "--out", str(out), "--checkpoint", checkpoint]) == 1
    gc.collect()
    err = capfd.readouterr().err
    assert f"No space left on device: '{out}'" in err and "Traceback" not in err
    assert sorted(one.name for one in tmp_path.iterdir()) == ["checkpoint", "scene.png"]


def test_info_describes_a_checkpoint(capsys, checkpoint) -> None:
    assert cli.main(["info", checkpoint]) == 0
    printed = capsys.readouterr().out
    for part in ("PlacedParser", "Predictor", "GlimpseRenderer", "32x32", "window = 8", "sha256"):
        assert part in printed


def test_models_says_of_every_preset_what_it_is(capsys) -> None:
    assert cli.main(["models"]) == 0
    printed = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.strip("│").split("│")] for line in printed.splitlines()]
    for entry in cli.list_models():
        counts = ["-" if n is None else f"{n:,}" for n in (entry.parameters, entry.predictor)]
        assert [entry.name, entry.what, *counts, entry.state, entry.weights] in rows


def test_info_about_a_damaged_checkpoint_names_the_file(capsys, checkpoint) -> None:
    (Path(checkpoint) / "model.safetensors").write_bytes(b"no")
    assert "model.safetensors is damaged" in says(capsys, ["info", checkpoint], 1)


def test_training_says_what_is_missing_before_it_makes_anything(capsys, tmp_path) -> None:
    out, nowhere = tmp_path / "run", str(tmp_path / "none.h5")
    files = ["--data", nowhere, "--val", nowhere, "--out", str(out)]
    assert "envs.collect" in says(capsys, ["train", "parser", *files], 1)
    assert "savi-cater" in says(capsys, ["train", "parser", *files, "--preset", "huge"], 1)
    assert nowhere in says(capsys, ["train", "predictor", "--parser", nowhere, *files], 1)
    (tmp_path / "none.h5").write_text("not HDF5")
    assert "none.h5" in says(capsys, ["train", "parser", *files], 1)
    assert not out.exists()


def test_settings_given_twice_are_not_half_forgotten(capsys, tmp_path) -> None:
    paths = ["--data", str(tmp_path / "a.h5"), "--val", str(tmp_path / "b.h5"), "--out", str(tmp_path / "run")]
    both = ["--set", "predictor.layers=2", "--set=predictor.window=30"]
    said = says(capsys, ["train", "predictor", "--parser", "tabletop-small", *both, *paths], 1)
    assert "textocvp: give --set once, with all settings after it" in said
    assert not (tmp_path / "run").exists()


def test_the_parser_of_stage_two_is_found_by_its_bundled_name(capsys, tmp_path) -> None:
    write_toy_episodes(tmp_path / "toy.h5", [4, 4])
    data = str(tmp_path / "toy.h5")
    files = ["--data", data, "--val", data, "--out", str(tmp_path / "out")]
    message = says(capsys, ["train", "predictor", "--parser", "tabletop-small", *files], 1)
    assert "frames of 32 pixels, parser.image_size is 64" in message  # it knows the checkpoint's parser
    message = says(capsys, ["train", "predictor", "--parser", "tabletop-smal", *files], 1)
    assert "unknown checkpoint 'tabletop-smal'. Bundled checkpoints: " in message


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--help"], ["train", "rollout", "models", "info"]),
        (["rollout", "--help"], ["put the red block in the blue bowl", "--resize", "--horizon"]),
        (["train", "--help"], ["parser", "predictor", "TensorBoard"]),
        (["train", "parser", "--help"], ["--data", "envs.collect"]),
        (["train", "predictor", "--help"], ["--parser", "--horizon"]),
    ],
)
def test_help_teaches(capsys, arguments, parts) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert all(part in printed for part in parts)


def test_figures_of_own_frames_are_added_and_nothing_else_changes(capsys, tmp_path, checkpoint) -> None:
    folder, val = Path(checkpoint), write_toy_episodes(tmp_path / "val.h5", [4, 5, 4])
    before, weights = (json.loads((folder / "config.json").read_text()), (folder / "model.safetensors").read_bytes())
    assert cli.main(["measure", checkpoint, "--val", str(val)]) == 0
    after = json.loads((folder / "config.json").read_text())
    assert after["own_frames"]["count"] == 3 and str(folder / "config.json") in capsys.readouterr().out
    assert {**after, "own_frames": None} == before and list(after) == list(before)
    assert (folder / "model.safetensors").read_bytes() == weights
    message = says(capsys, ["measure", "tabletop-small", "--val", str(val)], 1)
    assert "no folder tabletop-small" in message
    message = says(capsys, ["measure", checkpoint, "--val", str(tmp_path / "none.h5")], 1)
    assert "envs.collect" in message
    bundled = str(files("textocvp") / "checkpoints" / "tabletop-small")
    message = says(capsys, ["measure", bundled, "--val", str(val)], 1)
    assert "frames of 32 pixels, the model takes 64" in message


def test_wrong_options_exit_with_two(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["rollout", "--colour", "red"])
    assert stop.value.code == 2


def test_the_module_runs_as_a_program(capsys, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["textocvp", "info", str(tmp_path)])
    monkeypatch.delitem(sys.modules, "textocvp.cli")
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("textocvp.cli", run_name="__main__", alter_sys=True)
    assert stop.value.code == 1
    message = capsys.readouterr().err
    assert "config.json" in message and "Traceback" not in message
