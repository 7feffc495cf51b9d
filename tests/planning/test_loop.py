"""The closed loop in PyBullet, with the oracle in place of a trained world model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import envs  # noqa: F401  (registers the environments)
from planning import (
    AppearanceGrounder,
    BeamPlanner,
    Controller,
    Goal,
    Grounder,
    Grounding,
    Instruction,
    PickAndPlace,
    PinholeCamera,
    RandomPlanner,
    SegmentationGrounder,
    run_episode,
)
from tests.planning.conftest import put_in
from tests.planning.oracle import OracleWorldModel
from textocvp.rollout import Rollout


class CameraOnly(gym.Wrapper):  # type: ignore[type-arg]
    """Strips `info` of everything a real robot would not have; `is_success` stays, for the result."""

    KNOWN = ("camera", "palette", "is_success", "instruction")

    def reset(self, **kwargs: Any) -> Any:
        obs, info = self.env.reset(**kwargs)
        return {"rgb": obs["rgb"]}, {key: info[key] for key in self.KNOWN}

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        return {"rgb": obs["rgb"]}, reward, terminated, truncated, {key: info[key] for key in self.KNOWN}


class Missing(gym.Wrapper):  # type: ignore[type-arg]
    """A clumsy robot: the first `misses` picks land 10 cm beside the block."""

    def __init__(self, env: gym.Env[Any, Any], misses: int) -> None:
        super().__init__(env)
        self.left = misses

    def step(self, action: Any) -> Any:
        if self.left > 0:
            self.left -= 1
            x = action[0] - 0.1 if action[0] > 0.5 else action[0] + 0.1
            action = np.array([x, *action[1:]], dtype=np.float32)
        return self.env.step(action)


def objects_now(env: gym.Env[Any, Any]) -> list[dict[str, Any]]:
    """The simulator's truth, for the oracle only."""
    base = env.unwrapped
    return [
        {"kind": item.kind, "color": item.color, "position": base.world.pose(i)[0]}
        for i, item in enumerate(base.scene.objects)
    ]


@pytest.fixture
def env() -> Iterator[gym.Env[Any, Any]]:
    env = gym.make("PutBlockInBowl-v0")
    yield env
    env.close()


def oracle_for(env: gym.Env[Any, Any], seed: int, options: dict[str, Any] | None = None) -> OracleWorldModel:
    _, info = env.reset(seed=seed, options=options)
    return OracleWorldModel(lambda: objects_now(env), PinholeCamera.from_info(info["camera"]))


def one_step(world_model: OracleWorldModel) -> BeamPlanner:
    return BeamPlanner(world_model, depth=1, candidates="scene")


@pytest.mark.parametrize("seed", range(5))
def test_the_goal_is_reached_without_the_simulators_state(env: gym.Env[Any, Any], seed: int) -> None:
    planner = one_step(oracle_for(env, seed))
    result = run_episode(CameraOnly(env), planner, seed=seed)
    assert result.success and result.believes_reached and result.error is None and result.gained == 1.0
    assert result.steps == 1 and result.attempts[0].plan.best.reaches_goal


def test_a_variant_of_a_scene_is_judged_by_its_own_instruction(env: gym.Env[Any, Any]) -> None:
    options = {"n_bowls": 4}
    oracle = oracle_for(env, 3, options)
    items = objects_now(env)
    block = next(item["color"] for item in items if item["kind"] == "block")
    for bowl in (item["color"] for item in items if item["kind"] == "bowl"):
        variant = put_in(block, bowl)
        result = run_episode(env, one_step(oracle), seed=3, options=options | {"instruction": variant.text})
        assert result.success and result.attempts[0].instruction == variant


def test_a_missed_pick_is_seen_and_tried_again(env: gym.Env[Any, Any]) -> None:
    planner = one_step(oracle_for(env, 1))
    result = run_episode(Missing(env, 1), planner, seed=1)
    assert result.success and result.steps == 2
    assert [attempt.believes_reached for attempt in result.attempts] == [False, True]
    once = run_episode(Missing(env, 1), planner, seed=1, replan=False)
    assert not once.success and not once.believes_reached and once.steps == 1
    never = run_episode(Missing(env, 9), planner, seed=1, max_attempts=2)
    assert not never.success and never.steps == 2 and never.gained == 0.0


def test_nobody_is_told_of_success(env: gym.Env[Any, Any]) -> None:
    """Who does not see the goal reached goes on, though the simulator says that the episode is over."""

    class Blind(OracleWorldModel):
        def parse(self, video: np.ndarray, *, seed: int = 0) -> Rollout:
            return super().parse(video, seed=seed) if len(self.calls) < 2 else self.first

    oracle = oracle_for(env, 0)
    blind = Blind(oracle.objects, oracle.camera)
    blind.first = oracle.parse(np.zeros((1, 64, 64, 3), np.uint8))
    blind.calls = [0, 0]  # it sees the scene as it was before anything moved
    result = run_episode(env, one_step(blind), seed=0)
    assert result.success and not result.believes_reached and result.steps == 3


