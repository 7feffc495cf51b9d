"""TextOCVP-DINO: its published sizes, both stages end to end on a tiny one, and what gradients may touch."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from torch import Tensor

from tests.textocvp.conftest import SMALL_TEXT
from tests.textocvp.parsers.tiny_dino import DIM, PATCH, write_tiny_dino
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import cli
from textocvp.checkpoint import CheckpointError
from textocvp.config import ModelConfig, with_settings
from textocvp.data.cache import CacheError
from textocvp.data.episodes import EpisodeFile
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.parsers.dino import DinoEncoder
from textocvp.parsers.savi import SaviConfig, SaviParser
from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.presets import PRESETS, preset
from textocvp.pretrained import WeightsError
from textocvp.renderers.patches import FeatureConfig
from textocvp.slots import SlotLayout
from textocvp.training import parser as train_parser
from textocvp.training import predictor as train_predictor
from textocvp.training.losses import thing_weights
from textocvp.training.parser import ParserStage, ParserTraining
from textocvp.training.predictor import PredictorTraining
from textocvp.training.run import SettingsError
from textocvp.world_model import WorldModel

TINY = ModelConfig(
    name="tiny-dino",
    parser=SaviConfig(
        image_size=32,
        num_slots=4,
        layout=SlotLayout(content=12, explicit=False),
        initializer="gaussian",
        encoder="dinov2",
        encoder_dim=DIM,
        encoder_patch=PATCH,
        iterations_first=2,
        transition_hidden=16,
    ),
    renderer=FeatureConfig(patches=8, layers=3, hidden=16, feature_dim=DIM, image_channels=32),
    text=SMALL_TEXT,
    predictor=TextOCVPConfig(dim=16, layers=2, heads=2, hidden=16, attention="window", window=4),
)
ORDER = torch.tensor([2, 0, 3, 1])


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_dino(tmp_path_factory.mktemp("weights") / "dino")


def build(weights: Path, *settings: str) -> TextOCVP:
    torch.manual_seed(0)
    return TextOCVP(with_settings(TINY, [f"parser.encoder_weights={weights}", *settings]))


def frames(clips: int = 2, length: int = 3) -> Tensor:
    return torch.rand(clips, length, 3, 32, 32, generator=torch.Generator().manual_seed(7)) * 2 - 1


@pytest.mark.parametrize(("image_decoder", "decoder"), [("cnn", 13_276_419), ("vqgan", 24_645_443)])
def test_the_preset_has_the_papers_sizes(image_decoder: str, decoder: int) -> None:
    config = with_settings(preset("cliport-dino"), [f"renderer.image_decoder={image_decoder}"])
    with torch.device("meta"):
        model = TextOCVP(config)
        drawn = model.renderer(torch.empty(1, 10, 128))
    count = {name: sum(p.numel() for p in part.parameters()) for name, part in model.named_children()}
    assert count["predictor"] == 33_761_408
    # MLP: 128 + 18 codes -> 1024 -> 1024 -> 1024 -> 768 + 1.
    mlp = (128 + 18 + 1) * 1024 + 2 * (1024 + 1) * 1024 + (1024 + 1) * 769
    assert count["renderer"] == decoder + mlp
    assert drawn.features_BLF is not None and drawn.features_BLF.shape == (1, 576, 768)
    assert drawn.frames_B3HW.shape == (1, 3, 336, 336) and drawn.masks_BKHW.shape == (1, 10, 336, 336)
    assert (config.parser.num_slots, config.parser.layout.dim) == (10, 128)
    assert count["parser"] == 1_104_000  # the frozen encoder's 86 M are not among them


@pytest.mark.parametrize("initializer", ["gaussian", "cluster"])
def test_both_initialisers_work_on_features(weights: Path, initializer: str) -> None:
    model = build(weights, f"parser.initializer={initializer}")
    found = model.parser(frames(), generator=torch.Generator().manual_seed(0))
    assert found.slots_BTKD.shape == (2, 3, 4, 12) and found.attention_BTKHW.shape == (2, 3, 4, 8, 8)
    torch.testing.assert_close(found.attention_BTKHW.sum(2), torch.ones(2, 3, 8, 8))
    assert found.features_BTLF is not None and not found.features_BTLF.requires_grad
    # Features that are known already are as good as frames.
    again = model.parser(
        torch.zeros(2, 3, 3, 32, 32), features_BTLF=found.features_BTLF, generator=torch.Generator().manual_seed(0)
    )
    torch.testing.assert_close(again.slots_BTKD, found.slots_BTKD)
    more = model.parser(frames(), num_slots=6)
    assert more.slots_BTKD.shape == (2, 3, 6, 12)


def test_slots_are_exchangeable(weights: Path) -> None:
    model = build(weights, "renderer.mask_prior=true").eval()
    assert isinstance(model.parser, SaviParser)
    first_BKD = torch.randn(2, 4, 12)
    with torch.no_grad():
        results = []
        for slots_BKD in (first_BKD, first_BKD[:, ORDER]):
            model.parser.initializer.forward = lambda *_, slots=slots_BKD: slots  # type: ignore[method-assign]
            parsed = model.parser(frames())
            results.append((parsed, model.renderer(parsed.slots_BTKD[:, 2])))
        (parsed, drawn), (parsed_2, drawn_2) = results
        masks = model.renderer.masks(parsed.slots_BTKD[:, 2])
    close: dict[str, Any] = dict(atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(parsed_2.slots_BTKD, parsed.slots_BTKD[:, :, ORDER], **close)
    torch.testing.assert_close(parsed_2.attention_BTKHW, parsed.attention_BTKHW[:, :, ORDER], **close)
    torch.testing.assert_close(drawn_2.frames_B3HW, drawn.frames_B3HW, **close)
    torch.testing.assert_close(drawn_2.features_BLF, drawn.features_BLF, **close)
    torch.testing.assert_close(drawn_2.masks_BKHW, drawn.masks_BKHW[:, ORDER], **close)
    torch.testing.assert_close(drawn_2.draw_objects(), drawn.draw_objects()[:, ORDER], **close)
    torch.testing.assert_close(drawn.masks_BKHW.sum(1), torch.ones(2, 32, 32))
    torch.testing.assert_close(masks, drawn.masks_BKHW)


def test_stage_one_learns_from_pixels_and_from_features_unclamped(weights: Path) -> None:
    model = build(weights)
    clips = frames()
    loss = ParserStage(model)(clips, thing_weights(clips.flatten(0, 1), 0.0))
    parsed = model.parser(clips)
    assert parsed.features_BTLF is not None and parsed.features_BTLF.abs().max() > 1
    zero = build(weights)
    with torch.no_grad():
        for parameter in zero.renderer.parameters():
            parameter.zero_()
    nothing = ParserStage(zero)(clips, thing_weights(clips.flatten(0, 1), 0.0))
    # A renderer that draws zeros errs by the mean square of what it should draw.
    torch.testing.assert_close(nothing.feature, parsed.features_BTLF.square().mean())
    torch.testing.assert_close(nothing.image, clips.square().mean())
    torch.testing.assert_close(loss.total(), loss.image + loss.feature)
    loss.feature.backward(retain_graph=True)
    assert all(p.grad is None for p in model.renderer.image_decoder.parameters())  # type: ignore[union-attr]
    loss.image.backward()
    for name, parameter in [*model.parser.named_parameters(), *model.renderer.named_parameters()]:
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_the_image_loss_reaches_the_predictor_through_the_frozen_renderer(weights: Path) -> None:
    model = build(weights)
    model.parser.requires_grad_(False)
    model.renderer.requires_grad_(False)
    slots_BTKD = model.parser(frames(1, 2)).slots_BTKD
    text = model.text(["put the red block in the blue bowl"])
    imagined = model.predictor.rollout(slots_BTKD, text, 2).slots_BSKD
    model.renderer(imagined.flatten(0, 1)).frames_B3HW.square().mean().backward()
    assert all(p.grad is None for part in (model.parser, model.renderer) for p in part.parameters())
    reached = [p.grad is not None and bool(p.grad.abs().sum() > 0) for p in model.predictor.parameters()]
    assert sum(reached) > 0.8 * len(reached)


Arguments = Callable[..., ParserTraining]


@pytest.fixture
def stage_one(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Arguments:
    write_toy_episodes(tmp_path / "train.h5", [6, 5] + [4] * 16)
    write_toy_episodes(tmp_path / "val.h5", [6, 5], seed=1)
    monkeypatch.setitem(PRESETS, TINY.name, TINY)

    def arguments(out: str, *settings: str, **changes: object) -> ParserTraining:
        options = dict(preset=TINY.name, steps=3, batch=2, clip=2, warmup=1, evaluate_every=100) | changes
        return ParserTraining(
            tmp_path / "train.h5",
            tmp_path / "val.h5",
            tmp_path / out,
            set=(f"parser.encoder_weights={weights}", *settings),
            **options,  # type: ignore[arg-type]
        )

    return arguments


def test_both_stages_and_a_rollout(stage_one: Arguments, weights: Path, tmp_path: Path) -> None:
    cached = stage_one("cached", cache_features=True)
    train_parser.train(cached)
    online = stage_one("online")
    train_parser.train(online)
    folder = cached.out / "checkpoint"
    one, other = (TextOCVP.from_pretrained(args.out / "checkpoint").state_dict() for args in (cached, online))
    assert not any("dino" in name or "backbone" in name for name in one)
    for name in one:  # the cache is float16
        torch.testing.assert_close(one[name], other[name], atol=2e-3, rtol=2e-2)
    stored = json.loads((folder / "config.json").read_text())["parser"]
    assert stored["encoder_weights"] == str(weights) and len(stored["encoder_fingerprint"]) == 64

    second = PredictorTraining(
        cached.data, cached.val, tmp_path / "second", parser=folder, steps=2, batch=2, horizon=2, image_weight=1.0
    )
    train_predictor.train(second)
    world = WorldModel.from_pretrained(second.out / "checkpoint")
    with EpisodeFile(cached.val) as episodes:
        image = episodes.episode(0).frames[0]
        text = episodes.episode(0).instruction
    rollout = world.rollout(image, text, horizon=3)
    assert rollout.frames.shape == (1, 4, 3, 32, 32) and rollout.masks.shape == (1, 4, 4, 32, 32)
    torch.testing.assert_close(rollout.masks.sum(2), torch.ones(1, 4, 32, 32))
    assert world.rollout(image, text, horizon=3).slots.equal(rollout.slots)
    old, new = (TextOCVP.from_pretrained(path).renderer.state_dict() for path in (folder, second.out / "checkpoint"))
    assert all(torch.equal(old[name], new[name]) for name in old)

    # Elsewhere the weights lie elsewhere; but they must be the same.
    moved = write_tiny_dino(tmp_path / "moved")
    wrong = write_tiny_dino(tmp_path / "wrong", seed=1)
    config = json.loads((folder / "config.json").read_text())
    for place, refused in ((moved, False), (wrong, True)):
        config["parser"]["encoder_weights"] = str(place)
        (folder / "config.json").write_text(json.dumps(config))
        model = TextOCVP.from_pretrained(folder)
        if refused:
            with pytest.raises(WeightsError, match="other weights"):
                model.parser(to_frames(image[None, None]))
        else:
            model.parser(to_frames(image[None, None]))


def test_encoding_goes_on_where_it_was_killed_and_refuses_what_is_not_its_own(
    stage_one: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = stage_one("out", cache_features=True, steps=1)
    train_parser.train(args)
    parts = sorted((args.out / "features-train").iterdir())
    assert [path.name for path in parts] == ["000000.h5", "000016.h5"]
    with EpisodeFile(args.data) as episodes, h5py.File(parts[1]) as file:
        encoder = DinoEncoder(args.set[0].partition("=")[2], dim=DIM, patch=PATCH)
        wanted = encoder(to_frames(episodes.episode(17).frames[None])[0])
        assert np.array_equal(file["values"][-4:], wanted.half().numpy())

    parts[1].unlink()  # as after a kill
    before = parts[0].stat().st_mtime_ns
    train_parser.train(dataclasses.replace(args, steps=2))
    assert parts[1].exists() and parts[0].stat().st_mtime_ns == before

    (args.out / "settings.json").unlink()  # the cache looks for itself
    with pytest.raises(CacheError, match="from other episodes"):
        train_parser.train(dataclasses.replace(args, steps=3, episodes=17))
    wrong = write_tiny_dino(tmp_path / "wrong", seed=1)
    with pytest.raises(CacheError, match="by another network"):
        train_parser.train(dataclasses.replace(args, steps=3, set=(f"parser.encoder_weights={wrong}",)))
    parts[0].write_bytes(b"nothing")
    with pytest.raises(CacheError, match="damaged"):
        train_parser.train(dataclasses.replace(args, steps=3))
    with pytest.raises(SettingsError, match="cache_features needs a frozen image encoder"):
        train_parser.train(stage_one("conv", "parser.image_size=32", preset="savi-small", cache_features=True))
    with pytest.raises(SettingsError, match=r"train\.h5 has frames of 32 pixels, parser\.image_size is 64"):
        train_parser.train(stage_one("other", preset="savi-small"))
    nowhere = f"parser.encoder_weights={tmp_path / 'nowhere'}"
    files = ["--data", args.data, "--val", args.val, "--out", tmp_path / "never"]
    command = ["train", "parser", "--preset", TINY.name, *map(str, files), "--set", nowhere]
    assert cli.main(command) == 1
    assert "hf download facebook/dinov2-base" in capsys.readouterr().err


def test_choices_that_do_not_fit_are_refused_by_name(weights: Path, tmp_path: Path) -> None:
    for setting, message in (
        ("renderer.patches=7", r"renderer\.patches is 7, .* set renderer\.patches=8"),
        ("renderer.feature_dim=8", r"renderer\.feature_dim is 8"),
        ("parser.encoder=conv", r"set .*parser\.encoder=dinov2"),
        ("parser.kind=placed parser.layout.explicit=true", r"set parser\.kind=savi and parser\.encoder=dinov2"),
        ("parser.image_size=30", r"patches of 4 pixels do not divide 30"),
        ("renderer.image_channels=40", r"image_channels"),
    ):
        with pytest.raises(ValueError, match=message):
            TextOCVP(with_settings(TINY, setting.split()))
    with pytest.raises(ValueError, match=r"image_decoder is 'dalle': must be one of cnn, vqgan"):
        build(weights, "renderer.image_decoder=dalle")
    with pytest.raises(ValueError, match="features are for a parser with a frozen encoder"):
        conv = TextOCVP(preset("savi-small")).parser
        conv(torch.zeros(1, 1, 3, 64, 64), features_BTLF=torch.zeros(1, 1, 4, 4))
    # A checkpoint of one image decoder is not one of the other.
    build(weights).save_pretrained(tmp_path / "cnn")
    config = json.loads((tmp_path / "cnn" / "config.json").read_text())
    config["renderer"]["image_decoder"] = "vqgan"
    (tmp_path / "cnn" / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"lacks tensors 'renderer\.image_decoder"):
        TextOCVP.from_pretrained(tmp_path / "cnn")
