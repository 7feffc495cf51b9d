"""MAGE: sizes, what may influence what, the cache, gradients through the codes, and checkpoints."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from textocvp.baselines.mage.config import AxialConfig, MageConfig, VQVAEConfig, mage_preset
from textocvp.baselines.mage.model import Mage
from textocvp.checkpoint import CheckpointError
from textocvp.config import TextConfig
from textocvp.protocols import load_model
from textocvp.world_model import WorldModel

TINY = MageConfig(
    name="tiny",
    vqvae=VQVAEConfig(image_size=16, channels=8, blocks=1, codebook_size=12, code_dim=4),
    text=TextConfig(kind="lexicon", dim=24, layers=1, heads=2, hidden=24),
    axial=AxialConfig(dim=24, layers=6, heads=2, hidden=24, frames=6),
)
TEXTS = ["put the red block in the blue bowl", "put the green block in the yellow bowl"]


@pytest.fixture
def model() -> Mage:
    torch.manual_seed(0)
    model = Mage(TINY).eval()
    with torch.no_grad():  # as they start, layers that add next to nothing would let any mistake pass
        for parameter in model.axial.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return model


def codes(batch: int, frames: int) -> Tensor:
    return torch.randint(12, (batch, frames, 4, 4), generator=torch.Generator().manual_seed(1))


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


def test_second_stage_of_mage_dino_has_the_papers_parameters() -> None:
    with torch.device("meta"):
        model = Mage(mage_preset("mage-dino"))
    assert count(model.text) + count(model.axial) == 32_113_664


def test_a_later_frame_changes_no_earlier_prediction(model: Mage) -> None:
    seen, text = codes(2, 4), model.text(TEXTS)
    before = model.axial(seen, text, torch.ones(2))
    changed = seen.clone()
    changed[:, 2:] = (changed[:, 2:] + 1) % 12
    after = model.axial(changed, text, torch.ones(2))
    torch.testing.assert_close(after[:, :2], before[:, :2])
    assert (after[:, 2:] - before[:, 2:]).abs().max() > 1e-2


def test_the_text_reaches_every_prediction(model: Mage) -> None:
    seen = codes(1, 3).expand(2, -1, -1, -1)
    scores = model.axial(seen, model.text(TEXTS), torch.ones(2))
    assert ((scores[0] - scores[1]).abs().flatten(1).amax(dim=1) > 1e-3).all()


def test_padding_of_a_longer_neighbour_changes_nothing(model: Mage) -> None:
    seen = codes(2, 2)
    longer = [TEXTS[0], TEXTS[1] + " and then put the red block in the blue bowl"]
    alone = model.axial(seen[:1], model.text(TEXTS[:1]), torch.ones(1))
    together = model.axial(seen, model.text(longer), torch.ones(2))
    torch.testing.assert_close(together[:1], alone, atol=1e-4, rtol=1e-4)


def test_imagining_with_the_cache_and_without_is_the_same(model: Mage) -> None:
    seen, text = codes(2, 1), model.text(TEXTS)
    cached = model.axial.imagine(seen, text, 5)
    plain = model.axial.imagine(seen, text, 5, use_cache=False)
    assert torch.equal(cached, plain)
    assert len(cached.unique()) > 1
    with pytest.raises(ValueError, match="at most 6 in all"):
        model.axial.imagine(seen, text, 6)


def test_the_gradient_passes_straight_through_the_codes(model: Mage) -> None:
    frames = torch.rand(2, 3, 16, 16) * 2 - 1
    drawn, _ = model.vqvae(frames)
    (drawn - frames).square().mean().backward()
    first = next(model.vqvae.parameters())
    assert first.grad is not None and first.grad.abs().max() > 0
    # What was chosen is a row of the codebook, whatever the gradient pretends.
    chosen = model.vqvae.encode(frames)
    torch.testing.assert_close(model.vqvae.decode(chosen), drawn.detach(), atol=1e-5, rtol=1e-5)


def test_a_checkpoint_comes_back_and_a_damaged_one_is_refused(model: Mage, tmp_path: Path) -> None:
    model.save(tmp_path)
    again = Mage.load(tmp_path)
    first = torch.rand(2, 3, 16, 16) * 2 - 1
    assert torch.equal(again.imagine(first, TEXTS, 3), model.imagine(first, TEXTS, 3))

    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "axial": {**config["axial"], "depth": 3}}))
    with pytest.raises(CheckpointError, match="depth"):
        Mage.load(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({**config, "axial": {**config["axial"], "hidden": 32}}))
    with pytest.raises(CheckpointError, match="feed_forward"):
        Mage.load(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(config))
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="damaged"):
        Mage.load(tmp_path)


def test_the_bundled_one_is_its_preset_and_imagines_through_the_common_door() -> None:
    model = load_model("mage-small")
    picture = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    frames = model.imagine(picture, TEXTS[0], horizon=2)
    assert frames.shape == (1, 3, 3, 64, 64) and frames.min() >= 0 and frames.max() <= 1
    assert replace(model.model.config, name="mage-small") == mage_preset("mage-small")  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="horizon"):
        model.imagine(picture, TEXTS[0], horizon=25)
    with pytest.raises(CheckpointError, match="load_video_model"):
        WorldModel.from_pretrained("mage-small")
