"""Goals and states as numbers, and the rewards: what policies learn from that read no sentences and no pictures."""

from __future__ import annotations

import copy
import gc
import pickle
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from envs import Expert
from envs.colors import COLORS
from envs.goals import BEFORE, GOALS, REWARDS, compute_reward
from envs.tasks.rearrange import FAMILIES

Make = Callable[..., gym.Env[Any, Any]]
IDS = ("PutBlockInBowl-v0", "PutBlocksInBowls-v0", "RearrangeBlocks-v0")
NUMBERS = ("goal", "state")
tiny = partial(gym.make, image_size=16, extras=NUMBERS)


def episode(env: gym.Env[Any, Any], actions: Iterator[np.ndarray]) -> Iterator[tuple[Any, ...]]:
    """What each step gives, until the end."""
    for action in actions:
        step = env.step(action)
        yield step
        if step[2] or step[3]:
            break


def anything(env: gym.Env[Any, Any], count: int) -> Iterator[np.ndarray]:
    """Random actions; every other primitive picks at a block, so that something happens."""
    world = env.unwrapped.world
    for number in range(count):
        action = env.action_space.sample()
        if number % 2 and env.unwrapped.control == "primitive":
            index = number % len(world.objects)
            action[:2] = np.clip(world.pose(index)[0][:2], env.action_space.low[:2], env.action_space.high[:2])
        yield action


# -- What the numbers say ------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_the_state_is_what_the_info_says(make: Make, control: str) -> None:
    env = make(image_size=16, extras=NUMBERS, control=control)
    observation, info = env.reset(seed=1, options={"n_objects": 5})
    for _ in range(2):
        gripper, rows = observation["state"][:5], observation["state"][5:].reshape(8, 16)
        assert np.allclose(gripper[:3], info["gripper"]["position"], atol=1e-6)
        assert gripper[4] == (info["gripper"]["holding"] >= 0)
        assert rows[:, 0].tolist() == [1] * 5 + [0] * 3 and not rows[5:].any()
        for row, item in zip(rows, info["objects"], strict=False):
            assert row[1] == (item["kind"] == "bowl")
            assert np.flatnonzero(row[2:13]).tolist() == [list(COLORS).index(item["color"])]
            assert np.allclose(row[13:], item["position"], atol=1e-6)
        observation, *_, info = env.step(env.action_space.sample())


def test_the_goal_names_the_things_and_their_places(make: Make) -> None:
    env = make("PutBlocksInBowls-v0", image_size=16, extras=NUMBERS, n_pairs=2)
    observation, info = env.reset(seed=3)
    positions = [item["position"] for item in info["objects"]]
    assert info["target"].shape == (3, 2) and info["target"][2].tolist() == [-1, -1]
    for action in Expert(env).actions():
        desired, achieved = (observation[name][:-3].reshape(8, 12) for name in ("desired_goal", "achieved_goal"))
        left = observation["goal"].reshape(8, 15)
        for thing, target in info["target"][:2]:
            done = info["supports"][thing] == target
            assert np.flatnonzero(desired[thing, :9]).tolist() == [1 + target]
            assert np.flatnonzero(achieved[thing, :9]).tolist() == [1 + target] * int(done)
            assert np.allclose(desired[thing, 9:], positions[target], atol=1e-6)
            assert np.allclose(achieved[thing, 9:], positions[thing], atol=1e-6)
            now = np.concatenate([desired[thing, :9], achieved[thing, 9:], desired[thing, 9:]])
            assert np.array_equal(left[thing], now * (not done)), "what is done is not left to do"
        others = [index for index in range(8) if index not in info["target"][:, 0]]
        assert not desired[others].any() and not achieved[others].any() and not left[others].any()
        observation, *_, info = env.step(action)
        positions = [item["position"] for item in info["objects"]]
    assert info["is_success"] and not observation["goal"].any()


def test_the_goal_of_a_picture_is_what_it_shows(make: Make) -> None:
    env = make("RearrangeBlocks-v0", image_size=16, extras=NUMBERS)
    tables = 0
    for seed in range(8):
        observation, info = env.reset(seed=seed, options={"family": "picture"})
        rows = observation["desired_goal"][:-3].reshape(8, 20)
        for index, (item, support) in enumerate(zip(info["objects"], info["goal_supports"], strict=True)):
            if item["kind"] == "bowl":
                assert not rows[index].any()
                continue
            on_block = support >= 0 and info["objects"][support]["kind"] == "block"
            column = 0 if support < 0 else 1 + support + 8 * on_block
            assert np.flatnonzero(rows[index, :17]).tolist() == [column]
            tables += column == 0
    assert tables


