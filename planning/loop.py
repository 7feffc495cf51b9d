"""The closed loop: observe, plan, act, observe again, and replan while the goal is not reached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from planning.controller import PickAndPlace
from planning.goals import Goal, Instruction
from planning.grounding import Grounding
from planning.planners import Plan, Planner

if TYPE_CHECKING:
    import gymnasium

    from textocvp.rollout import Rollout


@dataclass(frozen=True, eq=False)
class Attempt:
    """One turn of the loop.

    Attributes:
        rgb: (H, W, 3) the observation that was planned from.
        plan: what the planner decided.
        action: what was done.
        believes_reached: whether the planner's own eyes say afterwards that the goal is reached.
    """

    rgb: NDArray[np.uint8]
    plan: Plan
    action: PickAndPlace
    believes_reached: bool


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """What came of an episode.

    Attributes:
        success: the simulator's verdict after the last action.
        believes_reached: the planner's own verdict at that moment.
        attempts: the turns of the loop; empty if the scene could not be grounded.
        error: why the loop gave up, or None.
        frames: (T, H, W, 3) what the camera saw, first observation included (with `record_frames`, all of it).
    """

    success: bool
    believes_reached: bool
    attempts: tuple[Attempt, ...]
    error: str | None
    frames: NDArray[np.uint8]

    @property
    def steps(self) -> int:
        """Number of pick-and-places carried out."""
        return len(self.attempts)

    @property
    def planning_seconds(self) -> float:
        """Mean planning time of an attempt, NaN without attempts."""
        return float(np.mean([a.plan.seconds for a in self.attempts])) if self.attempts else float("nan")


def goal_reached(parsed: Rollout, grounding: Grounding, goal: Goal) -> bool:
    """Whether every block of the goal is seen inside its bowl (its centroid within the bowl's outline)."""
    raise NotImplementedError


def run_episode(
    env: gymnasium.Env[Any, Any],
    planner: Planner,
    goal: Goal | None = None,
    *,
    seed: int | None = None,
    options: Mapping[str, Any] | None = None,
    max_attempts: int = 3,
    replan: bool = True,
    privileged: bool = False,
) -> EpisodeResult:
    """Reset a `control="primitive"` environment and pursue a goal in it.

    From `info` the planner is given the camera only. `is_success` is read for the result and nothing else.

    Args:
        goal: by default what the environment's instruction says.
        seed, options: for `env.reset`; for a variant of a scene pass `options={"instruction": ...}`, so that the
            simulator judges the goal that is pursued.
        max_attempts: pick-and-places at most (per pair of the goal).
        replan: look again after each action, and go on while the goal is not reached. Otherwise one action a pair.
        privileged: ground with the simulator's segmentation instead (the control column of that name).
    """
    raise NotImplementedError
