"""Planning over sequences of instructions, for goals that need two or three steps."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from planning.goals import Goal, Instruction
from planning.grounding import Grounder, Grounding, hard_masks
from planning.planners import Candidate, Imagines, Plan, watched_frames
from planning.progress import contents, open_pairs
from planning.scores import CarryScore, Judge, PlacementScore, Score, Trace, WeightedSum, measure_rollout

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


@dataclass
class _Branch:
    """A sequence under search: its instructions, and where each of them was imagined (batch and row in
    it).
    """

    instructions: tuple[Instruction, ...] = ()
    imagined: tuple[tuple[Rollout, int], ...] = ()
    traces: tuple[Trace, ...] = ()  # one a pair of the goal, over all steps so far (B = 1)
    score: float = float("-inf")
    reaches_goal: bool = False


@dataclass
class SequencePlanner:
    """Beam search over sequences of instructions.

    Each step is imagined from where the last imagined one ended. A step moves one of the blocks that the goal
    names into any bowl of the scene; with `one_a_bowl` only into one in which no other block is seen to lie
    by then: a model that has never seen two blocks meet in a bowl imagines that both fit. A sequence is worth
    the mean, over the goal's open pairs, of the score of its whole imagined course.

    Attributes:
        world_model: imagines.
        score: ranks a course against one pair of the goal.
        judge: says whether it reaches the pair.
        horizon: frames to imagine for each step.
        stride: of the frames during a carry, every how many are decoded and scored.
        beam: how many sequences are kept after each step; 0 keeps all (exhaustive).
        one_a_bowl: know that a bowl has room for one block.
        seed: of the slot sampling.
    """

    world_model: Imagines
    score: Score = WeightedSum((PlacementScore(), CarryScore()), (0.8, 0.2))
    judge: Judge = Judge()
    horizon: int = 24
    stride: int = 3
    beam: int = 4
    one_a_bowl: bool = True
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        """A plan of as many instructions as the goal has open pairs; see `Planner.plan`."""
        began = perf_counter()
        parsed = self.world_model.parse(rgb[None], seed=self.seed)
        grounding = grounder(parsed).told(goal.things)
        pairs = open_pairs(parsed, grounding, goal) or goal.pairs
        kept, starts = [_Branch()], parsed
        dropped: list[_Branch] = []
        for _ in pairs:
            grown, rollout = self._grow(kept, starts, grounding, pairs)
            grown.sort(key=lambda branch: branch.score, reverse=True)
            kept, dropped = (grown[: self.beam], grown[self.beam :]) if self.beam else (grown, [])
            starts = rollout.last.select([branch.imagined[-1][1] for branch in kept])
        ranked = kept + dropped
        ranking = tuple(Candidate(b.instructions, b.score, b.reaches_goal) for b in ranked)
        rollouts = tuple(batch.select(row) for batch, row in ranked[0].imagined)
        return Plan(ranking, rollouts, grounding, perf_counter() - began)

    def _grow(
        self, branches: list[_Branch], starts: Rollout, grounding: Grounding, pairs: tuple[Instruction, ...]
    ) -> tuple[list[_Branch], Rollout]:
        """Every branch one step on, all imagined as one batch; `starts` has one row a branch."""
        possible = [
            (row, Instruction(pair.block, bowl))
            for row, branch in enumerate(branches)
            for pair in pairs
            if pair.block not in {done.block for done in branch.instructions}
            for bowl in grounding.bowls
        ]
        steps = self._with_room(possible, starts, grounding) if self.one_a_bowl else possible
        texts = [instruction.text for _, instruction in steps]
        rows = [row for row, _ in steps]
        rollout = self.world_model.rollout(starts.select(rows), texts, horizon=self.horizon, seed=self.seed)
        length = rollout.slots.shape[1]
        frames = watched_frames(length, self.judge.thresholds.settle_frames, self.stride)
        batch = [measure_rollout(rollout, grounding, pair, frames=frames) for pair in pairs]
        grown = []
        for i, (row, instruction) in enumerate(steps):
            branch, traces = branches[row], tuple(trace.select([i]) for trace in batch)
            if branch.imagined:
                seen = length * len(branch.imagined)
                traces = tuple(old.then(new, seen) for old, new in zip(branch.traces, traces, strict=True))
            grown.append(
                _Branch(
                    (*branch.instructions, instruction),
                    (*branch.imagined, (rollout, i)),
                    traces,
                    sum(float(self.score(trace)) for trace in traces) / len(traces),
                    all(bool(self.judge(trace)) for trace in traces),
                )
            )
        return grown, rollout

    @staticmethod
    def _with_room(
        steps: list[tuple[int, Instruction]], starts: Rollout, grounding: Grounding
    ) -> list[tuple[int, Instruction]]:
        """Those steps, each with its row of `starts`, into whose bowl no other block is seen to lie."""
        masks_BKHW = hard_masks(starts.decode_masks([-1])[:, 0]).cpu().numpy()
        inside = [contents(masks_KHW, grounding) for masks_KHW in masks_BKHW]
        # Should no bowl have room, trying is better than giving up.
        return [(row, one) for row, one in steps if inside[row][one.bowl] <= {one.block}] or steps
