"""Training MAGE: both stages continue exactly, codes are kept, and nothing trains on what does not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.baselines.mage.conftest import TINY
from tests.textocvp.parsers.tiny_dino import DIM, PATCH, write_tiny_dino
from tests.textocvp.toy_episodes import write_toy_episodes
from tests.textocvp.training.runs import same_weights, train, train_killed_after, weights
from textocvp.baselines.mage import MAGE_PRESETS, Mage
from textocvp.baselines.mage.text import PublishedTextConfig
from textocvp.baselines.mage.train_mage import MageTraining, cached_codes
from textocvp.baselines.mage.train_vqvae import VQVAETraining
from textocvp.baselines.mage.vqvae import VQVAE, load_vqvae
from textocvp.checkpoint import CheckpointError
from textocvp.data import open_episodes
from textocvp.data.cache import CacheError
from textocvp.training.run import SettingsError


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Toy episodes; the tiny preset is known by name."""
    write_toy_episodes(tmp_path / "train.h5", [9, 8, 9, 9])
    write_toy_episodes(tmp_path / "val.h5", [9, 8], seed=1)
    monkeypatch.setitem(MAGE_PRESETS, TINY.name, TINY)
    return tmp_path


def vqvae_run(folder: Path, out: str, **changes) -> VQVAETraining:
    settings = dict(preset=TINY.name, steps=4, batch=3, stride=2, warmup=1, restart_every=1) | changes
    return VQVAETraining(folder / "train.h5", folder / "val.h5", folder / out, **settings)


def mage_run(folder: Path, out: str, **changes) -> MageTraining:
    settings = dict(preset=TINY.name, steps=4, batch=3, warmup=1, autoregressive=0.5) | changes
    vqvae = folder / "vqvae" / "checkpoint"
    return MageTraining(folder / "train.h5", folder / "val.h5", folder / out, vqvae=vqvae, **settings)


def test_a_killed_run_of_either_stage_continues_exactly(folder: Path) -> None:
    # Every third step, so that uses are counted across the interruption.
    for run, out in ((vqvae_run, "vqvae"), (mage_run, "mage")):
        changes = {"restart_every": 3} if run is vqvae_run else {}
        straight, resumed = run(folder, out, **changes), run(folder, f"{out}-resumed", **changes)
        train(straight)
        train_killed_after(resumed, 2)
        train(resumed)
        assert same_weights(straight.out, resumed.out)
    # The second stage leaves the VQ-VAE as it was trained.
    trained, found = weights(folder / "vqvae"), weights(folder / "mage")
    assert all(torch.equal(found[f"vqvae.{name}"], tensor) for name, tensor in trained.items())


def test_codes_are_kept_for_the_vqvae_that_made_them(folder: Path) -> None:
    torch.manual_seed(0)
    one, other = VQVAE(TINY.vqvae).eval(), VQVAE(TINY.vqvae).eval()
    with open_episodes(folder / "train.h5") as episodes, open_episodes(folder / "val.h5") as others:
        cache = cached_codes(one, episodes, folder / "codes")
        again = cached_codes(one, episodes, folder / "codes")
        assert np.array_equal(cache.values, again.values) and len(again) == 4
        frames = torch.from_numpy(episodes.frames(1)).permute(0, 3, 1, 2).float() / 127.5 - 1
        assert np.array_equal(again.episode(1), one.encode(frames).numpy())
        for made_from, vqvae, data in (("network", other, episodes), ("episodes", one, others)):
            with pytest.raises(CacheError, match=f"other {made_from}"):
                cached_codes(vqvae, data, folder / "codes")
        part = folder / "codes" / "000000.h5"
        part.unlink()  # HDF5 would go on with the file that it has open
        part.write_bytes(b"no HDF5")
        with pytest.raises(CacheError, match="damaged"):
            cached_codes(one, episodes, folder / "codes")


def test_what_does_not_fit_is_refused_by_name(folder: Path) -> None:
    train(vqvae_run(folder, "vqvae", steps=1))
    with pytest.raises(SettingsError, match="comes trained"):
        train(mage_run(folder, "mage", set=("vqvae.channels=4",)))
    with pytest.raises(SettingsError, match="32 pixels"):
        train(vqvae_run(folder, "big", set=("vqvae.image_size=64",)))
    with pytest.raises(SettingsError, match="dinov2"):
        train(vqvae_run(folder, "cached", cache_features=True))
    with pytest.raises(CheckpointError, match="'mage-vqvae' model"):
        Mage.load(folder / "vqvae" / "checkpoint")


@pytest.mark.parametrize("published", [False, True])
def test_words_come_from_the_episodes_and_stand_in_the_checkpoint(folder: Path, published: bool) -> None:
    if published:
        text = PublishedTextConfig(dim=24, layers=1, heads=2, hidden=24, vocabulary=("put", "stack"))
        MAGE_PRESETS[TINY.name] = replace(TINY, text=text)  # the fixture puts the old one back
    train(vqvae_run(folder, "vqvae", steps=1))
    train(mage_run(folder, "mage", steps=1))
    text = Mage.load(folder / "mage" / "checkpoint").text
    assert text.unknown_words("put the red block in the blue bowl") == []
    assert text.unknown_words("put the red cube onto it") == ["cube", "onto", "it"]
    untrained = "stack" if published else "move"  # in the preset's vocabulary, in no caption
    assert text.unknown_words(f"{untrained} the block") == [untrained]


def test_mage_dino_trains_from_its_features_and_keeps_them_frozen(folder: Path) -> None:
    dino = dict(encoder="dinov2", channels=32, encoder_dim=DIM, encoder_patch=PATCH)
    vqvae = replace(TINY.vqvae, encoder_weights=str(write_tiny_dino(folder / "dino")), **dino)
    MAGE_PRESETS[TINY.name] = replace(TINY, vqvae=vqvae)  # the fixture puts the old one back
    train(vqvae_run(folder, "vqvae", steps=2, cache_features=True))
    train(vqvae_run(folder, "plain", steps=2))
    found = weights(folder / "vqvae")
    for name, tensor in weights(folder / "plain").items():
        torch.testing.assert_close(found[name], tensor, atol=2e-2, rtol=0)  # the cache has half the digits
    assert not any("dino" in name for name in found)
    model = load_vqvae(folder / "vqvae" / "checkpoint")
    assert model.config.encoder_fingerprint and model.config.grid == 32 // PATCH
    train(mage_run(folder, "mage", steps=2))
    other = write_tiny_dino(folder / "other", seed=1)
    moved = VQVAE(replace(model.config, encoder_weights=str(other)))
    with pytest.raises(ValueError, match=r"vqvae\.encoder_fingerprint"):
        moved.encode(torch.zeros(1, 3, 32, 32))