def test_two_sentences_over_one_scene_are_two_goals(make: Make) -> None:
    env = make(image_size=16, extras=NUMBERS)
    _, info = env.reset(seed=9, options={"n_bowls": 3})
    block = next(item["color"] for item in info["objects"] if item["kind"] == "block")
    seen = []
    for bowl in (item["color"] for item in info["objects"] if item["kind"] == "bowl"):
        options = {"layout": info["objects"], "instruction": f"put the {block} block in the {bowl} bowl"}
        seen.append(env.reset(seed=9, options=options)[0])
    assert all(np.array_equal(one["state"], seen[0]["state"]) for one in seen)
    for name in ("goal", "desired_goal"):
        assert len({one[name].tobytes() for one in seen}) == 3


def test_things_far_away_stay_within_the_space(make: Make) -> None:
    env = make(image_size=16, extras=NUMBERS, control="ee")
    _, info = env.reset(seed=0)
    world = env.unwrapped.world
    thing = world.objects[info["target"][0, 0]]
    world.bullet.resetBasePositionAndOrientation(thing, (50.0, 0.0, -90.0), [0, 0, 0, 1])
    observation = env.step(np.zeros(5, np.float32))[0]
    assert env.observation_space.contains(observation) and observation["state"].min() == -2.0


# -- Rewards -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize("control", ["primitive", "ee"])
@pytest.mark.parametrize("env_id", IDS)
def test_compute_reward_is_the_reward_of_a_step(make: Make, env_id: str, control: str, reward: str) -> None:
    env = make(env_id, image_size=16, extras=NUMBERS, control=control, reward=reward)
    plain = make(env_id, image_size=16, control=control)
    again = env.unwrapped.compute_reward
    seed = REWARDS.index(reward)
    for policy in ("expert", "random"):
        observation, _ = env.reset(seed=seed)
        plain.reset(seed=seed)
        env.action_space.seed(seed)
        before, steps, played = observation["achieved_goal"], [], []
        actions = Expert(env).actions() if policy == "expert" else anything(env, 6)
        for step in episode(env, (played.append(action) or action for action in actions)):
            observation, value, terminated, _, info = step
            assert np.array_equal(info[BEFORE], before)
            before = observation["achieved_goal"]
            assert again(observation["achieved_goal"], observation["desired_goal"], info) == value
            steps.append((observation["achieved_goal"], observation["desired_goal"], info, value))
            if reward == "dense":
                assert value <= 0 and (value == 0 or not info["is_success"])
                assert value == 0 or not terminated
                assert (value == 0) == all(env.unwrapped._fulfilled())
        achieved, desired, infos, values = zip(*steps, strict=True)
        batch = again(np.array(achieved), np.array(desired), np.array(infos))
        assert batch.tolist() == list(values)
        if reward == "sparse":  # the same as without the extras
            assert values == tuple(step[1] for step in episode(plain, iter(played)))
        if policy == "expert":
            assert terminated and (sum(values) > 0 if reward == "sparse" else value == 0)


def test_the_dense_reward_is_its_formula_and_rises_on_the_way(make: Make) -> None:
    env = make(image_size=16, control="ee", extras=NUMBERS, reward="dense")
    for seed in range(3):
        _, info = env.reset(seed=seed)
        thing, bowl = info["target"][0]
        values = []
        for _, value, _, _, info in episode(env, Expert(env).actions()):
            block, place, tip = (
                *(info["objects"][index]["position"] for index in (thing, bowl)),
                info["gripper"]["position"],
            )
            far, reach = np.linalg.norm((block - place)[:2]), np.linalg.norm(block - tip)
            wanted = -(0.5 + 0.25 * min(1, far / 0.5) + 0.25 * min(1, reach / 0.5))
            assert value == pytest.approx(0.0 if value == 0 else wanted, abs=1e-6)
            values.append(value)
        assert values[0] < -0.5 and values[-1] == 0 and np.corrcoef(values, range(len(values)))[0, 1] > 0.7


