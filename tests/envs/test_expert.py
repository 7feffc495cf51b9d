from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs import Expert
from envs.scenes import SIMPLE

Make = Callable[..., gym.Env[Any, Any]]
STARTS = ({}, {"arm_start": "random"}, {"blocks_in_bowls": 2}, {"target_in_bowl": True}, {"n_objects": 8, "n_bowls": 5})


def play(env: gym.Env[Any, Any], instruction: str | None = None) -> tuple[float, bool, dict[str, Any], list[Any]]:
    """Total reward, terminated, last info, and all frames of the expert's episode."""
    total, frames, terminated, info = 0.0, [], False, {}
    for action in Expert(env).actions(instruction):
        assert env.action_space.contains(action)
        _, reward, terminated, _, info = env.step(action)
        total += float(reward)
        frames.append(info["frames"])
    return total, terminated, info, frames


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_the_expert_succeeds(make: Make, control: str) -> None:
    """The claim of 99 % over 500 seeds is measured by benchmarks/expert.py --episodes 500; here, no failure in 20."""
    env = make(control=control, image_size=16, record_frames=True)
    for seed in range(20):
        env.reset(seed=seed, options=STARTS[seed % len(STARTS)])
        reward, terminated, info, _ = play(env)
        assert (reward, terminated, info["is_success"], info["cliport_success"]) == (1.0, True, True, True), seed


@pytest.mark.parametrize("options", STARTS)
def test_a_primitive_moves_as_the_same_motion_in_ee_mode(make: Make, options: dict[str, Any]) -> None:
    frames = {}
    for control in ("primitive", "ee"):
        env = make(control=control, record_frames=True)
        env.reset(seed=42, options=options)
        frames[control] = np.concatenate(play(env)[3])
    assert np.array_equal(frames["primitive"], frames["ee"])


@pytest.mark.parametrize(
    ("stride", "hz", "scale"), [(8, 240, 1.0), (16, 480, 1.0), (16, 240, 0.7), (16, 240, 0.5), (5, 240, 1.0)]
)
def test_the_expert_succeeds_at_other_rates_and_sizes(make: Make, stride: int, hz: int, scale: float) -> None:
    rates = {"render_stride": stride, "physics_hz": hz, "object_scale": scale}
    env = make(control="ee", image_size=16, record_frames=True, **rates)
    for seed in range(2):
        env.reset(seed=seed, options={"blocks_in_bowls": 1})
        assert play(env)[2]["is_success"], seed


def test_an_episode_has_about_25_frames_and_ends_as_it_began(make: Make) -> None:
    env = make(record_frames=True)
    for seed in range(8):
        _, info = env.reset(seed=seed)
        start, named = info["frames"][0], np.isin(info["segmentation"], 2 + info["target"])
        assert [frame.shape for frame in info["frames"]] == [(64, 64, 3)]
        _, _, info, frames = play(env)
        assert 24 <= 1 + len(frames[0]) <= 26
        # But for the block that left and the bowl that got it, nothing shows that the arm was away.
        named |= np.isin(info["segmentation"], 2 + info["target"])
        change = np.abs(frames[0][-1].astype(int) - start)[~named]
        assert (change < 12).mean() > 0.99
        assert np.allclose(info["gripper"]["position"], SIMPLE.arm.home, atol=0.005)


def test_the_expert_plays_every_instruction_of_a_scene(make: Make) -> None:
    env = make(image_size=16, record_frames=True)
    _, start = env.reset(seed=9, options={"n_bowls": 3})
    colors = {kind: [o["color"] for o in start["objects"] if o["kind"] == kind] for kind in ("block", "bowl")}
    pairs = list(product(colors["block"], colors["bowl"]))
    assert len(pairs) == 9
    for block, bowl in pairs:
        instruction = f"put the {block} block in the {bowl} bowl"
        _, info = env.reset(options={"layout": start["objects"], "instruction": instruction})
        assert info["instruction"] == instruction
        assert play(env)[2]["is_success"], instruction


def test_playing_another_instruction_does_not_reach_the_goal(make: Make) -> None:
    env = make(image_size=16, record_frames=True)
    _, info = env.reset(seed=9, options={"n_bowls": 3})
    block, bowl = info["target"][0]
    other = next(o for o in info["objects"] if o["kind"] == "bowl" and o["id"] != bowl)
    instruction = f"put the {info['objects'][block]['color']} block in the {other['color']} bowl"
    reward, terminated, info, _ = play(env, instruction)
    assert (reward, terminated, info["is_success"]) == (0.0, False, False)


@pytest.mark.parametrize("n_pairs", [2, 3])
@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_the_long_horizon_variant_rewards_each_pair(make: Make, n_pairs: int, control: str) -> None:
    env = make("PutBlocksInBowls-v0", n_pairs=n_pairs, control=control, image_size=16, record_frames=True)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        assert observation["instruction"].count(" block in the ") == n_pairs
        assert (info["target"] >= 0).all(-1).tolist() == [True] * n_pairs + [False] * (3 - n_pairs)
        rewards = []
        for action in Expert(env).actions():
            _, reward, terminated, _, info = env.step(action)
            rewards.append(reward)
        assert [r for r in rewards if r] == pytest.approx([1 / n_pairs] * n_pairs)
        assert terminated and info["is_success"]


def test_the_expert_refuses_what_is_not_there(make: Make) -> None:
    env = make()
    _, info = env.reset(seed=1)
    colors = [item["color"] for item in info["objects"]]
    missing = next(color for color in ("white", "orange", "pink", "purple", "red", "blue") if color not in colors)
    with pytest.raises(ValueError, match=f"the scene has no {missing} block; it has: .*bowl"):
        Expert(env).actions(f"put the {missing} block in the {colors[0]} bowl")
    with pytest.raises(TypeError, match="not PendulumEnv"):
        Expert(gym.make("Pendulum-v1"))
