"""Random scenes, explicit layouts, and the splits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs import TASKS, Expert
from envs.colors import CAPTION_COLORS, SEEN
from envs.geometry import SPAWN, Sizes
from envs.splits import SEEDS_PER_SPLIT, SPLITS

Make = Callable[..., gym.Env[Any, Any]]
SIZES = Sizes()
TASK = TASKS["put_block_in_bowl"]


@given(
    seed=st.integers(0, 2**32 - 1),
    n_objects=st.integers(4, 8),
    split=st.sampled_from(sorted(CAPTION_COLORS)),
    filled=st.integers(0, 1),
)
@settings(max_examples=60, deadline=None)
def test_a_random_scene_is_what_was_asked_for(seed: int, n_objects: int, split: Any, filled: int) -> None:
    request = replace(TASK.request(), n_objects=n_objects, color_split=split, blocks_in_bowls=filled)
    scene = TASK.sample(np.random.default_rng(seed), request, SIZES)
    assert len(scene.objects) == n_objects
    assert {item.kind for item in scene.objects} == {"block", "bowl"}
    colors = [item.color for item in scene.objects]
    assert len(set(colors)) == n_objects
    (_, block, bowl), *_ = scene.goal
    assert {scene.objects[block].color, scene.objects[bowl].color} <= set(CAPTION_COLORS[split])
    assert scene.objects[block].inside is None
    inside = [item.inside for item in scene.objects if item.inside is not None]
    assert len(inside) == filled and bowl not in inside
    standing = [item for item in scene.objects if item.inside is None]
    assert all(SPAWN.contains(item.x, item.y) for item in standing)
    for a, b in combinations(standing, 2):
        assert np.hypot(a.x - b.x, a.y - b.y) > SIZES.footprint(a.kind) + SIZES.footprint(b.kind)


def test_the_fullest_scenes_always_find_room() -> None:
    request = replace(TASK.request(), n_objects=8, n_bowls=5)
    for seed in range(15):
        assert len(TASK.sample(np.random.default_rng(seed), request, SIZES).objects) == 8


def test_scenes_start_at_rest_and_unsolved(make: Make) -> None:
    """Nothing slides, tips or sinks in the first second, and what lies in a bowl is seen by the goal's own judge."""
    env = make(control="ee", max_steps=10**6)
    for seed in range(6):
        options = {"blocks_in_bowls": seed % 3, "n_objects": 8 if seed == 5 else 6}
        _, start = env.reset(seed=seed, options=options)
        assert not start["is_success"]
        for _ in range(15):
            _, _, _, _, info = env.step(np.zeros(5, dtype=np.float32))
        for before, after in zip(start["objects"], info["objects"], strict=True):
            assert after["position"] == pytest.approx(before["position"], abs=0.002)
            assert np.abs(after["orientation"][:2]).max() < 0.02  # upright


def test_every_object_is_seen_at_the_start(make: Make) -> None:
    """At least 55 of a block's about 85 pixels at 64x64, and the same share of a bowl."""
    env = make()
    for seed in range(25):
        _, info = env.reset(seed=seed, options={"n_objects": 8 if seed % 2 else 6})
        for item in info["objects"]:
            pixels = int((info["segmentation"] == 2 + item["id"]).sum())
            assert pixels >= (55 if item["kind"] == "block" else 150), (seed, item)


def test_the_named_block_can_start_in_another_bowl(make: Make) -> None:
    env = make()
    for seed in range(4):
        _, info = env.reset(seed=seed, options={"target_in_bowl": True})
        block, bowl = (info["objects"][index] for index in info["target"][0])
        around = [
            item["id"]
            for item in info["objects"]
            if item["kind"] == "bowl" and np.hypot(*(item["position"] - block["position"])[:2]) < 0.02
        ]
        assert len(around) == 1 and around[0] != bowl["id"]
        assert block["position"][2] > SIZES.block / 2 + 0.003  # on the bowl's floor, not on the table


def test_an_instruction_alone_makes_a_scene_for_it(make: Make) -> None:
    text = "put the white block in the pink bowl"
    observation, info = make().reset(seed=0, options={"instruction": text, "n_objects": 4})
    things = {(item["kind"], item["color"]) for item in info["objects"]}
    assert observation["instruction"] == text
    assert {("block", "white"), ("bowl", "pink")} <= things and len(things) == 4


