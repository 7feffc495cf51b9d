"""Planners: imagine candidate instructions with a world model, score what was imagined, choose.

A planner knows the world model only through `Imagines` and reads nothing but rollouts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from planning.goals import Goal, Instruction
from planning.grounding import Grounder, Grounding
from planning.scores import CarryScore, Judge, PlacementScore, Score, WeightedSum

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


class Imagines(Protocol):
    """What a planner needs of a world model."""

    def parse(self, video: NDArray[np.uint8], *, seed: int = 0) -> Rollout:
        """The slots of a true video (T, H, W, 3), without imagination."""
        ...

    def rollout(self, obs: Rollout, text: Sequence[str], *, horizon: int = 24, seed: int = 0) -> Rollout:
        """Imagine one scene (B = 1, its last frame) under n texts, or n scenes under n texts: a batch of n."""
        ...


@dataclass(frozen=True)
class Candidate:
    """A sequence of instructions that was considered.

    Attributes:
        instructions: what would be done, in order.
        score: of the goal at its imagined end, higher is better.
        reaches_goal: whether the judge says so of the imagined rollouts.
    """

    instructions: tuple[Instruction, ...]
    score: float
    reaches_goal: bool


@dataclass(frozen=True, eq=False)
class Plan:
    """What a planner decided on.

    Attributes:
        ranking: all candidates, best first.
        rollouts: one imagined rollout (B = 1) for each instruction of the best candidate.
        grounding: of the observation that was planned from.
        seconds: planning time, parsing included.
    """

    ranking: tuple[Candidate, ...]
    rollouts: tuple[Rollout, ...]
    grounding: Grounding
    seconds: float

    @property
    def best(self) -> Candidate:
        """The chosen candidate."""
        return self.ranking[0]

    @property
    def instruction(self) -> Instruction:
        """What to do now: the first instruction of the chosen candidate."""
        return self.best.instructions[0]

    @property
    def rollout(self) -> Rollout:
        """The imagined rollout of that instruction, B = 1."""
        return self.rollouts[0]


class Planner(Protocol):
    """Chooses what to do, given a picture and a goal."""

    world_model: Imagines

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        """A plan for the goal from one observation (H, W, 3).

        Raises:
            GroundingError: if no block or no bowl of the goal can be found in the picture.
        """
        ...


@dataclass
class InstructionPlanner:
    """Imagines every block x bowl instruction of the scene as one batch and takes the one that best reaches the goal.

    With a goal of several pairs it takes the best next step (the best score over the goal's pairs).

    Attributes:
        world_model: imagines.
        score: ranks the imagined rollouts against a pair of the goal.
        judge: says whether a rollout reaches it.
        horizon: frames to imagine.
        stride: of the frames during the carry, every how many are decoded and scored (the last ones always are).
        seed: of the slot sampling.
    """

    world_model: Imagines
    score: Score = WeightedSum((PlacementScore(), CarryScore()), (0.8, 0.2))
    judge: Judge = Judge()
    horizon: int = 24
    stride: int = 2
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        raise NotImplementedError


@dataclass
class RandomPlanner:
    """The control row: a random block x bowl instruction of the scene, imagined only to be carried out."""

    world_model: Imagines
    rng: np.random.Generator
    horizon: int = 24
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        raise NotImplementedError
