"""The voting network as a frozen encoder: what it says, that it stays as it is, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.textocvp.conftest import SMALL_TEXT
from textocvp.config import ModelConfig
from textocvp.model import TextOCVP
from textocvp.parsers.frozen_votes import VotedClusters, VotesEncoder
from textocvp.parsers.savi import SaviConfig
from textocvp.parsers.votes import OBJECT, VotesConfig
from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.presets import preset
from textocvp.pretrained import WeightsError
from textocvp.renderers.patches import FeatureConfig
from textocvp.slots import SlotLayout
from textocvp.training.parser import ParserStage

WINDOW = TextOCVPConfig(dim=16, layers=2, heads=2, hidden=16, attention="window", window=4)


@pytest.fixture
def voter(tmp_path: Path) -> Path:
    """A checkpoint whose parser votes, with random weights: 4 channels at half resolution."""
    torch.manual_seed(1)
    parser = VotesConfig(image_size=32, num_slots=4, channels=4, channels_full=4)
    TextOCVP(replace(preset("cater"), parser=parser)).save_pretrained(tmp_path / "voter")
    return tmp_path / "voter"


def frames(count: int = 3) -> torch.Tensor:
    return torch.rand(count, 3, 32, 32, generator=torch.Generator().manual_seed(7)) * 2 - 1


def student(voter: Path | str, **changes: object) -> ModelConfig:
    parser = SaviConfig(
        image_size=32,
        num_slots=4,
        layout=SlotLayout(content=12, explicit=False),
        initializer="gaussian",
        encoder="votes",
        encoder_weights=str(voter),
        encoder_dim=9,
        encoder_patch=2,
        transition_hidden=16,
    )
    renderer = FeatureConfig(patches=16, layers=3, hidden=16, feature_dim=9, image_channels=32)
    return ModelConfig("student", replace(parser, **changes), renderer, SMALL_TEXT, WINDOW)  # type: ignore[arg-type]


def test_features_are_what_the_network_says(voter: Path) -> None:
    network = TextOCVP.from_pretrained(voter).parser.network
    found = VotesEncoder(voter, dim=9, patch=2)(frames())
    assert found.shape == (3, 16 * 16, 9)
    assert torch.equal(found, found.half().float())  # a cache loses nothing
    with torch.no_grad():
        logits, votes = network(frames())
    shares = logits.softmax(1)
    # Place (row 2, column 5) is pixels (4..5, 10..11).
    for number, said in {
        **{kind: 2 * shares[:, kind] - 1 for kind in range(3)},
        # Where the centre is: columns are x, 32 pixels are 2 wide.
        3: shares[:, OBJECT] * ((torch.arange(32) + 0.5 + votes[:, 0]) / 16 - 1),
        4: shares[:, OBJECT] * ((torch.arange(32)[:, None] + 0.5 + votes[:, 1]) / 16 - 1),
        **{6 + channel: frames()[:, channel] for channel in range(3)},
    }.items():
        wanted = said[:, 4:6, 10:12].mean((1, 2))
        torch.testing.assert_close(found[:, 2 * 16 + 5, number], wanted, atol=2e-3, rtol=2e-3)


def test_it_learns_nothing_and_is_in_no_checkpoint(voter: Path, tmp_path: Path) -> None:
    model = TextOCVP(student(voter))
    before = {name: tensor.clone() for name, tensor in model.parser.frozen.load()._backbone[0].state_dict().items()}
    stage = ParserStage(model)
    optimizer = torch.optim.Adam(stage.parameters(), 1e-2)
    for _ in range(2):
        loss = stage(frames()[:, None], torch.ones(3, 1, 32, 32), generator=[torch.Generator() for _ in range(3)])
        loss.total().backward()
        optimizer.step()
    assert loss.feature > 0
    assert model.parser.encoder.mlp[1].weight.grad.abs().sum() > 0
    after = model.parser.frozen._backbone[0].state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before)
    model.save_pretrained(tmp_path / "student")
    assert not any("network" in name for name in load_file(tmp_path / "student" / "model.safetensors"))


def test_another_predictor_beside_it_is_the_same_encoder_but_no_other_network(voter: Path, tmp_path: Path) -> None:
    model = TextOCVP(student(voter))
    slots = model.parser(frames()[:, None], generator=torch.Generator().manual_seed(0)).slots_BTKD
    model.save_pretrained(tmp_path / "student")
    file = voter / "model.safetensors"
    tensors = load_file(file)
    key = next(name for name in tensors if name.startswith("predictor."))
    save_file({**tensors, key: tensors[key] + 1}, file)
    again = TextOCVP.from_pretrained(tmp_path / "student")
    assert torch.equal(again.parser(frames()[:, None], generator=torch.Generator().manual_seed(0)).slots_BTKD, slots)
    key = next(name for name in tensors if name.startswith("parser.network."))
    save_file({**tensors, key: tensors[key] + 1}, file)
    with pytest.raises(WeightsError, match=r"parser\.encoder_fingerprint: .* another voting network"):
        TextOCVP.from_pretrained(tmp_path / "student").parser(frames()[:, None])


def test_the_bundled_network_tells_twins_apart() -> None:
    """No name is needed for it. All pixels of a thing say where its middle is, and its twin's say where that is."""
    picture = torch.full((1, 3, 64, 64), 0.3)
    for left in (16, 40):
        picture[:, :, 30:38, left : left + 8] = torch.tensor([0.6, -0.8, -0.8])[:, None, None]
    grid = VotesEncoder(dim=9, patch=2)(picture)[0].unflatten(0, (32, 32))
    for left in (16, 40):
        inside = grid[16:18, left // 2 + 1 : left // 2 + 3]
        assert inside[..., OBJECT].min() > 0.6
        middle = torch.tensor([(left + 4) / 32 - 1, 34 / 32 - 1])
        assert (inside[..., 3:5] - middle).abs().max() < 0.06  # two pixels
    assert grid[:10, :, OBJECT].max() < -0.6


def test_slots_may_begin_with_what_is_elected() -> None:
    """Twins get a slot each, of their own places; what has no votes is background, also where there are no things."""
    picture = torch.full((2, 3, 64, 64), 0.3)
    for left in (16, 40):
        picture[0, :, 30:38, left : left + 8] = torch.tensor([0.6, -0.8, -0.8])[:, None, None]
    found = VotedClusters()(VotesEncoder(dim=9, patch=2)(picture).transpose(1, 2).unflatten(2, (32, 32)), 5)
    assert torch.equal(found.masks.sum(1), torch.ones(2, 32, 32))
    assert found.presence.tolist() == [[1, 1, 1, 0, 0], [1, 0, 0, 0, 0]]
    owner = found.masks[0].argmax(0)
    owners = [owner[15:19, left // 2 : left // 2 + 4].unique().tolist() for left in (16, 40)]
    assert sorted(owners) == [[1], [2]]
    assert (owner > 0).sum() < 60  # of two times 16, and what they throw shadows on


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "model.safetensors").write_bytes(b"{}"), "no checkpoint that can be read"),
        (lambda folder: (folder / "config.json").unlink(), "no checkpoint that can be read"),
        (lambda folder: drop_tensor(folder), "no checkpoint that can be read"),
        (lambda folder: set_kind(folder, "placed"), "the parser of .* is no 'votes', but 'placed'"),
    ],
)
def test_what_is_no_voting_network_is_refused(voter: Path, change: object, message: str) -> None:
    change(voter)  # type: ignore[operator]
    with pytest.raises(WeightsError, match=message):
        VotesEncoder(voter, dim=9, patch=2).load()


def test_sizes_must_be_those_of_the_network(voter: Path) -> None:
    with pytest.raises(WeightsError, match=r"parser\.encoder_dim is 30, that of the weights in .* is 9"):
        VotesEncoder(voter, dim=30, patch=2).load()
    with pytest.raises(WeightsError, match=r"parser\.encoder_patch is 4, .* is 2"):
        VotesEncoder(voter, dim=9, patch=4).load()


def set_kind(folder: Path, kind: str) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["parser"]["kind"] = kind
    (folder / "config.json").write_text(json.dumps(config))


def drop_tensor(folder: Path) -> None:
    tensors = load_file(folder / "model.safetensors")
    tensors.pop(next(name for name in tensors if name.startswith("parser.network.")))
    save_file(tensors, folder / "model.safetensors")
