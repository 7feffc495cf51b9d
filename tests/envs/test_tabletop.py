from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from envs import Expert

Make = Callable[..., gym.Env[Any, Any]]
EVERYTHING = ("depth", "segmentation", "proprio")
ROOT = Path(__file__).parents[2]

# Prints a hash of everything an episode shows: run in two processes, the lines must be equal.
HASH_AN_EPISODE = """
import hashlib, sys
import gymnasium as gym, envs
env = gym.make("PutBlockInBowl-v0", record_frames=True)
for seed in map(int, sys.argv[1:]):
    _, info = env.reset(seed=seed, options={"arm_start": "random"})
    parts = [b"".join(map(bytes, info["frames"]))]
    for action in envs.Expert(env).actions():
        info = env.step(action)[4]
        parts += map(bytes, [*info["frames"], *info["frame_states"]["object_position"]])
digest = hashlib.sha256(b"".join(parts)).hexdigest()
print("hash", digest)
"""


@pytest.mark.parametrize("env_id", ["PutBlockInBowl-v0", "PutBlocksInBowls-v0"])
@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_gymnasiums_checker_finds_nothing(env_id: str, control: str) -> None:
    env = gym.make(env_id, control=control, extras=EVERYTHING)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Metres are the unit of this project; and this machine may have no display for render_mode "human".
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*|.*needs a display.*")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_observations_and_rewards_have_their_types(make: Make, control: str) -> None:
    env = make(control=control, extras=EVERYTHING)
    observation, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert (float(reward), terminated, truncated) == (0.0, False, False)


def test_the_package_name_in_the_id_is_enough() -> None:
    code = 'import gymnasium as gym; print(gym.make("envs:PutBlockInBowl-v0").reset(seed=0)[0]["instruction"])'
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "put the" in out.stdout


def test_a_seed_is_an_episode_bit_for_bit_in_any_process_and_after_any_other() -> None:
    def digest(*seeds: int) -> str:
        command = [sys.executable, "-c", HASH_AN_EPISODE, *map(str, seeds)]
        out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        return out.split("hash ")[1].strip()

    alone = digest(7)
    assert digest(7) == alone
    assert digest(1, 2, 7) == alone
    assert digest(8) != alone


@pytest.mark.parametrize("vector", [SyncVectorEnv, partial(AsyncVectorEnv, shared_memory=False)])
def test_vector_environments_give_each_copy_its_instruction(make: Make, vector: Any) -> None:
    single = [make().reset(seed=seed)[1]["instruction"] for seed in (11, 12)]
    copies = vector([partial(gym.make, "envs:PutBlockInBowl-v0")] * 2)
    try:
        observation, info = copies.reset(seed=[11, 12])
        assert list(observation["instruction"]) == single
        assert list(info["instruction"]) == single
        assert observation["rgb"].shape == (2, 64, 64, 3)
        assert info["camera"]["intrinsics"].shape == (2, 3, 3)
        assert info["segmentation"].shape == (2, 64, 64)
        assert [len(objects) for objects in info["objects"]] == [6, 6]
        _, _, _, _, info = copies.step(copies.action_space.sample())
        assert list(info["instruction"]) == single
    finally:
        copies.close()


def test_shared_memory_loses_text_observations_but_not_the_info(make: Make) -> None:
    """Gymnasium reads text out of shared memory once, at the start. This pins what users get until that changes."""
    single = [make().reset(seed=seed)[1]["instruction"] for seed in (11, 12)]
    copies = AsyncVectorEnv([partial(gym.make, "envs:PutBlockInBowl-v0")] * 2)
    try:
        observation, info = copies.reset(seed=[11, 12])
        assert all(set(text) == {"a"} for text in observation["instruction"])
        assert list(info["instruction"]) == single
    finally:
        copies.close()


def test_statistics_wrapper_counts_one_success() -> None:
    env = gym.wrappers.RecordEpisodeStatistics(gym.make("PutBlockInBowl-v0"))
    env.reset(seed=0)
    for action in Expert(env).actions():
        info = env.step(action)[4]
    assert info["episode"]["r"] == 1.0 and info["episode"]["l"] == 1
    env.close()


def test_video_wrapper_sees_every_frame(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    env = gym.make("PutBlockInBowl-v0", control="ee", render_mode="rgb_array")
    env = gym.wrappers.RecordVideo(env, str(tmp_path), episode_trigger=lambda episode: True)
    env.reset(seed=0)
    for action in Expert(env).actions():
        env.step(action)
    assert len(env.recorded_frames) in (0, 25)  # 0: the episode ended and its video is written
    env.close()
    assert [path.suffix for path in tmp_path.iterdir()].count(".mp4") == 1


def test_render_gives_the_observation(make: Make) -> None:
    env = make(render_mode="rgb_array")
    observation, _ = env.reset(seed=5)
    assert np.array_equal(env.render(), observation["rgb"])
    env.render()[:] = 0
    assert env.render().any()


def test_info_is_a_fresh_copy(make: Make) -> None:
    env = make(control="ee")
    _, first = env.reset(seed=5)
    kept = first["objects"][0]["position"].copy()
    for value in (first["segmentation"], first["camera"]["intrinsics"], first["target"]):
        value[:] = 77
    first["objects"][0]["position"][:] = 77
    first["objects"].clear()
    _, _, _, _, second = env.step(np.zeros(5, dtype=np.float32))
    assert second["segmentation"].max() < 77 and second["target"].max() < 77
    assert second["camera"]["intrinsics"][2, 2] == 1
    assert np.allclose(second["objects"][0]["position"], kept, atol=1e-3)


def test_info_tells_what_is_held_and_how_long_it_took(make: Make) -> None:
    env = make(control="ee")
    _, start = env.reset(seed=5)
    block = start["target"][0, 0]
    holdings, steps = [], [start["sim_step"]]
    for action in Expert(env).actions():
        info = env.step(action)[4]
        holdings.append(info["gripper"]["holding"])
        steps.append(info["sim_step"])
    assert set(np.diff(steps)) == {16}  # one camera frame is 16 physics steps
    assert set(holdings) == {-1, block}
    assert holdings[0] == holdings[-1] == -1


def test_episodes_truncate_at_max_steps(make: Make) -> None:
    env = make(control="ee", max_steps=3)
    env.reset(seed=0)
    ends = [env.step(np.zeros(5, dtype=np.float32))[3] for _ in range(3)]
    assert ends == [False, False, True]


def test_stepping_before_a_reset_is_an_error() -> None:
    env = gym.make("PutBlockInBowl-v0", disable_env_checker=True).unwrapped
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) first"):
        env.step(np.array([0.5, 0, 0.5, 0], dtype=np.float32))
    env.close()
    env.close()  # closing twice does no harm