def test_one_scene_can_be_told_other_instructions(make: Make) -> None:
    """What the controllability study does: the first frame is the same, the words differ."""
    env = make()
    first, info = env.reset(seed=21, options={"n_bowls": 5})
    bowls = [item["color"] for item in info["objects"] if item["kind"] == "bowl"]
    for color in bowls:
        text = f"put the {TASK.parse(info['instruction'])[0].thing.color} block in the {color} bowl"
        again, _ = env.reset(options={"layout": info["objects"], "instruction": text})
        assert again["instruction"] == text
        assert (again["rgb"] == first["rgb"]).mean() > 0.995
        again, _ = env.reset(options={"layout": info["objects"]})
        (step,) = TASK.parse(again["instruction"])
        assert {thing.color for thing in step.things} <= set(SEEN)


def test_a_layout_is_built_where_it_says(make: Make) -> None:
    layout = [
        {"kind": "block", "color": "red", "xy": (0.4, -0.1), "yaw": 0.5},
        {"kind": "bowl", "color": "blue", "xy": [0.6, 0.1]},
        {"kind": "block", "color": "pink", "xy": np.array([0.605, 0.105])},
    ]
    layout.append({"kind": "bowl", "color": "green", "xy": (0.4, 0.1)})
    _, info = make().reset(seed=0, options={"layout": layout})
    for item, asked in zip(info["objects"], layout, strict=True):
        assert (item["kind"], item["color"]) == (asked["kind"], asked["color"])
        assert item["position"][:2] == pytest.approx(asked["xy"], abs=0.002)
    _, _, z, w = info["objects"][0]["orientation"]
    assert 2 * np.arctan2(z, w) == pytest.approx(0.5, abs=0.01)


def test_arm_start_poses(make: Make) -> None:
    env = make(extras=("proprio",))
    home, _ = env.reset(seed=0)
    moved, info = env.reset(seed=0, options={"arm_start": "random"})
    assert 0.005 < np.abs(moved["proprio"][:6] - home["proprio"][:6]).max() < 0.2
    given_joints = moved["proprio"][:6].tolist()
    given_joints[3] = -given_joints[1] - given_joints[2]
    given_joints[4] = 0.0
    same, _ = env.reset(seed=0, options={"arm_start": given_joints})
    assert same["proprio"] == pytest.approx(moved["proprio"], abs=1e-3)
    env.step(next(Expert(env).actions()))
    assert info["gripper"]["holding"] == -1


def test_splits_are_disjoint_and_as_described(make: Make) -> None:
    starts = sorted(split.first_seed for split in SPLITS.values())
    assert all(b - a == SEEDS_PER_SPLIT for a, b in pairwise(starts))
    with pytest.raises(ValueError, match="a split has episodes 0 to 9999999"):
        SPLITS["val"].seed(SEEDS_PER_SPLIT)
    env = make()
    for name, n_objects, colors in (
        ("test", 6, "seen"),
        ("unseen_colors", 6, "unseen"),
        ("more_objects", 8, "seen"),
        ("controllability", 6, "seen"),
    ):
        split = SPLITS[name]
        for episode in range(4):
            seed = split.seed(episode)
            _, info = env.reset(seed=seed, options=split.options(seed))
            kinds = [item["kind"] for item in info["objects"]]
            (step,) = TASK.parse(info["instruction"])
            assert len(kinds) == n_objects
            assert {thing.color for thing in step.things} <= set(CAPTION_COLORS[colors])
            assert 1 <= kinds.count("bowl") <= 5 and not info["is_success"]
            if name == "controllability":
                assert kinds.count("bowl") >= 4


def test_about_a_quarter_of_the_scenes_are_mid_task() -> None:
    split = SPLITS["train"]
    options = [split.options(split.seed(episode)) for episode in range(3000)]
    assert np.mean([o["blocks_in_bowls"] > 0 for o in options]) == pytest.approx(0.25, abs=0.04)
    assert np.mean([o["target_in_bowl"] for o in options]) == pytest.approx(0.10, abs=0.02)
    assert np.mean([o["arm_start"] == "random" for o in options]) == pytest.approx(0.10, abs=0.02)
    counts = np.bincount([o["n_bowls"] for o in options])[1:] / len(options)
    assert counts == pytest.approx([0.2] * 5, abs=0.03)
