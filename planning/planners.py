"""Planners: imagine candidate instructions with a world model, score what was imagined, choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from .grounding import Grounder, Grounding, GroundingError
from .language import AnyGoal, Goal, Instruction
from .relations import RELATIONS, THRESHOLDS
from .scores import Trace, measure_rollout, score, succeeds, unmet

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


HORIZON = 24  # frames of a film, where the model sets no limit


class Imagines(Protocol):
    """All that a planner knows of a world model."""

    def parse(self, video: NDArray[np.uint8], *, seed: int = 0) -> Rollout:
        """The slots of a true video (T, H, W, 3), without imagination."""

    def rollout(self, obs: Rollout, text: Sequence[str], *, horizon: int, seed: int = 0) -> Rollout:
        """Imagine one scene (B = 1, its last frame) under n texts, or n scenes under n texts: a batch of n."""


@dataclass(frozen=True)
class Candidate:
    """A sequence of instructions that was considered."""

    instructions: tuple[Instruction, ...]  # in the order in which they would be carried out
    score: float  # of the goal at its imagined end, higher is better
    reaches_goal: bool  # whether what was imagined `succeeds`


@dataclass(frozen=True, eq=False)
class Plan:
    """What a planner decided on."""

    ranking: tuple[Candidate, ...]  # all of them, best first
    rollouts: tuple[Rollout, ...]  # as imagined, B = 1: one for each instruction of the best candidate
    grounding: Grounding  # of the observation that was planned from
    seconds: float  # planning time, parsing included

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

    def plan(self, rgb: NDArray[np.uint8], goal: Any, grounder: Grounder) -> Plan:
        """A plan for the goal, a `Goal` or what else the planner takes, from one observation (H, W, 3).

        Raises:
            GroundingError: if what the plan is made of cannot be found in the picture.
        """

    def reached(self, rgb: NDArray[np.uint8], goal: Any, grounder: Grounder) -> bool:
        """Whether the goal is seen to be reached; what cannot be seen is not known to be."""


class _LooksAtMasks:
    """Takes a goal for reached when the masks of the picture show it."""

    world_model: Imagines

    def reached(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> bool:
        """See `Planner.reached`."""
        try:
            return not unmet(*observe(self.world_model, rgb, goal, grounder), goal)
        except GroundingError:
            return False


def watched_frames(length: int, settle: int, stride: int) -> tuple[int, ...]:
    """The frames to decode: every `stride`-th, and the last `settle` of `length` frames without a gap."""
    return tuple(t for t in range(length) if t % stride == 0 or t >= length - settle)


@dataclass(frozen=True, eq=False)
class _Branch:
    """A sequence under search."""

    instructions: tuple[Instruction, ...] = ()
    imagined: tuple[tuple[Rollout, int], ...] = ()  # of each instruction: the batch, and the row in it


def frames_ahead(model: Imagines, horizon: int | None = None) -> int:
    """The horizon that was asked for, or else the model's, or else `HORIZON`."""
    return horizon if horizon is not None else getattr(model, "longest_horizon", None) or HORIZON


@dataclass
class BeamPlanner(_LooksAtMasks):
    """Beam search over sequences of instructions, which move each thing at most once.

    Each step is imagined from where the last imagined one ended; all candidates of a step are one batch. A sequence of
    n instructions is worth the mean of its n best scores, one for each instruction of the goal that does not hold yet,
    over its whole imagined course.
    """

    world_model: Imagines
    depth: int | None = None  # instructions in a plan; at most, and by default, as many as do not hold yet
    candidates: Literal["goal", "scene"] = "goal"  # move a thing of the goal, or any thing of the scene
    beam: int = 4  # sequences that are kept after each step; 0 keeps all (exhaustive)
    horizon: int | None = None  # frames to imagine for each step; by default as far as the model looks ahead
    stride: int = 3  # of the frames that are decoded and scored; the last ones always are
    seed: int = 0  # of the slot sampling

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        """The best sequence; see `Planner.plan`."""
        began = perf_counter()
        parsed, grounding = observe(self.world_model, rgb, goal, grounder, self.seed)
        wanted = unmet(parsed, grounding, goal) or goal.instructions
        allowed = _allowed(grounding, goal)
        if self.candidates == "goal":
            allowed = tuple(one for want in wanted for one in allowed if one.thing == want.thing)
        depth = min(self.depth or len(wanted), len(wanted))

        branches, kept, starts = [_Branch()], [0], parsed
        traces: list[Trace] = []  # one for each wanted instruction, of all branches
        for done in range(depth):
            steps = [
                (row, one)
                for row, branch in enumerate(branches[i] for i in kept)
                for one in allowed
                if one.thing not in {done.thing for done in branch.instructions}
            ]
            rows, texts = [row for row, _ in steps], [one.text for _, one in steps]
            starts = starts.select(rows)
            rollout = self.world_model.rollout(
                starts, texts, horizon=frames_ahead(self.world_model, self.horizon), seed=self.seed
            )
            length = rollout.slots.shape[1]
            frames = watched_frames(length, THRESHOLDS.settle_frames, self.stride)
            new = [measure_rollout(rollout, grounding, want, frames=frames) for want in wanted]
            parents = [kept[row] for row in rows]
            if done:
                both = zip(traces, new, strict=True)
                new = [old.select(parents).then(trace, done * length) for old, trace in both]
            traces = new
            branches = [
                _Branch((*branches[p].instructions, one), (*branches[p].imagined, (rollout, i)))
                for i, (p, (_, one)) in enumerate(zip(parents, steps, strict=True))
            ]
            scores = _scores(traces, depth)
            ranked = sorted(range(len(steps)), key=lambda i: scores[i], reverse=True)
            kept = ranked[: self.beam] if self.beam else ranked
            starts = rollout.last.select(kept)

        reaches_B = torch.stack([succeeds(trace) for trace in traces]).sum(0) >= depth
        ranking = tuple(Candidate(branches[i].instructions, scores[i], bool(reaches_B[i])) for i in ranked)
        rollouts = tuple(batch.select(row) for batch, row in branches[ranked[0]].imagined)
        return Plan(ranking, rollouts, grounding, perf_counter() - began)