def test_what_carries_something_else_is_not_solved(make: Make) -> None:
    """In `RearrangeBlocks-v0` a named block that carries another does not count, and the dense reward knows."""
    env = make("RearrangeBlocks-v0", image_size=16, extras=NUMBERS, reward="dense")
    layout = [
        {"kind": "block", "color": "red", "xy": (0.45, -0.12)},
        {"kind": "bowl", "color": "blue", "xy": (0.55, 0.1)},
        {"kind": "block", "color": "green", "xy": (0.6, -0.1)},
    ]
    text = "put the red block in the blue bowl"
    env.reset(options={"layout": layout, "instruction": text})
    rewards = []
    for sentence in (text, "put the green block in the blue bowl", "put the green block in the blue bowl"):
        pick = next(Expert(env).actions(sentence))
        if len(rewards) == 2:
            pick[2:] = 0.6, -0.1  # off again
        rewards.append(env.step(pick)[1])
    assert rewards[0] == rewards[2] == 0 and rewards[1] < -0.5


def test_compute_reward_says_what_it_needs(make: Make) -> None:
    env = make(image_size=16, extras=NUMBERS)
    observation, info = env.reset(seed=0)
    goals = [observation[name] for name in GOALS]
    for wrong in ({}, None, [{}]):
        with pytest.raises(ValueError, match=r"needs info\['achieved_before'\].*copy_info_dict=True"):
            env.unwrapped.compute_reward(*goals, wrong)
    assert compute_reward("dense", *goals) < 0
    assert compute_reward("sparse", *goals, info) == 0
    assert compute_reward("sparse", goals[0], 0 * goals[1], info) == 0, "a goal that asks for nothing"
    # Libraries take an environment that has it for one with goals.
    assert not hasattr(make(image_size=16).unwrapped, "compute_reward")
    with pytest.raises(ValueError, match="unknown reward 'shaped'; allowed: 'sparse', 'dense'"):
        gym.make(IDS[0], reward="shaped")


# -- Other libraries -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("control", "reward"), [("primitive", "dense"), ("ee", "sparse")])
@pytest.mark.parametrize("env_id", IDS)
def test_the_checkers_find_nothing(env_id: str, control: str, reward: str) -> None:
    env = tiny(env_id, control=control, reward=reward)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*|.*needs a display.*")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("observations", [("state", "goal"), ("state", *GOALS), "goal", ("rgb", "goal"), ("rgb",)])
def test_stable_baselines_checker_finds_nothing(observations: Any) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    for env_id, (control, reward) in product(IDS, [("primitive", "dense"), ("ee", "sparse")]):
        env = gym.make(env_id, observations=observations, control=control, reward=reward, image_size=64)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
            checker.check_env(env.unwrapped)
        env.close()


def test_hindsight_replay_learns_from_both_rewards() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    for reward in REWARDS:
        env = gym.make(IDS[0], observations=("state", *GOALS), reward=reward, image_size=16)
        model = sb3.SAC(
            "MultiInputPolicy",
            wrappers.RescaleAction(env, np.float32(-1), np.float32(1)),
            replay_buffer_class=sb3.HerReplayBuffer,
            replay_buffer_kwargs={"copy_info_dict": reward == "sparse"},
            buffer_size=100,
            learning_starts=10,
            batch_size=8,
            seed=0,
        )
        model.learn(14)
        drawn = model.replay_buffer.sample(32).rewards.numpy()
        assert np.isfinite(drawn).all() and (reward == "sparse" or (drawn <= 0).all())
        env.close()


