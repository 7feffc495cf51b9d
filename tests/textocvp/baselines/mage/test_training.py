"""Training MAGE: both stages continue exactly, codes are kept, and nothing trains on what does not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.textocvp.baselines.mage.conftest import TINY
from tests.textocvp.tiny_dino import DIM, PATCH, write_tiny_dino
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.baselines.mage import MAGE_PRESETS, Mage, train_mage, train_vqvae
from textocvp.baselines.mage.train_mage import MageTraining, cached_codes
from textocvp.baselines.mage.train_vqvae import VQVAETraining
from textocvp.baselines.mage.vqvae import VQVAE, load_vqvae
from textocvp.checkpoint import CheckpointError
from textocvp.data.cache import CacheError
from textocvp.data.episodes import open_episodes
from textocvp.training import run as training
from textocvp.training.run import SettingsError


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Toy episodes; the tiny preset is known by name."""
    write_toy_episodes(tmp_path / "train.h5", [9, 8, 9, 9])
    write_toy_episodes(tmp_path / "val.h5", [9, 8], seed=1)
    monkeypatch.setitem(MAGE_PRESETS, TINY.name, TINY)
    return tmp_path


def first_stage(folder: Path, out: str, **changes) -> VQVAETraining:
    settings = dict(preset=TINY.name, steps=4, batch=3, stride=2, warmup=1, restart_every=1) | changes
    return VQVAETraining(folder / "train.h5", folder / "val.h5", folder / out, **settings)


def second_stage(folder: Path, out: str, **changes) -> MageTraining:
    settings = dict(preset=TINY.name, steps=4, batch=3, warmup=1, autoregressive=0.5) | changes
    vqvae = folder / "vqvae" / "checkpoint"
    return MageTraining(folder / "train.h5", folder / "val.h5", folder / out, vqvae=vqvae, **settings)


def stopped_after_two(train, args, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train until the state of two steps is saved, as if killed then."""
    save = training.save_state

    def killed(accelerator, out, next_step):
        save(accelerator, out, next_step)
        if next_step == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training, "save_state", killed)
        with pytest.raises(KeyboardInterrupt):
            train(args)


def test_a_killed_run_of_either_stage_continues_exactly(folder: Path, monkeypatch) -> None:
    train_vqvae.train(first_stage(folder, "vqvae"))
    resumed = first_stage(folder, "vqvae-resumed", save_minutes=0.0, restart_every=3)
    # Every third step, so that uses are counted across the interruption.
    straight = first_stage(folder, "vqvae-straight", restart_every=3)
    train_vqvae.train(straight)
    stopped_after_two(train_vqvae.train, resumed, monkeypatch)
    train_vqvae.train(resumed)
    same_weights(straight.out, resumed.out)

    straight2 = second_stage(folder, "mage-straight")
    resumed2 = second_stage(folder, "mage-resumed", save_minutes=0.0)
    train_mage.train(straight2)
    stopped_after_two(train_mage.train, resumed2, monkeypatch)
    train_mage.train(resumed2)
    same_weights(straight2.out, resumed2.out)
    # The second stage leaves the VQ-VAE as it was trained, and moves all the rest.
    model, vqvae = Mage.load(straight2.out / "checkpoint"), load_vqvae(folder / "vqvae" / "checkpoint")
    for name, tensor in vqvae.state_dict().items():
        assert torch.equal(model.vqvae.state_dict()[name], tensor)


def same_weights(one: Path, other: Path) -> None:
    a, b = (load_file(out / "checkpoint" / "model.safetensors") for out in (one, other))
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


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
    train_vqvae.train(first_stage(folder, "vqvae", steps=1))
    with pytest.raises(SettingsError, match="comes trained"):
        train_mage.train(second_stage(folder, "mage", set=("vqvae.channels=4",)))
    with pytest.raises(SettingsError, match="32 pixels"):
        train_vqvae.train(first_stage(folder, "big", set=("vqvae.image_size=64",)))
    with pytest.raises(SettingsError, match="dinov2"):
        train_vqvae.train(first_stage(folder, "cached", cache_features=True))
    with pytest.raises(CheckpointError, match="'mage-vqvae' model"):
        Mage.load(folder / "vqvae" / "checkpoint")


def test_mage_dino_trains_from_its_features_and_keeps_them_frozen(folder: Path) -> None:
    weights = write_tiny_dino(folder / "dino")
    vqvae = replace(
        TINY.vqvae,
        encoder="dinov2",
        channels=32,
        encoder_weights=str(weights),
        encoder_dim=DIM,
        encoder_patch=PATCH,
    )
    MAGE_PRESETS[TINY.name] = replace(TINY, vqvae=vqvae)  # the fixture puts the old one back
    cached = first_stage(folder, "vqvae", steps=2, cache_features=True)
    train_vqvae.train(cached)
    train_vqvae.train(first_stage(folder, "plain", steps=2))
    found = load_file(cached.out / "checkpoint" / "model.safetensors")
    for name, tensor in load_file(folder / "plain" / "checkpoint" / "model.safetensors").items():
        torch.testing.assert_close(found[name], tensor, atol=2e-2, rtol=0)  # the cache has half the digits
    assert not any("dino" in name for name in found)
    model = load_vqvae(cached.out / "checkpoint")
    assert model.config.encoder_fingerprint and model.config.grid == 32 // PATCH
    train_mage.train(second_stage(folder, "mage", steps=2))
    other = write_tiny_dino(folder / "other", seed=1)
    moved = VQVAE(replace(model.config, encoder_weights=str(other)))
    with pytest.raises(ValueError, match=r"vqvae\.encoder_fingerprint"):
        moved.encode(torch.zeros(1, 3, 32, 32))
