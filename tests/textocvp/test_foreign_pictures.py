"""Pictures that are sound and yet not of the model's world: each gets a warning that names the likely cause."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image

from envs.splits import SPLITS
from planning import BeamPlanner, run_episode
from tests.textocvp.conftest import PLACED, build
from textocvp import WorldModel, cli
from textocvp.inputs import ForeignPictureWarning, OwnFrames

TEXT = "put the red block in the blue bowl"
FIRST = 60_000  # of the validation scenes; the checkpoints' figures are of the first 200
KINDS = ({}, {"color_split": "unseen"}, {"n_objects": 8})
Change = Callable[[np.ndarray], np.ndarray]


def observed(count: int, camera: str = "close") -> np.ndarray:
    """(count, 64, 64, 3) first pictures of held-out scenes, also of unseen colours and of 8 objects."""
    val, pictures = SPLITS["val"], []
    env = gym.make("PutBlockInBowl-v0", camera=camera)
    for i in range(count):
        seed = val.seed(FIRST + i)
        options = val.options(seed) | {"blocks_in_bowls": 0} | KINDS[i % len(KINDS)]
        pictures.append(env.reset(seed=seed, options=options)[0]["rgb"])
    env.close()
    return np.stack(pictures)


@pytest.fixture(scope="module")
def bundled() -> WorldModel:
    return WorldModel.from_pretrained()


@pytest.fixture(scope="module")
def pictures() -> np.ndarray:
    return observed(30)


def said(world_model: WorldModel, picture: np.ndarray) -> list[str]:
    """The warnings about a picture, which `rollout` and `parse` agree on."""
    found = []
    for call in (lambda: world_model.rollout(picture, TEXT, horizon=1), lambda: world_model.parse(picture[None])):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
        assert all(Path(one.filename).name == Path(__file__).name for one in caught)  # points at the caller
        found.append([str(one.message) for one in caught if one.category is ForeignPictureWarning])
    assert found[0] == found[1]
    return found[0]


def test_own_pictures_are_not_warned_of(bundled: WorldModel, pictures: np.ndarray) -> None:
    assert [said(bundled, picture) for picture in pictures] == [[]] * len(pictures)


def gray(picture: np.ndarray) -> np.ndarray:
    return np.repeat((picture @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)[..., None], 3, axis=-1)


@pytest.mark.parametrize(
    ("change", "cause", "least"),
    [
        (gray, "is gray, its three channels are equal", 1.0),
        (lambda picture: picture[..., ::-1], r"has red and blue swapped (BGR): image[..., ::-1]", 1.0),
        (lambda picture: picture[::-1], "is upside down: image[::-1]", 0.5),  # the others are redrawn well enough
        (np.zeros_like, "is all of one colour: black, as a 0..1 picture cast to uint8", 1.0),
        (lambda picture: np.full_like(picture, 200), "is all of one colour.", 1.0),
        (lambda picture: 255 - picture, "shows another camera, scene or light", 1.0),  # redrawn well, but not its table
    ],
)
def test_the_likely_cause_is_named(
    bundled: WorldModel, pictures: np.ndarray, change: Change, cause: str, least: float
) -> None:
    found = [said(bundled, np.ascontiguousarray(change(picture))) for picture in pictures[:12]]
    named = [len(one) == 1 and cause in one[0] for one in found]
    assert np.mean(named) >= least, found
    assert all(name or not one for name, one in zip(named, found, strict=True))  # and no other cause


def test_another_camera_is_told(bundled: WorldModel) -> None:
    for picture in observed(6, "paper"):
        (message,) = said(bundled, picture)
        assert "shows another camera, scene or light" in message


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.25])
def test_other_light_is_no_swap_of_channels(bundled: WorldModel, pictures: np.ndarray, factor: float) -> None:
    for picture in pictures[:12]:
        its_light = said(bundled, (picture * factor).clip(0, 255).astype(np.uint8))
        assert len(its_light) == 1 and "times the light, which was put right" in its_light[0]


def test_one_foreign_picture_of_several_is_enough(bundled: WorldModel, pictures: np.ndarray) -> None:
    with pytest.warns(ForeignPictureWarning, match="gray") as caught:
        bundled.rollout(np.stack([pictures[0], gray(pictures[1]), gray(pictures[2])]), TEXT, horizon=1)
    assert len([one for one in caught if one.category is ForeignPictureWarning]) == 1


def without_figures(world_model: WorldModel) -> WorldModel:
    loaded = WorldModel.from_pretrained()
    loaded.model.config = replace(world_model.model.config, own_frames=None)
    return loaded


def test_a_checkpoint_without_figures_warns_of_nothing(bundled: WorldModel, pictures: np.ndarray) -> None:
    silent = without_figures(bundled)
    assert not said(silent, gray(pictures[0])) and not said(silent, np.zeros_like(pictures[0]))


def test_looking_changes_nothing(bundled: WorldModel, pictures: np.ndarray) -> None:
    a, b = (one.rollout(pictures[:3], TEXT, horizon=3) for one in (bundled, without_figures(bundled)))
    assert torch.equal(a.slots, b.slots)


def test_a_picture_is_redrawn_once_however_many_sentences(bundled: WorldModel, pictures: np.ndarray) -> None:
    drawn: list[int] = []
    hook = bundled.model.renderer.register_forward_hook(lambda _, slots, result: drawn.append(len(slots[0])))
    rollout = bundled.rollout(pictures[0], [TEXT] * 4, horizon=2)
    assert drawn == [1]
    bundled.rollout(rollout, TEXT, horizon=2)  # nothing new was seen
    bundled.parse(np.stack([pictures[0]] * 5))  # only the first of five frames
    assert drawn == [1, 1]
    hook.remove()


def test_too_few_slots_are_the_users_choice(bundled: WorldModel, pictures: np.ndarray) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bundled.rollout(pictures[0], TEXT, horizon=1, num_slots=2)


def test_a_planner_on_another_camera_warns_once(bundled: WorldModel) -> None:
    """As Python filters warnings by default: one line for two episodes of several plans."""
    env = gym.make("PutBlockInBowl-v0", control="primitive", camera="paper")
    for part in ("scipy.optimize", "scipy.ndimage"):  # whose first use makes Python forget what it has shown
        importlib.import_module(part)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        plans = [run_episode(env, BeamPlanner(bundled), seed=seed).steps for seed in (1, 2)]
    env.close()
    assert sum(plans) > 2
    assert len([one for one in caught if "another camera" in str(one.message)]) == 1


def test_the_command_line_says_it_in_a_line(capsys, tmp_path: Path, pictures: np.ndarray) -> None:
    Image.fromarray(pictures[0][..., ::-1].copy()).save(tmp_path / "bgr.png")
    arguments = ["rollout", str(tmp_path / "bgr.png"), TEXT, "--horizon", "1", "--out", str(tmp_path / "a.png")]
    assert cli.main(arguments) == 0
    err = capsys.readouterr().err
    assert err.startswith("textocvp: warning: the picture does not look like") and "(BGR)" in err


def test_thresholds_decide(scene: np.ndarray) -> None:
    """A random model redraws nothing well; what is usual for it is no reason to warn."""
    model = build(PLACED)
    model.config = replace(model.config, own_frames=OwnFrames(2, 1.0, 1.0))
    assert not said(WorldModel(model), scene)
    assert "is gray" in said(WorldModel(model), gray(scene))[0]
    model.config = replace(model.config, own_frames=OwnFrames(2, 1.0, 1.0, gray=True))
    assert not said(WorldModel(model), gray(scene))
    model.config = replace(model.config, own_frames=OwnFrames(2, 9.0, 99.0))
    assert "this parser has learnt too little (9 dB)" in said(WorldModel(model), scene)[0]
    model.config = replace(model.config, own_frames=OwnFrames(2, 99.0, 99.0))
    assert "another camera, scene or light" in said(WorldModel(model), scene)[0]
