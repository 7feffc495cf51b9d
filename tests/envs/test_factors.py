"""The random factors of scenes: that each does what it says, and nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest

from envs import Expert
from envs.dataset import EpisodeConfig, collect
from envs.factors import FACTORS, NO_FACTORS, SHARES, Factors
from envs.scenes import SCENES

Make = Callable[..., gym.Env[Any, Any]]
ROOT = Path(__file__).parents[2]
ALWAYS = replace(Factors(), **dict.fromkeys(SHARES, 1.0))

HASH_SCENES = """
import hashlib, sys
from envs import TabletopEnv
env = TabletopEnv(scene="varied", image_size=96, record_frames=True)
for seed in map(int, sys.argv[1:]):
    observation, info = env.reset(seed=seed)
parts = [observation["rgb"], info["segmentation"], repr(info["factors"]).encode(), info["instruction"].encode()]
print("hash", hashlib.sha256(b"".join(bytes(part) for part in parts)).hexdigest())
"""


@pytest.mark.parametrize("name", FACTORS)
def test_each_factor_changes_the_picture_and_only_when_it_is_on(make: Make, name: str) -> None:
    others = [other for other in FACTORS if other != name]
    shown = {}
    for key, factors in {"on": ALWAYS.without(others), "off": NO_FACTORS, "all but it": ALWAYS.without([name])}.items():
        env = make(scene="cliport", image_size=96, factors=factors)
        observation, info = env.reset(seed=3, options={"n_bowls": 3})
        shown[key] = observation["rgb"], info["factors"]
    plain, _ = make(scene="cliport", image_size=96).reset(seed=3, options={"n_bowls": 3})
    assert np.array_equal(shown["off"][0], plain["rgb"])
    assert (shown["on"][0] != plain["rgb"]).any(axis=2).mean() > 0.0005
    assert set(shown["on"][1]) == {name} - set(SHARES)
    # Streams do not depend on each other: the other factors have the values that they have with it.
    _, info = make(scene="cliport", image_size=96, factors=ALWAYS).reset(seed=3, options={"n_bowls": 3})
    assert info["factors"] == shown["all but it"][1] | shown["on"][1]


def test_a_factor_can_be_set(make: Make) -> None:
    factors = replace(NO_FACTORS, table_gray=(100, 100), block=(0.05, 0.05))
    env = make(scene="cliport", image_size=96, factors=factors)
    for seed in range(2):
        observation, info = env.reset(seed=seed)
        assert info["factors"] == {"table_gray": 100.0, "block": 0.05}
        assert info["palette"]["table"] == (100, 100, 100)
        assert env.unwrapped.world.sizes.block == 0.05
        assert (observation["rgb"][60] == 100).all(axis=1).any()


def test_values_stay_in_their_ranges_and_fill_them() -> None:
    drawn = [Factors().draw(np.random.default_rng(seed)) for seed in range(200)]
    for name in drawn[0]:
        low, high = getattr(Factors(), name)
        values = np.array([each[name] for each in drawn])
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high


def test_a_seed_is_a_varied_scene_in_any_process_and_after_any_other() -> None:
    def digest(*seeds: int) -> str:
        command = [sys.executable, "-c", HASH_SCENES, *map(str, seeds)]
        out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        return out.split("hash ")[1].strip()

    assert digest(7) == digest(1, 7) != digest(8)


def test_named_things_are_never_doubled(make: Make) -> None:
    env = make(scene="varied", image_size=16, factors=ALWAYS)
    doubles = 0
    for seed in range(40):
        _, info = env.reset(seed=seed, options={"n_objects": 8})
        names = [f"{item['color']} {item['kind']}" for item in info["objects"]]
        assert all(names.count(names[index]) == 1 for index in info["target"].ravel())
        for question in env.unwrapped.task.questions(env.unwrapped.scene.objects):
            assert names.count(names[question.moves]) == names.count(names[question.ends_at]) == 1
        doubles += len(set(names)) < len(names)
        for name in {name for name in names if names.count(name) > 1 and name.endswith("block")}:
            bowl = next(other for other in names if other.endswith("bowl"))
            with pytest.raises(ValueError, match=f"the scene has . objects that are a {name}"):
                Expert(env).actions(f"put the {name} in the {bowl}")
    assert doubles > 20


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_blocks_start_in_bowls_on_blocks_and_in_the_hand(make: Make, control: str) -> None:
    """And the expert goes on from there; a block under another is never asked for."""
    env = make(scene="varied", image_size=16, control=control, factors=ALWAYS)
    seen = {"in": 0, "on": 0}
    for seed in range(8):
        _, start = env.reset(seed=seed, options={"n_objects": 8, "n_bowls": 2})
        scene, sizes = env.unwrapped.scene, env.unwrapped.world.sizes
        block = int(start["target"][0, 0])
        assert start["gripper"]["holding"] == scene.held == block
        assert start["objects"][block]["position"][2] > 2.5 * sizes.block
        for item, info in zip(scene.objects, start["objects"], strict=True):
            below = item.inside if item.on is None else item.on
            if below is None:
                continue
            seen["in" if item.on is None else "on"] += 1
            apart = info["position"] - start["objects"][below]["position"]
            assert np.hypot(*apart[:2]) < sizes.block / 2
            height = sizes.block if item.on is not None else sizes.bowl_floor + sizes.block / 2
            assert apart[2] == pytest.approx(height, abs=0.004)
            asked = {question.moves for question in env.unwrapped.task.questions(scene.objects)}
            assert item.on is None or below not in asked
        for action in Expert(env).actions():
            _, _, terminated, _, info = env.step(action)
        assert terminated and info["is_success"], seed
    assert min(seen.values()) > 3


@pytest.mark.parametrize("factors", [None, ALWAYS])
def test_a_file_shows_its_scenes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factors: Factors | None
) -> None:
    """As docs/data.md says: bit for bit from configuration and seed, and but for what settles from a layout."""
    config = EpisodeConfig("train", "varied", image_size=64, physics_hz=240, factors=factors)
    collect(config, 2, tmp_path / "data" / "varied.h5")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "data.md").read_text().split("## Scenes and factors")[1]
    found: dict[str, Any] = {}
    exec(page.split("```python\n")[1].split("```")[0], found)
    env, info = found["env"], found["info"]
    with h5py.File("data/varied.h5") as file:
        frame, drawn = file["frames"][0], json.loads(file["episode/factors"].asstr()[0])
    assert env.setup.factors == (factors or SCENES["varied"].factors)
    assert np.array_equal(info["frames"][0], frame)
    assert info["factors"] == drawn and len(drawn) == len(FACTORS) - len(SHARES)
    options = {"layout": info["objects"], "factors": drawn, "instruction": info["instruction"]}
    again, _ = env.reset(seed=5, options=options)
    assert (np.abs(again["rgb"].astype(int) - frame) < 20).mean() > 0.99
    env.close()


RED = {"kind": "block", "color": "red", "position": (0.5, 0.2, 0.25)}
BLUE = {"kind": "bowl", "color": "blue", "xy": (0.5, -0.2)}


def test_a_layout_may_double_colours_and_say_what_is_held(make: Make) -> None:
    env = make(scene="cliport", image_size=16)
    layout = [RED, BLUE, RED | {"xy": (0.4, 0.0)}, BLUE | {"color": "red", "xy": (0.6, 0.3)}]
    with pytest.raises(ValueError, match="2 objects that are a red block"):
        env.reset(options={"layout": layout, "instruction": "put the red block in the blue bowl"})
    layout[2] = layout[2] | {"color": "gray"}
    _, info = env.reset(options={"layout": layout, "instruction": "put the gray block in the red bowl"})
    assert info["gripper"]["holding"] == 0 and info["target"].tolist() == [[2, 3]]


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ([RED, BLUE, RED | {"color": "gray", "position": (0.4, 0.0, 0.3)}], "can hold one block at the start"),
        ([RED | {"position": (0.5, 0.2, 0.6)}, BLUE], "cannot hold the red block at .*, 0.6 m high"),
    ],
)
def test_wrong_heights_are_refused(make: Make, layout: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(scene="cliport", image_size=16).reset(options={"layout": layout})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tint": (1, 0)}, r"tint must be a range \(low, high\) or None, not \(1, 0\)"),
        ({"bowl": (1, 2, 3)}, "bowl must be a range"),
        ({"carried": 1.5}, "carried must be a number of 0.0 to 1.0, not 1.5"),
    ],
)
def test_wrong_ranges_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(Factors(), **change)


def test_the_simple_scene_can_have_another_light_but_no_crowd(make: Make) -> None:
    env = make(image_size=32, factors=replace(NO_FACTORS, ambient=(0.3, 0.3)))
    dark, info = env.reset(seed=1)
    plain, _ = make(image_size=32).reset(seed=1)
    darker = dark["rgb"].astype(int) - plain["rgb"]
    assert (darker[info["segmentation"] > 0] < 0).all() and not darker[info["segmentation"] == 0].any()
    with pytest.raises(ValueError, match="the scene 'simple' has no same_color"):
        gym.make("PutBlockInBowl-v0", factors=Factors())


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ([1], "factors are a mapping with some of light_tilt"),
        ({"carried": 1}, "factors are a mapping"),
        ({"tint": [0, 0, 0]}, r"the factor tint is a finite array of shape \(4, 3\)"),
        ({"ambient": float("nan")}, "the factor ambient is a finite array"),
        ({"ambient": "bright"}, "the factor ambient is a finite array"),
    ],
)
def test_wrong_values_are_refused(make: Make, factors: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(scene="cliport", image_size=16).reset(options={"factors": factors})
