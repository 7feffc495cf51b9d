"""The scene "cliport": the measures of CLIPort's own episodes."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs import Expert
from envs.geometry import SIZES
from envs.scenes import CLIPORT

Make = Callable[..., gym.Env[Any, Any]]


def play(env: gym.Env[Any, Any], **reset: Any) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """The last info, the frames and the joint angles (T, 6) of the expert's episode."""
    _, info = env.reset(**reset)
    infos = [info]
    for action in Expert(env).actions():
        infos.append(env.step(action)[4])
    frames = np.concatenate([each["frames"] for each in infos])
    return infos[-1], frames, np.concatenate([each["frame_states"]["arm"] for each in infos])


def test_objects_have_the_size_of_cliports(make: Make) -> None:
    """At 336x336, blocks of 4 cm are 10 to 15 pixels wide, and bowls 25 to 35."""
    env = make(scene="cliport", sizes="cliport", image_size=336)
    widths: dict[str, list[int]] = {"block": [], "bowl": []}
    for seed in range(12):
        _, info = env.reset(seed=seed)
        for item in info["objects"]:
            widths[item["kind"]].append(np.ptp(np.nonzero(info["segmentation"] == item["label"])[1]) + 1)
    assert 10 <= np.median(widths["block"]) <= 15 and min(widths["block"]) >= 10
    assert 25 <= np.median(widths["bowl"]) <= 35
    assert min(widths["bowl"]) >= 23 and max(widths["bowl"]) <= 37
    assert (SIZES["cliport"].block, 2 * SIZES["cliport"].bowl_radius) == (0.04, pytest.approx(0.114))


@pytest.mark.parametrize("scene", ["cliport", "varied"])
def test_objects_stand_on_the_table_and_all_over_it(make: Make, scene: str) -> None:
    env = make(scene=scene, image_size=16)
    places = []
    for seed in range(40):
        _, info = env.reset(seed=seed, options={"n_objects": 8})
        sizes = env.unwrapped.world.sizes
        for item in info["objects"]:
            if item["id"] != info["gripper"]["holding"]:
                assert CLIPORT.table.shrunk(sizes.footprint(item["kind"])).contains(*item["position"][:2])
            places.append(item["position"][:2])
    low, high = np.min(places, axis=0), np.max(places, axis=0)
    assert low == pytest.approx((0.31, -0.44), abs=0.03) and high == pytest.approx((0.69, 0.44), abs=0.03)


def test_the_arm_rests_as_cliports_and_is_seen_whole(make: Make) -> None:
    env = make(scene="cliport", image_size=336, extras=("proprio",))
    observation, info = env.reset(seed=0)
    pan, lift, elbow, wrist1, wrist2, _ = observation["proprio"][:6]
    as_ur = np.array([pan - pi, lift, elbow, wrist1 - pi / 2, wrist2 - pi / 2]) / pi
    assert as_ur == pytest.approx((-1, -0.5, 0.5, -0.5, -0.5), abs=1e-3)
    assert info["gripper"]["position"] == pytest.approx((0.487, 0.109, 0.312), abs=0.002)
    arm = info["segmentation"] == 1
    assert 0.05 < arm.mean() < 0.09
    assert not (arm[0].any() or arm[:, 0].any() or arm[:, -1].any())


def test_an_episode_has_about_50_frames_and_ends_as_it_began(make: Make) -> None:
    env = make(scene="cliport", image_size=64, record_frames=True)
    counts = []
    for seed in range(8):
        info, frames, joints = play(env, seed=seed)
        assert info["is_success"] and len(frames) == len(joints)
        assert joints[-1] == pytest.approx(joints[0], abs=0.01)
        counts.append(len(frames))
    assert min(counts) >= 40 and max(counts) <= 68 and 46 <= np.mean(counts) <= 58


def test_joints_move_along_straight_lines_at_a_constant_speed(make: Make) -> None:
    """The first frames, from home to above the block: 5 rad/s, as in CLIPort's episodes."""
    env = make(scene="cliport", image_size=16, record_frames=True)
    layout = [
        {"kind": "block", "color": "red", "xy": (0.55, -0.35)},
        {"kind": "bowl", "color": "blue", "xy": (0.45, 0.3)},
    ]
    _, _, joints = play(env, seed=0, options={"layout": layout})
    # In frame 1 the arm still gathers speed, and it brakes in the last of the 8.
    steps = np.diff(joints[1:7].astype(float), axis=0)
    speeds = np.linalg.norm(steps, axis=1) * 30
    assert speeds == pytest.approx(speeds.mean(), rel=0.03) and 4.2 < speeds.mean() <= 5.05
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    assert (directions @ directions[0]).min() > 0.99


