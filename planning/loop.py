"""The closed loop: observe, plan, act, observe again, and replan while the goal is not reached."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from .camera import PinholeCamera
from .controller import Controller, LiteralController, PickAndPlace
from .grounding import AppearanceGrounder, Grounder, GroundingError
from .language import AnyGoal, Goal, Instruction
from .planners import Plan, Planner

if TYPE_CHECKING:
    import gymnasium

    from textocvp.rollout import Rollout


@dataclass(frozen=True, eq=False)
class Attempt:
    """One turn of the loop."""

    rgb: NDArray[np.uint8]  # (H, W, 3), what was seen before the action
    plan: Plan
    instruction: Instruction  # the step of the plan that was carried out
    rollout: Rollout  # how that step was imagined, B = 1
    action: PickAndPlace
    believes_reached: bool  # whether the planner's own eyes say afterwards that the goal is reached


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """What came of an episode."""

    success: bool  # the simulator's verdict after the last action
    gained: float  # sum of the rewards; of sparse ones, by how much the share of the goal that holds rose
    believes_reached: bool  # the planner's own verdict after the last action
    attempts: tuple[Attempt, ...]  # empty if the scene could not be grounded
    error: str | None  # why the loop gave up
    # (T, H, W, 3): the observations, first one included; with `record_frames` all that the camera saw.
    frames: NDArray[np.uint8]

    @property
    def steps(self) -> int:
        """Number of pick-and-places carried out."""
        return len(self.attempts)

    @property
    def planning_seconds(self) -> float:
        """Mean planning time of an attempt, NaN without attempts."""
        return float(np.mean([a.plan.seconds for a in self.attempts])) if self.attempts else float("nan")


def run_episode(
    env: gymnasium.Env[Any, Any],
    planner: Planner,
    goal: AnyGoal | str | None = None,
    *,
    ground: Callable[[Mapping[str, Any]], Grounder] = AppearanceGrounder.from_info,
    controller: Callable[[PinholeCamera], Controller | LiteralController] = Controller,
    seed: int | None = None,
    options: Mapping[str, Any] | None = None,
    max_attempts: int = 3,
    max_actions: int | None = None,
    replan: bool = True,
) -> EpisodeResult:
    """Reset a `control="primitive"` environment and pursue a goal in it.

    The planner sees pictures and what `ground` and `controller` take of `info`. The simulator's verdict goes into the
    result and nowhere else: whoever does not see that the goal is reached goes on, and may undo it.

    Args:
        goal: or its sentence, for `Goal.parse`; by default what the environment's instruction says.
        ground: makes a grounder for each observation, of its `info`. `SegmentationGrounder.from_info` reads the
            simulator's truth instead (the control column `privileged`).
        controller: makes the controller, of the scene's camera.
        seed, options: for `env.reset`; for a variant of a scene pass `options={"instruction": ...}`, so that the
            simulator judges the goal that is pursued.
        max_attempts: pick-and-places at most (per instruction of the goal).
        max_actions: the same in all, instead.
        replan: look again after each action, and plan anew while the goal is not reached. Otherwise one plan is made
            and carried out to its end.

    Raises:
        ValueError: if the environment is not in `primitive` control.
    """
    if not isinstance(env.action_space, Box) or env.action_space.shape != (4,):
        raise ValueError(
            "the loop acts by pick-and-place: make the environment with control='primitive' and without "
            f"place_yaw, so that an action has 4 numbers; its action space is {env.action_space}"
        )
    goal = Goal.parse(goal) if isinstance(goal, str) else goal
    observation, info = env.reset(seed=seed, options=None if options is None else dict(options))
    rgb = observation["rgb"]
    goal = Goal.parse(info["instruction"]) if goal is None else goal
    robot = controller(PinholeCamera.from_info(info["camera"]))
    frames: list[NDArray[np.uint8]] = [rgb[None]]
    attempts: list[Attempt] = []
    queue: list[tuple[Instruction, Rollout]] = []
    reached, gained, error = False, 0.0, None
    for _ in range(max_actions or max_attempts * goal.steps):
        try:
            if not queue:
                plan = planner.plan(rgb, goal, ground(info))
                queue = list(zip(plan.best.instructions, plan.rollouts, strict=True))
            instruction, rollout = queue.pop(0)
            action = robot.act(rollout, plan.grounding, instruction)
        except GroundingError as problem:
            error = str(problem)
            break
        seen = rgb
        within_reach = np.clip(action.to_action(), env.action_space.low, env.action_space.high)
        observation, reward, _, truncated, info = env.step(within_reach)
        rgb, gained = observation["rgb"], gained + float(reward)
        frames.append(np.asarray(info["frames"]) if "frames" in info else rgb[None])
        reached = planner.reached(rgb, goal, ground(info))
        attempts.append(Attempt(seen, plan, instruction, rollout, action, reached))
        if replan:
            queue = []
        if truncated or (reached if replan else not queue):
            break
    success = bool(info["is_success"])
    return EpisodeResult(success, gained, reached, tuple(attempts), error, np.concatenate(frames))