def test_random_choices_mostly_fail(env: gym.Env[Any, Any]) -> None:
    successes = 0
    for seed in range(8):
        planner = RandomPlanner(oracle_for(env, seed), np.random.default_rng(seed), depth=1)
        successes += run_episode(env, planner, seed=seed, replan=False).success
    assert successes <= 4


def test_what_cannot_be_grounded_ends_the_episode_with_a_reason(env: gym.Env[Any, Any]) -> None:
    planner = one_step(oracle_for(env, 0))
    missing = next(color for color in ("pink", "orange", "purple", "white") if color not in str(objects_now(env)))
    result = run_episode(env, planner, Goal((put_in(missing, "teal"),)), seed=0)
    assert not result.success and result.steps == 0
    assert result.error is not None and f"no {missing} block" in result.error


def test_grounding_by_truth_reads_the_segmentation(env: gym.Env[Any, Any]) -> None:
    planner = one_step(oracle_for(env, 2))
    assert run_episode(env, planner, seed=2, ground=SegmentationGrounder.from_info).success
    with pytest.raises(KeyError, match="segmentation"):
        run_episode(CameraOnly(env), planner, seed=2, ground=SegmentationGrounder.from_info)


def test_ground_and_controller_are_the_callers(env: gym.Env[Any, Any]) -> None:
    """A grounder that swaps two bowls sends the block into the wrong one; a controller that misses moves nothing."""
    oracle = oracle_for(env, 3, {"n_bowls": 2})
    looks: list[Mapping[str, Any]] = []

    def confused(info: Mapping[str, Any]) -> Grounder:
        looks.append(info)

        def swapped(parsed: Rollout) -> Grounding:
            seen = SegmentationGrounder.from_info(info)(parsed)
            one, other = seen.of_kind("bowl")
            return replace(seen, things={**seen.things, one: seen.things[other], other: seen.things[one]})

        return swapped

    result = run_episode(env, one_step(oracle), ground=confused, seed=3, options={"n_bowls": 2}, max_attempts=1)
    assert not result.success and result.believes_reached and result.attempts[0].plan.best.reaches_goal
    assert len(looks) == 2 and looks[0] is not looks[1], "one for the plan, one for the look after it"

    class Beside(Controller):
        def act(self, rollout: Rollout, grounding: Grounding, instruction: Instruction) -> PickAndPlace:
            right = super().act(rollout, grounding, instruction)
            x, y = right.pick
            return PickAndPlace((x - 0.1 if x > 0.5 else x + 0.1, y), right.place)

    missed = run_episode(env, one_step(oracle), controller=Beside, seed=3, options={"n_bowls": 2}, max_attempts=1)
    assert not missed.success and not missed.believes_reached and missed.gained == 0.0
    usual = run_episode(env, one_step(oracle), seed=3, options={"n_bowls": 2}, max_attempts=1)
    assert usual.success


@pytest.mark.parametrize("replan", [True, False])
def test_goals_of_two_steps(replan: bool) -> None:
    env = gym.make("PutBlocksInBowls-v0")
    for seed in range(2):
        planner = BeamPlanner(oracle_for(env, seed))
        result = run_episode(CameraOnly(env), planner, seed=seed, replan=replan)
        assert result.success and result.believes_reached
        assert result.steps == len(Goal.parse(env.reset(seed=seed)[1]["instruction"]).instructions) >= 2
    env.close()


def test_half_a_goal_is_half_gained() -> None:
    """Without another look, the step that failed stays undone and the plan's next step is carried out all the same."""
    env = gym.make("PutBlocksInBowls-v0")
    planner = BeamPlanner(oracle_for(env, 0))
    once = run_episode(Missing(env, 1), planner, seed=0, replan=False)
    assert (once.success, once.gained, once.steps) == (False, 0.5, 2)
    assert once.attempts[0].plan is once.attempts[1].plan
    assert [a.rollout.texts[0] for a in once.attempts] == [a.instruction.text for a in once.attempts]
    again = run_episode(Missing(env, 1), planner, seed=0)
    assert (again.success, again.gained, again.steps) == (True, 1.0, 3)
    env.close()


def test_the_goals_own_steps_in_random_order_are_carried_out() -> None:
    env = gym.make("PutBlocksInBowls-v0")
    planner = RandomPlanner(oracle_for(env, 1), np.random.default_rng(0), from_goal=True)
    result = run_episode(CameraOnly(env), planner, seed=1, replan=False)
    assert (result.success, result.steps) == (True, 2)
    env.close()


def test_the_wrong_control_mode_is_refused() -> None:
    env = gym.make("PutBlockInBowl-v0", control="ee")
    with pytest.raises(ValueError, match="primitive"):
        run_episode(env, one_step(oracle_for(env, 0)), seed=0)
    env.close()


def test_a_goal_may_be_a_sentence(env: gym.Env[Any, Any]) -> None:
    obs, info = env.reset(seed=2)
    text, planner = info["instruction"], one_step(oracle_for(env, 2))
    assert run_episode(env, planner, text, seed=2).success
    with pytest.raises(ValueError, match="cannot read 'do not"):
        run_episode(env, planner, f"do not {text}", seed=2)
    with pytest.raises(TypeError, match=rf"give Goal.parse\('{text}'\)"):
        planner.plan(obs["rgb"], text, AppearanceGrounder.from_info(info))