@pytest.mark.parametrize("vector", [SyncVectorEnv, AsyncVectorEnv])
@pytest.mark.parametrize("env_id", IDS)
def test_vector_environments_join_goals_of_any_length(make: Make, env_id: str, vector: Any) -> None:
    """Also `target`, where one goal has two pairs and the other three."""
    few = {"n_pairs": 2} if env_id == IDS[1] else {}
    many = {"n_pairs": 3} if env_id == IDS[1] else {}
    single = make(env_id, image_size=16, extras=NUMBERS, reward="dense", **few)
    copies = vector(
        [partial(tiny, env_id, reward="dense", record_frames=True, max_steps=2, **own) for own in (few, many)]
    )
    try:
        observation, info = copies.reset(seed=[11, 12])
        alone = single.reset(seed=11)[0]
        copies.action_space.seed(0)
        for number in range(3):
            for name in (*NUMBERS, *GOALS):
                assert number == 2 or np.array_equal(observation[name][0], alone[name])
                assert observation[name].shape == (2, len(alone[name]))
            assert info[BEFORE].shape == (2, len(alone["achieved_goal"]))
            if env_id == IDS[1]:
                assert info["target"].shape == (2, 3, 2)
                assert number or (info["target"] < 0).all(-1).sum(-1).tolist() == [1, 0]
            actions = copies.action_space.sample()
            observation, rewards, _, _, info = copies.step(actions)
            if number < 2:
                alone, reward, *_ = single.step(actions[0])
                assert rewards[0] == reward
    finally:
        copies.close()


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_has_the_same_goals_and_rewards(clone: Any) -> None:
    env = tiny(IDS[1], reward="dense")
    env.reset(seed=2)
    env.step(next(Expert(env).actions()))
    twin = clone(env)
    assert np.array_equal(twin.unwrapped._info()[BEFORE], env.unwrapped._info()[BEFORE])
    action = env.action_space.sample()
    (ours, reward, *_, info), (theirs, other, *_, twin_info) = env.step(action), twin.step(action)
    assert reward == other and np.array_equal(info[BEFORE], twin_info[BEFORE])
    assert all(np.array_equal(ours[name], theirs[name]) for name in (*NUMBERS, *GOALS))
    env.close()
    twin.close()


def test_observations_are_those_that_were_asked_for(make: Make) -> None:
    env = make(image_size=16, observations=("goal", "state"))
    assert set(env.reset(seed=0)[0]) == set(env.observation_space) == {"goal", "state"}
    flat = wrappers.FlattenObservation(env)
    assert flat.observation_space.shape == flat.reset(seed=0)[0].shape == (120 + 133,)
    assert set(make(image_size=16, extras="goal").observation_space) == {"rgb", "instruction", "goal", *GOALS}
    for wrong, message in (
        ({"observations": "goal_rgb"}, "unknown observation 'goal_rgb'; allowed: 'rgb', 'instruction', 'depth'"),
        ({"observations": ()}, "at least one"),
        ({"observations": "rgb", "extras": "depth"}, "goes without extras"),
        ({"extras": "goals"}, "unknown extras 'goals'; allowed: 'depth'"),
    ):
        with pytest.raises(ValueError, match=message):
            gym.make(IDS[0], **wrong)


@pytest.mark.parametrize("scene", ["simple", "cliport"])
@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_rescaled_actions_stay_in_the_space(make: Make, control: str, scene: str) -> None:
    env = make(image_size=16, control=control, scene=scene)
    rescaled = wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    for corner in product((-1, 1), repeat=rescaled.action_space.shape[0]):
        assert env.action_space.contains(rescaled.action(np.array(corner, np.float32)))


# -- Long use ------------------------------------------------------------------------------------------------


def resident_kilobytes() -> int:
    """Memory of this process."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's own figures")
@pytest.mark.parametrize("env_id", [IDS[0], IDS[2]])
def test_time_and_memory_of_resets_stay_flat(env_id: str) -> None:
    """Over 90 resets and as many steps."""
    wishes = {"family": "swap"} if env_id == IDS[2] else {"n_objects": 6}  # families differ in time
    env = tiny(env_id, control="ee", reward="dense", **wishes)
    bullet = env.unwrapped.world.bullet
    seconds, memory = [], []
    for _ in range(6):
        began = time.process_time()
        for seed in range(15):
            _, info = env.reset(seed=seed)
            assert bullet.getNumConstraints() == 0, "nothing is held any more"
            env.step(env.action_space.sample())
            assert bullet.getNumBodies() == 2 + len(info["objects"])
        seconds.append(time.process_time() - began)
        gc.collect()
        memory.append(resident_kilobytes())
    assert memory[-1] - memory[1] < 2000, memory
    assert min(seconds[3:]) < 1.5 * min(seconds[:3]), seconds
    env.close()


def test_the_families_all_have_goals(make: Make) -> None:
    env = make("RearrangeBlocks-v0", image_size=16, extras=NUMBERS)
    for family in FAMILIES:
        observation, _ = env.reset(seed=4, options={"family": family})
        asked = env.unwrapped.task.asked(env.unwrapped.scene)
        assert observation["desired_goal"][:-3].reshape(8, 20)[:, :17].sum() == len(asked) > 0
