"""Every example of docs/extending.md does what the page says, in the package as it is."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import h5py
import imageio.v3 as iio
import numpy as np
import pytest

from envs import Expert
from envs.dataset import EpisodeConfig, record_episode
from envs.splits import SPLITS
from envs.tasks import TASKS
from experiments.study.methods import METHODS, lines
from planning import RELATIONS, Goal, run_episode
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import WorldModel
from textocvp.baselines import BASELINES
from textocvp.config import with_settings
from textocvp.data import FORMATS, open_episodes
from textocvp.model import TextOCVP
from textocvp.parsers import PARSERS
from textocvp.predictors import PREDICTORS
from textocvp.presets import PRESETS
from textocvp.protocols import load_model
from textocvp.text import ENCODERS
from textocvp.training import parser, predictor

PAGE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"
TABLES = (TASKS, SPLITS, RELATIONS, FORMATS, PARSERS, ENCODERS, PREDICTORS, METHODS, BASELINES, PRESETS)
SMALL = ("parser.image_size=32", "predictor.layers=1", "predictor.dim=16", "predictor.heads=2", "predictor.hidden=16")


@pytest.fixture(autouse=True)
def tables_as_they_are() -> Iterator[None]:
    """The examples add lines to tables of the package; afterwards they are as before."""
    before = [dict(table) for table in TABLES]
    yield
    for table, old in zip(TABLES, before, strict=True):
        table.clear()
        table.update(old)
    gym.registry.pop("PutBlockBesideBlock-v0", None)


def example(name: str) -> dict[str, Any]:
    """Run the page's blocks of that name, in order; returns what they define."""
    blocks = re.findall(rf"^```python {name}\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert blocks, f"{PAGE.name} has no example of {name}"
    module = sys.modules[f"example_{name}"] = ModuleType(f"example_{name}")  # where dataclasses look up their types
    for block in blocks:
        exec(compile(block, f"{PAGE.name}: {name}", "exec", dont_inherit=True), module.__dict__)
    return vars(module)


def test_every_block_is_run() -> None:
    marks = set(re.findall(r"^```(\w+.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert marks == {f"python {n}" for n in ("task", "data", "parser", "text", "predictor", "planner", "baseline")}


def test_a_task_is_played_recorded_and_understood() -> None:
    example("task")
    env = gym.make("PutBlockBesideBlock-v0")
    for seed in range(3):
        _, info = env.reset(seed=seed, options={"n_bowls": 2})
        assert not info["is_success"]
        for action in Expert(env).actions():
            *_, info = env.step(action)
        assert info["is_success"]
    (asked,) = Goal.parse(info["instruction"]).instructions
    assert asked.relation == "beside" and asked.text == info["instruction"]
    config = EpisodeConfig("beside")
    assert record_episode(config.make(), config, 0).instruction.split()[4] == "beside"


@pytest.fixture
def loose(tmp_path: Path) -> Path:
    """Toy episodes as folders of PNG files."""
    with h5py.File(write_toy_episodes(tmp_path / "toy.h5", [6, 6, 6])) as file:
        captions = {f"clip{i}": text for i, text in enumerate(file["episode/instruction"].asstr())}
        frames = file["frames"][:].reshape(3, 6, 32, 32, 3)
    for name, clip in zip(captions, frames, strict=True):
        (tmp_path / "loose" / name).mkdir(parents=True)
        for t, frame in enumerate(clip):
            iio.imwrite(tmp_path / "loose" / name / f"{t:03d}.png", frame)
    (tmp_path / "loose" / "captions.json").write_text(json.dumps(captions))
    return tmp_path


def train_both(folder: Path, data: Path, *settings: str, preset: str = "tabletop-small") -> WorldModel:
    """Two updates of either stage; the trained model."""
    common = dict(data=data, val=data, steps=2, batch=2, warmup=1)
    changes = (*SMALL, *settings)
    parser.train(parser.ParserTraining(out=folder / "parser", preset=preset, clip=2, set=changes, **common))
    later = [change for change in changes if change.startswith(("predictor.", "text."))]
    stage2 = dict(parser=str(folder / "parser" / "checkpoint"), horizon=2, set=later)
    predictor.train(predictor.PredictorTraining(out=folder / "predictor", **stage2, **common))
    return WorldModel.from_pretrained(folder / "predictor" / "checkpoint")


def test_a_data_set_is_found_and_trains_both_stages(loose: Path) -> None:
    example("data")
    with h5py.File(loose / "toy.h5") as file, open_episodes(loose / "loose") as episodes:
        assert len(episodes) == 3 and episodes.image_size == 32 and episodes.truth(0) is None
        np.testing.assert_array_equal(episodes.frames(1), file["frames"][6:12])
        assert "bowl" in episodes.vocabulary
    model = train_both(loose, loose / "loose")
    assert model.rollout(np.zeros((32, 32, 3), np.uint8), "put the red block", horizon=3).frames.shape[1] == 4


@pytest.mark.parametrize(
    ("name", "preset", "settings", "part"),
    [
        ("parser", "non-oc-small", ("parser.kind=average", "renderer.channels=8"), "parser"),
        ("text", "tabletop-small", ("text.kind=bag", "predictor.color_bias=false"), "text"),
        ("predictor", "tabletop-small", ("predictor.kind=each-alone",), "predictor"),
    ],
)
def test_a_part_is_chosen_by_its_kind_and_trained(name, preset, settings, part, tmp_path: Path) -> None:
    example(name)
    data = write_toy_episodes(tmp_path / "toy.h5", [6, 6, 6])
    before = TextOCVP(with_settings(PRESETS[preset], (*SMALL, *settings)))
    model = train_both(tmp_path, data, *settings, preset=preset).model
    kind = settings[0].partition("=")[2]
    assert getattr(model.config, part).kind == kind and type(getattr(model, part)) is type(getattr(before, part))
    assert model.predictor.uses_text == (name != "predictor")


def test_a_planner_acts_and_is_a_row_of_the_studies() -> None:
    names = example("planner")
    env = gym.make("PutBlockInBowl-v0", control="primitive")
    result = run_episode(env, names["HastyPlanner"](WorldModel.from_pretrained()), seed=20_000_000)
    assert result.success and result.steps == 1
    assert METHODS["hasty"].acts and "hasty" in [line.key for line in lines(["ours", "hasty"])]


def test_a_baseline_is_a_row_and_another_architecture_is_loaded(tmp_path: Path) -> None:
    example("baseline")
    assert METHODS["OCVP-Seq again"].model == "ocvp-seq-small"
    (tmp_path / "config.json").write_text(json.dumps({"architecture": "still"}))
    (tmp_path / "model.safetensors").write_bytes(b"")
    seen = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    frames = load_model(tmp_path).imagine(seen, "put the red block in the blue bowl", horizon=3)
    assert frames.shape == (1, 4, 3, 64, 64)
    np.testing.assert_array_equal((frames[0, 3].permute(1, 2, 0) * 255).round().byte().numpy(), seen)