def test_labels_and_palette_are_what_is_drawn(make: Make) -> None:
    """At the centre of things, where no pixel is mixed: labels tell the objects' own colours and grays."""
    env = make(scene="cliport", image_size=336)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        rgb, segmentation, palette = observation["rgb"].astype(float), info["segmentation"], info["palette"]
        assert set(np.unique(segmentation)) == {0, 1, *(item["label"] for item in info["objects"])}
        background = rgb[segmentation == 0]
        exact = (background == palette["table"]).all(axis=1) | (background == 239).all(axis=1)
        assert exact.mean() > 0.985
        for item in info["objects"]:
            share = np.median(rgb[segmentation == item["label"]] / palette["colors"][item["color"]], axis=0)
            assert share.min() > 0.55 and share.max() < 1.0 and np.ptp(share) < 0.03
        arm = rgb[segmentation == 1]
        gray = np.ptp(arm, axis=1) < 12
        assert gray.mean() > 0.9 and palette["robot"] == (50, 50, 50)
        # Most of it has the dark gray, in or out of the light; the rest lighter ones.
        assert (np.abs(arm[:, 0] - 40) < 12).mean() > 0.4


def test_frames_are_means_of_larger_ones(make: Make) -> None:
    """Edges are smooth: mixed colours lie along the table's slanted edge, and nowhere else in the background."""
    observation, info = make(scene="cliport", image_size=336).reset(seed=0)
    free = observation["rgb"][..., 0][info["segmentation"] == 0]
    mixed = (free != 47) & (free != 239)
    assert 0.0005 < mixed.mean() < 0.015
    assert {95, 143, 191} <= set(np.unique(free).tolist())


@pytest.mark.parametrize("scene", ["cliport", "varied"])
def test_a_primitive_moves_as_the_same_motion_in_ee_mode(make: Make, scene: str) -> None:
    for seed in range(2):
        shown = [
            play(make(scene=scene, image_size=48, control=control, record_frames=True), seed=seed)[1]
            for control in ("primitive", "ee")
        ]
        assert np.array_equal(*shown)


@pytest.mark.parametrize("scene", ["cliport", "varied"])
def test_several_sentences_follow_each_other(make: Make, scene: str) -> None:
    env = make("PutBlocksInBowls-v0", scene=scene, image_size=16, n_pairs=3)
    for seed in range(3):
        env.reset(seed=seed, options={"n_objects": 8})
        for action in Expert(env).actions():
            _, _, terminated, _, info = env.step(action)
        assert terminated and info["is_success"]


def test_the_expert_reaches_the_tables_corners(make: Make) -> None:
    """There the arm is too short for the usual height and hangs lower."""
    env = make(scene="cliport", image_size=16, record_frames=True)
    for x, y in ((0.68, -0.43), (0.68, 0.43), (0.32, -0.43), (0.32, 0.43)):
        layout = [
            {"kind": "block", "color": "red", "xy": (x, y)},
            {"kind": "bowl", "color": "blue", "xy": (1.0 - x, -0.85 * y)},
        ]
        info, *_ = play(env, seed=0, options={"layout": layout})
        assert info["is_success"], (x, y)


def test_far_tool_motions_stay_within_reach(make: Make) -> None:
    """Whatever is asked, the tool stays upright and where the arm can be."""
    env = make(scene="cliport", image_size=16, control="ee", max_steps=10**6)
    env.reset(seed=0)
    low, high = env.action_space.low, env.action_space.high
    for corner in ((1, 1, 1), (1, -1, 1), (0, 0, 0), (1, 1, 0), (0, 1, 1)):
        action = np.where(np.array([*corner, 0, 0], dtype=bool), high, low).astype(np.float32)
        action[3:] = 0
        for _ in range(25):
            _, _, _, _, info = env.step(action)
        assert np.isfinite(info["gripper"]["position"]).all()
        arm = env.unwrapped.robot.arm
        assert arm.within_reach(env.unwrapped.robot.target) == pytest.approx(env.unwrapped.robot.target)
