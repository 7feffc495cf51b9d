"""Planners: imagine candidate instructions with a world model, score what was imagined, choose.

A planner knows the world model only through `Imagines` and reads nothing but rollouts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from planning.goals import Goal, Instruction
from planning.grounding import Grounder, Grounding, GroundingError
from planning.progress import open_pairs
from planning.scores import CarryScore, Judge, PlacementScore, Score, WeightedSum, measure_rollout

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


class Imagines(Protocol):
    """What a planner needs of a world model."""

    def parse(self, video: NDArray[np.uint8], *, seed: int = 0) -> Rollout:
        """The slots of a true video (T, H, W, 3), without imagination."""
        ...

    def rollout(self, obs: Rollout, text: Sequence[str], *, horizon: int = 24, seed: int = 0) -> Rollout:
        """Imagine one scene (B = 1, its last frame) under n texts, or n scenes under n texts: a batch of
        n.
        """
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


def watched_frames(length: int, settle: int, stride: int) -> tuple[int, ...]:
    """The frames a planner decodes: every `stride`-th, and the last `settle` of `length` frames without a
    gap.
    """
    return tuple(t for t in range(length) if t % stride == 0 or t >= length - settle)


@dataclass
class InstructionPlanner:
    """Imagines every block x bowl instruction of the scene as one batch and takes the one that best reaches
    the goal.

    With a goal of several pairs it takes the best next step: the best score over the pairs not reached yet.

    Attributes:
        world_model: imagines.
        score: ranks the imagined rollouts against a pair of the goal.
        judge: says whether a rollout reaches it.
        horizon: frames to imagine.
        stride: of the frames during the carry, every how many are decoded and scored (the last ones always
            are).
        seed: of the slot sampling.
    """

    world_model: Imagines
    score: Score = WeightedSum((PlacementScore(), CarryScore()), (0.8, 0.2))
    judge: Judge = Judge()
    horizon: int = 24
    stride: int = 3
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        """A plan of one instruction; see `Planner.plan`."""
        began = perf_counter()
        parsed = self.world_model.parse(rgb[None], seed=self.seed)
        grounding = grounder(parsed).told(goal.things)
        pairs = open_pairs(parsed, grounding, goal) or goal.pairs
        instructions = grounding.instructions
        texts = [instruction.text for instruction in instructions]
        rollout = self.world_model.rollout(parsed, texts, horizon=self.horizon, seed=self.seed)
        frames = watched_frames(rollout.slots.shape[1], self.judge.thresholds.settle_frames, self.stride)
        traces = [measure_rollout(rollout, grounding, pair, frames=frames) for pair in pairs]
        score_B = torch.stack([self.score(trace) for trace in traces]).amax(0)
        reaches_B = torch.stack([self.judge(trace) for trace in traces]).any(0)
        order = score_B.argsort(descending=True, stable=True).tolist()
        ranking = tuple(Candidate((instructions[i],), float(score_B[i]), bool(reaches_B[i])) for i in order)
        return Plan(ranking, (rollout.select(order[0]),), grounding, perf_counter() - began)


@dataclass
class RandomPlanner:
    """The control row: a random block x bowl instruction of the scene, imagined only to be carried out."""

    world_model: Imagines
    rng: np.random.Generator
    horizon: int = 24
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        """A random instruction; the rest of the ranking is in random order too."""
        began = perf_counter()
        parsed = self.world_model.parse(rgb[None], seed=self.seed)
        grounding = grounder(parsed).told(goal.things)
        if not grounding.instructions:
            raise GroundingError("no block or no bowl is seen")
        shuffled = self.rng.permutation(len(grounding.instructions)).tolist()
        instructions = [grounding.instructions[i] for i in shuffled]
        rollout = self.world_model.rollout(
            parsed, [instructions[0].text], horizon=self.horizon, seed=self.seed
        )
        ranking = tuple(Candidate((instruction,), 0.0, False) for instruction in instructions)
        return Plan(ranking, (rollout,), grounding, perf_counter() - began)