def _scores(traces: Sequence[Trace], count: int) -> list[float]:
    """One score a sequence: the mean over the `count` instructions of the goal that it fulfils best."""
    scores_Bn = torch.stack([score(trace) for trace in traces], dim=1).tolist()
    if count < len(traces):
        scores_Bn = [sorted(scores_n, reverse=True)[:count] for scores_n in scores_Bn]
    return [sum(scores_n) / count for scores_n in scores_Bn]


@dataclass
class RandomPlanner(_LooksAtMasks):
    """The control row: random instructions, imagined only to be carried out. See `BeamPlanner` for the other options.

    A plan of depth 1 is any instruction of the scene. In a longer one no thing and no target comes twice.
    """

    world_model: Imagines
    rng: np.random.Generator
    depth: int | None = None
    from_goal: bool = False  # take the goal's own instructions: only their order is left to chance
    horizon: int | None = None
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        """A random sequence. With depth 1 the rest of the ranking is the rest of the instructions, in random order."""
        began = perf_counter()
        parsed, grounding = observe(self.world_model, rgb, goal, grounder, self.seed)
        sequences = self._draw(parsed, grounding, goal)
        rollouts, start = [], parsed
        for one in sequences[0]:
            rollouts.append(
                self.world_model.rollout(
                    start, [one.text], horizon=frames_ahead(self.world_model, self.horizon), seed=self.seed
                )
            )
            start = rollouts[-1].last
        ranking = tuple(Candidate(sequence, 0.0, False) for sequence in sequences)
        return Plan(ranking, tuple(rollouts), grounding, perf_counter() - began)

    def _draw(self, parsed: Rollout, grounding: Grounding, goal: Goal) -> list[tuple[Instruction, ...]]:
        if self.depth == 1 and not self.from_goal:  # what the goal names need not even be seen
            return [(one,) for one in self._shuffled(_allowed(grounding, goal))]
        wanted = unmet(parsed, grounding, goal) or goal.instructions
        depth = min(self.depth or len(wanted), len(wanted))
        if self.from_goal:
            return [tuple(self._shuffled(wanted)[:depth])]
        allowed = _allowed(grounding, goal)
        by_things = {one.things: one for one in allowed}
        things, targets = (self._shuffled(sorted(set(ones)))[:depth] for ones in zip(*by_things, strict=True))
        drawn = [by_things[pair] for pair in zip(things, targets, strict=False) if pair in by_things]
        return [tuple(drawn or self._shuffled(allowed)[:1])]

    def _shuffled(self, values: Sequence[Any]) -> list[Any]:
        return [values[i] for i in self.rng.permutation(len(values))]


def observe(
    world_model: Imagines, rgb: NDArray[np.uint8], goal: AnyGoal, grounder: Grounder, seed: int = 0
) -> tuple[Rollout, Grounding]:
    """A picture (H, W, 3), parsed and grounded; the goal's sentence says of what kind its things are."""
    if isinstance(goal, str):
        raise TypeError(f"the goal is a string: give Goal.parse({goal!r})")
    parsed = world_model.parse(rgb[None], seed=seed)
    return parsed, grounder(parsed).with_kinds(goal.things)


def _allowed(grounding: Grounding, goal: Goal) -> tuple[Instruction, ...]:
    """The instructions that the scene allows, of the relations that the goal names."""
    relations = sorted({one.relation for one in goal.instructions})
    allowed = grounding.instructions(*relations)
    if not allowed:
        kinds = dict.fromkeys(kind for name in relations for kind in RELATIONS[name].kinds)
        raise GroundingError(f"no {' or no '.join(kinds)} is seen")
    return allowed
