"""The list of models: complete, counted on the models themselves, and true about what is in the package."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.textocvp.conftest import PLACED
from textocvp import cli
from textocvp.baselines.mage import MAGE_PRESETS, Mage
from textocvp.cli import ListedModel, list_models
from textocvp.model import TextOCVP
from textocvp.presets import PRESETS
from textocvp.world_model import bundled_checkpoints


def entries() -> dict[str, ListedModel]:
    found = {entry.name: entry for entry in list_models()}
    assert len(found) == len(list_models())
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
        if model.predictor.hears_text:  # else nothing trains it
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


def test_a_second_stage_alone_is_said_to_be_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "bundled_checkpoints", lambda: [])
    monkeypatch.setitem(PRESETS, PLACED.name, PLACED)
    found = entries()
    assert "train parser" not in found["ocvp-seq-small"].weights
    assert found[PLACED.name].weights == f"textocvp train parser --preset {PLACED.name}, then train predictor"
