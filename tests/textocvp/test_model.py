"""Checkpoints: what is saved comes back, and what does not fit is refused with its name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.textocvp.conftest import PLACED, build
from textocvp.checkpoint import CheckpointError, read_config
from textocvp.config import ModelConfig
from textocvp.model import TextOCVP


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A good checkpoint of the tiny shipped family."""
    build(PLACED).save_pretrained(tmp_path / "checkpoint")
    return tmp_path / "checkpoint"


def test_a_saved_model_comes_back_bit_by_bit(model: TextOCVP, config: ModelConfig, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path)
    assert {"config.json", "model.safetensors"} <= {path.name for path in tmp_path.iterdir()}
    loaded = TextOCVP.from_pretrained(tmp_path)
    assert loaded.config == config and not loaded.training
    before, after = model.state_dict(), loaded.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_the_files_hold_no_pickle(folder: Path) -> None:
    assert sorted(path.suffix for path in folder.iterdir()) == [".json", ".md", ".safetensors"]
    assert json.loads((folder / "config.json").read_text())["name"] == "tiny-placed"


def change_config(folder: Path, **changes: object) -> None:
    path = folder / "config.json"
    data = json.loads(path.read_text())
    data.update(changes)
    path.write_text(json.dumps(data))


def test_an_unknown_config_field_is_named(folder: Path) -> None:
    data = json.loads((folder / "config.json").read_text())
    change_config(folder, predictor={**data["predictor"], "depth": 3})
    with pytest.raises(CheckpointError, match=r"config\.json.*config\.predictor.*'depth'.*known: .*layers"):
        TextOCVP.from_pretrained(folder)


def test_an_impossible_config_value_is_named(folder: Path) -> None:
    data = json.loads((folder / "config.json").read_text())
    change_config(folder, renderer={**data["renderer"], "kind": "holographic"})
    with pytest.raises(CheckpointError, match=r"config\.json.*'holographic'.*broadcast, glimpse"):
        TextOCVP.from_pretrained(folder)


@pytest.mark.parametrize("text", ["{", "[1, 2]", "", "\x00"])
def test_a_damaged_config_is_an_error_about_that_file(folder: Path, text: str) -> None:
    (folder / "config.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"config\.json is damaged"):
        read_config(folder)


@pytest.mark.parametrize("keep", [0, 4, 100, 0.5, 0.999])
def test_truncated_weights_are_an_error_about_that_file(folder: Path, keep: float) -> None:
    path = folder / "model.safetensors"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep if keep > 1 or keep == 0 else keep * len(data))])
    with pytest.raises(CheckpointError, match=r"model\.safetensors is damaged"):
        TextOCVP.from_pretrained(folder)


def change_tensors(folder: Path, name: str, tensor: torch.Tensor | None) -> None:
    path = folder / "model.safetensors"
    tensors = load_file(path)
    if tensor is None:
        del tensors[name]
    else:
        tensors[name] = tensor
    save_file(tensors, path)


def test_missing_additional_and_misshapen_tensors_are_named(folder: Path) -> None:
    name = "renderer.decoder.0.weight"
    shape = load_file(folder / "model.safetensors")[name].shape
    change_tensors(folder, name, torch.zeros(shape[0] + 1, shape[1]))
    with pytest.raises(CheckpointError, match=rf"{name}.*\({shape[0] + 1}, .*model's is \({shape[0]}, "):
        TextOCVP.from_pretrained(folder)
    change_tensors(folder, name, torch.zeros(shape, dtype=torch.int64))
    with pytest.raises(CheckpointError, match=rf"{name}.*int64.*float32"):
        TextOCVP.from_pretrained(folder)
    change_tensors(folder, name, None)
    with pytest.raises(CheckpointError, match=rf"lacks tensor '{name}'"):
        TextOCVP.from_pretrained(folder)
    change_tensors(folder, name, torch.zeros(shape))
    change_tensors(folder, "surprise", torch.zeros(2))
    with pytest.raises(CheckpointError, match="does not: tensor 'surprise'"):
        TextOCVP.from_pretrained(folder)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(CheckpointError, match=rf"no checkpoint.*{name.replace('.', '[.]')}"):
        TextOCVP.from_pretrained(folder)


def test_half_precision_weights_are_accepted(folder: Path) -> None:
    path = folder / "model.safetensors"
    save_file({name: t.half() if t.is_floating_point() else t for name, t in load_file(path).items()}, path)
    model = TextOCVP.from_pretrained(folder)
    assert all(p.dtype == torch.float32 for p in model.parameters())
