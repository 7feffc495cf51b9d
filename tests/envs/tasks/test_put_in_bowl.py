"""What must not count as success."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs import Expert

Make = Callable[..., gym.Env[Any, Any]]
LAYOUT = [
    {"kind": "block", "color": "red", "xy": (0.40, -0.12)},
    {"kind": "bowl", "color": "blue", "xy": (0.60, 0.10)},
    {"kind": "bowl", "color": "green", "xy": (0.60, -0.10)},
    {"kind": "block", "color": "yellow", "xy": (0.42, 0.12)},
]
OPTIONS = {"layout": LAYOUT, "instruction": "put the red block in the blue bowl"}
BLOCK, BOWL, OTHER_BOWL = (0.40, -0.12), (0.60, 0.10), (0.60, -0.10)


def after(env: gym.Env[Any, Any], pick: tuple[float, float], place: tuple[float, float]) -> tuple[Any, ...]:
    """Reward, terminated and info after one primitive in the fixed scene."""
    env.reset(seed=0, options=OPTIONS)
    _, reward, terminated, _, info = env.step(np.array([*pick, *place], dtype=np.float32))
    return reward, terminated, info


def position(info: dict[str, Any], index: int) -> np.ndarray:
    return info["objects"][index]["position"]


def test_the_right_action_succeeds(make: Make) -> None:
    reward, terminated, info = after(make(), BLOCK, BOWL)
    assert (reward, terminated, info["is_success"], info["cliport_success"]) == (1, True, True, True)
    assert position(info, 0)[:2] == pytest.approx(BOWL, abs=0.01)


def test_the_wrong_bowl_is_a_failure(make: Make) -> None:
    reward, terminated, info = after(make(), BLOCK, OTHER_BOWL)
    assert (reward, terminated, info["is_success"], info["cliport_success"]) == (0, False, False, False)
    assert position(info, 0)[:2] == pytest.approx(OTHER_BOWL, abs=0.01)  # it did go there


def test_the_wrong_block_is_a_failure(make: Make) -> None:
    _, _, info = after(make(), (0.42, 0.12), BOWL)
    assert not info["is_success"]
    assert position(info, 3)[:2] == pytest.approx(BOWL, abs=0.01)


def test_a_block_dropped_beside_the_bowl_is_a_failure(make: Make) -> None:
    _, _, info = after(make(), BLOCK, (0.45, 0.05))
    assert not info["is_success"]
    assert position(info, 0)[2] == pytest.approx(0.029, abs=0.003)  # it lies on the table


@pytest.mark.parametrize("pick", [(0.50, 0.0), (0.60, -0.10)])
def test_a_missed_pick_moves_nothing_but_the_arm(make: Make, pick: tuple[float, float]) -> None:
    """On the bare table and, second, in a bowl, whose floor no cup can lift."""
    env = make(record_frames=True)
    _, start = env.reset(seed=0, options=OPTIONS)
    _, reward, _, _, info = env.step(np.array([*pick, *BOWL], dtype=np.float32))
    assert reward == 0 and not info["is_success"]
    assert not np.array(info["frame_states"]["gripper"])[:, 4].any()  # never held anything
    assert len(info["frames"]) >= 24  # yet performed the whole motion
    for index in range(4):
        assert position(info, index) == pytest.approx(position(start, index), abs=0.005)


def test_a_block_still_held_in_the_bowl_is_no_success(make: Make) -> None:
    env = make(control="ee")
    env.reset(seed=0, options=OPTIONS)
    near, held = [], []
    for action in Expert(env).actions():
        _, _, terminated, _, info = env.step(action)
        if info["gripper"]["holding"] == 0:
            assert not info["is_success"] and not terminated
            near.append(info["cliport_success"])
        held.append(info["gripper"]["holding"])
    assert near[-1]  # CLIPort's criterion does not mind
    assert info["is_success"]


def test_a_block_let_go_high_above_the_table_falls_and_fails(make: Make) -> None:
    env = make(control="ee")
    env.reset(seed=0, options=OPTIONS)
    dropped = False
    for action in Expert(env).actions():
        # On the way to the bowl, lose the block.
        if env.unwrapped.robot.holding == 0 and env.unwrapped.world.pose(0)[0][0] > 0.5:
            dropped = True
        _, _, _, _, info = env.step(np.append(action[:4], np.float32(0)) if dropped else action)
    assert dropped and not info["is_success"]
    assert info["gripper"]["holding"] == -1


def test_a_block_leaning_on_the_rim_is_no_success(make: Make) -> None:
    """Its centre is within 5 cm of the bowl's, which is enough for CLIPort, but it does not lie in the bowl."""
    env = make().unwrapped
    _, info = env.reset(seed=0, options=OPTIONS)
    bowl = position(info, 1)
    body = env.world.objects[0]
    beside = bowl + np.array((0.045, 0, 0.10))
    env.world.bullet.resetBasePositionAndOrientation(body, beside, [0, 0, 0, 1])
    again = env._info()
    assert again["cliport_success"] and not again["is_success"]


def test_a_second_primitive_repairs_the_first(make: Make) -> None:
    env = make()
    _, _, info = after(env, BLOCK, OTHER_BOWL)
    _, reward, terminated, _, info = env.step(np.array([*OTHER_BOWL, *BOWL], dtype=np.float32))
    assert (reward, terminated, info["is_success"]) == (1, True, True)


def test_place_yaw_turns_the_block(make: Make) -> None:
    env = make(place_yaw=True)
    env.reset(seed=0, options=OPTIONS)
    _, _, _, _, info = env.step(np.array([*BLOCK, 0.5, 0.0, 0.7], dtype=np.float32))
    x, y, z, w = info["objects"][0]["orientation"]
    assert np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) == pytest.approx(0.7, abs=0.05)
    assert info["gripper"]["yaw"] == pytest.approx(0, abs=1e-3)  # and turns back
