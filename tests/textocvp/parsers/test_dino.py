"""The frozen encoder sees what DINOv2 was trained to see, stays as it is, and is never made up."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load, save_file
from transformers import BitImageProcessor, Dinov2Model

from tests.textocvp.parsers.tiny_dino import DIM, PATCH, write_tiny_dino
from textocvp.parsers.base import to_frames
from textocvp.parsers.dino import IMAGE_MEAN, IMAGE_STD, DinoEncoder, normalized
from textocvp.pretrained import WeightsError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_dino(tmp_path / "dino")


def encoder(folder: Path, **changes: object) -> DinoEncoder:
    return DinoEncoder(folder, dim=DIM, patch=PATCH, **changes)  # type: ignore[arg-type]


@pytest.fixture
def images() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (2, 24, 24, 3), dtype=np.uint8)


def test_frames_are_normalised_as_the_published_image_processor_does(images: np.ndarray) -> None:
    processor = BitImageProcessor(
        do_resize=False, do_center_crop=False, image_mean=list(IMAGE_MEAN), image_std=list(IMAGE_STD)
    )
    wanted = processor(list(images), return_tensors="pt")["pixel_values"]
    torch.testing.assert_close(normalized(to_frames(images[None])[0]), wanted, atol=2e-6, rtol=1e-5)
    black_white = torch.tensor([-1.0, 1.0])[:, None, None, None].expand(2, 3, 1, 1)
    low, high = normalized(black_white)[:, :, 0, 0]
    torch.testing.assert_close(low, torch.tensor([-2.1179, -2.0357, -1.8044]), atol=1e-4, rtol=0)
    torch.testing.assert_close(high, torch.tensor([2.2489, 2.4286, 2.6400]), atol=1e-4, rtol=0)


def test_features_are_the_last_layers_patches_row_by_row(folder: Path, images: np.ndarray) -> None:
    frames = to_frames(images[None])[0]
    found = encoder(folder)(frames)
    assert found.shape == (2, 36, DIM)  # 24 pixels are 6 patches
    backbone = Dinov2Model.from_pretrained(folder).eval()
    with torch.no_grad():
        wanted = backbone(pixel_values=normalized(frames)).last_hidden_state[:, 1:]
    torch.testing.assert_close(found, wanted)
    projection = backbone.embeddings.patch_embeddings.projection
    with torch.no_grad():
        rows = projection(normalized(frames)).flatten(2).transpose(1, 2)
    assert rows.shape[1] == found.shape[1]
    assert torch.equal(rows[:, 6], projection(normalized(frames))[:, :, 1, 0])  # patch 6 starts the second row


def test_it_is_frozen_and_in_evaluation_mode_whatever_is_said(folder: Path, images: np.ndarray) -> None:
    frames = to_frames(images[None])[0].requires_grad_()
    frozen = encoder(folder).load()
    before = frozen(frames)
    frozen.train()
    assert torch.equal(frozen(frames), before)  # no dropout
    assert not before.requires_grad
    assert list(frozen.parameters()) == [] and frozen.state_dict() == {}
    assert all(not parameter.requires_grad for parameter in frozen._backbone[0].parameters())


def test_weights_are_known_by_their_fingerprint(folder: Path, tmp_path: Path, images: np.ndarray) -> None:
    frames = to_frames(images[None])[0]
    first = encoder(folder)
    assert first.fingerprint == ""
    first(frames)
    assert len(first.fingerprint) == 64
    again = encoder(folder, fingerprint=first.fingerprint)
    assert torch.equal(again(frames), first(frames))
    other = write_tiny_dino(tmp_path / "other", seed=1)
    with pytest.raises(WeightsError, match=rf"other weights.*{first.fingerprint[:12]}.*encoder_weights"):
        encoder(other, fingerprint=first.fingerprint)(frames)


def test_a_checkpoint_of_a_whole_classifier_in_half_precision_is_read(folder: Path, images: np.ndarray) -> None:
    frames, before = to_frames(images[None])[0], encoder(folder)(to_frames(images[None])[0])
    tensors = load((folder / "model.safetensors").read_bytes())
    whole = {f"dinov2.{name}": tensor.half() for name, tensor in tensors.items()}
    save_file({**whole, "classifier.weight": torch.zeros(2, 3)}, folder / "model.safetensors")
    after = encoder(folder)(frames)
    assert after.dtype == torch.float32
    torch.testing.assert_close(after, before, atol=0.03, rtol=0.03)


def test_nothing_is_made_up_where_weights_are_missing_or_wrong(folder: Path, tmp_path: Path) -> None:
    frames = torch.zeros(1, 3, 24, 24)
    nowhere = DinoEncoder(tmp_path / "nowhere", dim=768, patch=14)  # building it is no error, looking through it is
    with pytest.raises(WeightsError, match=r"hf download facebook/dinov2-base.*parser\.encoder_weights"):
        nowhere(torch.zeros(1, 3, 28, 28))
    with pytest.raises(WeightsError, match=r"parser\.encoder_dim is 8, that of the weights .* is 16"):
        DinoEncoder(folder, dim=8, patch=PATCH)(frames)
    with pytest.raises(WeightsError, match=r"parser\.encoder_patch is 8"):
        DinoEncoder(folder, dim=DIM, patch=8)(frames)
    with pytest.raises(ValueError, match="patches of 4 pixels do not divide 22"):
        encoder(folder)(torch.zeros(1, 3, 22, 22))

    weights, config = folder / "model.safetensors", folder / "config.json"
    tensors, settings = load(weights.read_bytes()), json.loads(config.read_text())
    name = "encoder.layer.1.norm1.weight"
    save_file({key: value for key, value in tensors.items() if key != name}, weights)
    with pytest.raises(WeightsError, match=f"lacks the tensor '{name}'"):
        encoder(folder)(frames)
    weights.write_bytes(b"no tensors")
    with pytest.raises(WeightsError, match="damaged"):
        encoder(folder)(frames)
    save_file(tensors, weights)
    config.write_text(json.dumps({**settings, "model_type": "vit"}))
    with pytest.raises(WeightsError, match=r"reads models of the type 'dinov2', .* is of the type 'vit'"):
        encoder(folder)(frames)
    config.unlink()
    with pytest.raises(WeightsError, match=r"lacks config\.json"):
        encoder(folder)(frames)
