"""The restorer: what it learns from, that all else stays as it is, and which pictures it is shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.textocvp.conftest import PLACED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from tests.textocvp.training.both_stages import OWN
from textocvp.model import TextOCVP
from textocvp.pictures.put_right import put_right
from textocvp.pictures.restorer import Restorer, RestorerConfig
from textocvp.training.light import jpeg, spoil
from textocvp.training.predictor import PredictorTraining, assemble
from textocvp.training.restorer import RestorerTraining, train
from textocvp.training.run import SettingsError
from textocvp.world_model import WorldModel


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Toy episodes, a checkpoint, and the same with a restorer that has learned a little."""
    folder = tmp_path_factory.mktemp("restorer")
    write_toy_episodes(folder / "train.h5", [9] * 8)
    write_toy_episodes(folder / "val.h5", [9] * 16, seed=1)
    build(replace(PLACED, own_frames=OWN)).save_pretrained(folder / "before")
    args = settings(folder, steps=200, batch=8, learning_rate=5e-3, warmup=10, set=("restorer.channels=8",))
    metrics = train(args)
    assert metrics is not None and metrics.restored.value < 0.9 * metrics.spoiled.value
    return folder


def settings(folder: Path, out: str = "run", **options: object) -> RestorerTraining:
    paths = {"data": folder / "train.h5", "val": folder / "val.h5", "out": folder / out}
    return RestorerTraining(parser=str(folder / "before"), **paths, **options)  # type: ignore[arg-type]


def own_picture() -> np.ndarray:
    frame = np.full((32, 32, 3), 47, np.uint8)
    frame[5:14, 6:15], frame[18:27, 4:13] = (200, 87, 89), (78, 121, 167)
    return frame


def grainy(picture: np.ndarray) -> np.ndarray:
    """(32, 32, 3): with noise, as a JPEG."""
    noise = 8 * np.random.default_rng(0).standard_normal(picture.shape)
    return jpeg((picture + noise).round().clip(0, 255).astype(np.uint8), 75)


def test_all_else_of_the_checkpoint_stays_as_it_is(folder: Path) -> None:
    before, after = (TextOCVP.from_pretrained(folder / name) for name in ("before", "run/checkpoint"))
    assert before.restorer is None and after.restorer is not None
    old, new = before.state_dict(), after.state_dict()
    assert {name for name in new if name not in old} == {f"restorer.{name}" for name in after.restorer.state_dict()}
    assert all(torch.equal(old[name], new[name]) for name in old)
    assert replace(after.config, restorer=None) == before.config


def test_a_rollout_begins_with_the_restored_picture(folder: Path) -> None:
    picture = grainy(own_picture())
    old, new = (WorldModel.from_pretrained(folder / name) for name in ("before", "run/checkpoint"))
    assert old.model.config.own_frames is not None
    frames_11 = torch.from_numpy(picture).permute(2, 0, 1)[None, None] / 127.5 - 1
    with torch.no_grad():
        restored, _ = put_right(frames_11, OWN, new.model.restorer)
        expected = new.model.parser(restored).slots_BTKD
    shown = ((restored[0, 0].permute(1, 2, 0) + 1) * 127.5).round().byte().numpy()
    with pytest.warns(UserWarning, match="grainy"):
        parsed = new.parse(picture[None])
    assert (shown != picture).any()
    torch.testing.assert_close(parsed.slots, expected, atol=1e-5, rtol=0)


def test_it_is_shown_what_no_factor_brings_back() -> None:
    """Pictures that are grainy or too bright; neither own ones nor dark ones."""
    own = own_picture()
    bright, dark = ((own * factor).clip(0, 255).astype(np.uint8) for factor in (1.4, 0.7))
    shown: list[Tensor] = []

    def restorer(pictures: Tensor) -> Tensor:
        shown.append(pictures)
        return torch.zeros_like(pictures)

    frames = torch.from_numpy(np.stack([own, bright, dark, grainy(own)])).permute(0, 3, 1, 2)[:, None] / 127.5 - 1
    right, _ = put_right(frames, replace(OWN, grain=0.0), restorer)
    assert [len(pictures) for pictures in shown] == [1, 1]
    assert torch.equal(right[0], frames[0]) and (right[1].abs() < 0.01).all() and right[2].abs().min() > 0.01


def test_spoiled_pictures_keep_what_is_shown() -> None:
    picture = np.random.default_rng(0).integers(40, 170, (16, 16, 3)).repeat(2, 0).repeat(2, 1).astype(np.uint8)
    kinds = set()
    for seed in range(60):
        spoiled, clean = spoil(picture, np.random.default_rng(seed))
        again, _ = spoil(picture, np.random.default_rng(seed))
        assert (spoiled == again).all() and spoiled.shape == clean.shape == picture.shape
        off = np.abs(spoiled - clean)
        assert off.mean() < 40 and abs(spoiled.mean() - clean.mean()) < 12  # its light has been undone
        kinds.add((off.max() < 1.5, (clean == picture).all()))
    assert len(kinds) == 4  # spoiled or not, in its own hues or in others


def test_a_restorer_stays_through_the_training_of_a_predictor(folder: Path) -> None:
    trained = TextOCVP.from_pretrained(folder / "run/checkpoint")
    paths = {"data": folder / "train.h5", "val": folder / "val.h5", "out": folder / "predictor"}
    model = assemble(PredictorTraining(parser=folder / "run/checkpoint", **paths), trained)
    assert model.restorer is not None and trained.restorer is not None
    assert not any(parameter.requires_grad for parameter in model.restorer.parameters())
    assert all(map(torch.equal, model.restorer.state_dict().values(), trained.restorer.state_dict().values()))


def test_what_cannot_have_one_is_refused(folder: Path) -> None:
    build(PLACED).save_pretrained(folder / "strange")
    with pytest.raises(SettingsError, match="knows no canvas of its frames"):
        train(replace(settings(folder, "a"), parser=str(folder / "strange")))
    with pytest.raises(SettingsError, match=r"'predictor\.layers=1': all else comes trained; set restorer\.\* only"):
        train(settings(folder, "b", set=("predictor.layers=1",)))
    with pytest.raises(SettingsError, match=r"restorer\.channels is 0: must be 1 to"):
        train(settings(folder, "c", set=("restorer.channels=0",)))
    with pytest.raises(ValueError, match="a restorer takes frames of a multiple of 4 pixels, not 30"):
        build(replace(PLACED, parser=replace(PLACED.parser, image_size=30), restorer=RestorerConfig()))


def test_before_training_it_changes_nothing() -> None:
    pictures = torch.rand(2, 3, 20, 32) * 2 - 1
    assert torch.equal(Restorer(RestorerConfig(4))(pictures), pictures)
