"""Pictures in another light and grainy ones: put right, said, and no others touched."""

from __future__ import annotations

import io
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image

import envs  # noqa: F401 - registers the environments
from textocvp import WorldModel
from textocvp.inputs import ForeignPictureWarning, OwnFrames, checked_frames
from textocvp.pictures.put_right import put_right


@pytest.fixture(scope="module")
def shipped() -> WorldModel:
    return WorldModel.from_pretrained()


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    env = gym.make("PutBlockInBowl-v0", control="primitive")
    return np.asarray(env.reset(seed=10_000_003)[0]["rgb"])


def jpeg(picture: np.ndarray) -> np.ndarray:
    Image.fromarray(picture).save(file := io.BytesIO(), "JPEG", quality=75)
    return np.asarray(Image.open(file))


def noisy(picture: np.ndarray) -> np.ndarray:
    return (picture + 8 * np.random.default_rng(0).standard_normal(picture.shape)).round().clip(0, 255).astype(np.uint8)


def lit(picture: np.ndarray, factor: float) -> np.ndarray:
    return (picture * factor).round().clip(0, 255).astype(np.uint8)


def own_of(model: WorldModel) -> OwnFrames:
    assert model.model.config.own_frames is not None
    return model.model.config.own_frames


def right(model: WorldModel, *pictures: np.ndarray) -> tuple[np.ndarray, list[str]]:
    frames = checked_frames(np.stack(pictures), model.image_size, torch.device("cpu"))[:, None]
    with torch.no_grad():
        done, said = put_right(frames, own_of(model), model.model.restorer)
    return ((done[:, 0] + 1) * 127.5).round().permute(0, 2, 3, 1).numpy(), said


def test_own_pictures_stay_as_they_are(shipped: WorldModel, picture: np.ndarray) -> None:
    frames = checked_frames(picture[None], shipped.image_size, torch.device("cpu"))[:, None]
    assert put_right(frames, own_of(shipped))[0] is frames
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shipped.parse(picture[None])


@pytest.mark.parametrize(("factor", "light", "most"), [(0.7, "0.7", 1.0), (0.5, "0.5", 6.0), (1.25, "1.3", 30.0)])
def test_light_is_put_right(shipped: WorldModel, picture: np.ndarray, factor: float, light: str, most: float) -> None:
    """Up to rounding; what was burnt out is off by up to half of what was lost."""
    found, said = right(shipped, lit(picture, factor))
    assert len(said) == 1 and f"in about {light} times the light" in said[0]
    assert np.abs(found[0] - picture).max() <= most
    assert np.abs(found[0] - picture).mean() < 2.0 < np.abs(lit(picture, factor) - picture.astype(float)).mean()


@pytest.mark.parametrize("spoil", [noisy, jpeg])
def test_grain_is_smoothed_and_edges_stay(shipped: WorldModel, picture: np.ndarray, spoil: object) -> None:
    grainy = spoil(picture)  # type: ignore[operator]
    found, said = right(shipped, grainy)
    assert len(said) == 1 and "grainy" in said[0]
    before, after = (np.abs(one - picture.astype(float)).mean() for one in (grainy, found[0]))
    assert after < 0.7 * before
    edges = np.abs(np.diff(picture.astype(float), axis=1)).max(-1) > 60
    assert (np.abs(np.diff(found[0], axis=1)).max(-1)[edges] > 40).mean() > 0.9


def test_another_canvas_is_not_touched(shipped: WorldModel, picture: np.ndarray) -> None:
    table = (picture == np.median(picture, (0, 1))).all(-1)
    wooden = np.where(table[..., None], np.array([139, 101, 66], np.uint8), picture)
    for other in (wooden, np.zeros_like(picture), np.full_like(picture, 200)):
        found, said = right(shipped, other)
        assert said == [] and (found[0] == other).all()


def test_each_of_a_batch_is_decided_by_itself(shipped: WorldModel, picture: np.ndarray) -> None:
    dark, grainy = lit(picture, 0.7), jpeg(picture)
    together, said = right(shipped, picture, dark, grainy)
    assert len(said) == 2 and (together[0] == picture).all()
    for alone, one in zip((dark, grainy), together[1:], strict=True):
        assert (right(shipped, alone)[0][0] == one).all()


def test_a_dark_picture_is_imagined_from_as_a_bright_one_and_said(shipped: WorldModel, picture: np.ndarray) -> None:
    text = "put the red block in the blue bowl"
    with pytest.warns(ForeignPictureWarning, match="in about 0.7 times the light, which was put right"):
        dark = shipped.rollout(lit(picture, 0.7), text, horizon=8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bright = shipped.rollout(picture, text, horizon=8)
    assert float((dark.frames[0, 0] - bright.frames[0, 0]).abs().mean()) < 0.01
    with pytest.warns(ForeignPictureWarning, match="in about 0.7 times the light"):
        shipped.parse(np.stack([lit(picture, 0.7)] * 2))
    with pytest.warns(ForeignPictureWarning, match="in about 0.7 times the light"):  # of twice the size, too
        large = shipped.parse(lit(picture, 0.7).repeat(2, 0).repeat(2, 1)[None])
    np.testing.assert_allclose(large.positions[0, 0], dark.positions[0, 0], atol=0.05)


def test_models_that_do_not_know_their_canvas_change_nothing(shipped: WorldModel, picture: np.ndarray) -> None:
    own = replace(own_of(shipped), canvas="")
    frames = checked_frames(lit(picture, 0.7)[None], shipped.image_size, torch.device("cpu"))[:, None]
    assert put_right(frames, own)[0] is frames and put_right(frames, own)[1] == []
    with pytest.raises(ValueError, match=r"own_frames\.canvas is 'gray'"):
        replace(own, canvas="gray")
