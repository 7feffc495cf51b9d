"""Sequences of instructions that nobody chose by imagining: the control rows of goals that need several steps."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from planning.goals import Goal, Instruction
from planning.grounding import Grounder, Grounding, GroundingError
from planning.planners import Candidate, Imagines, Plan
from planning.progress import open_pairs

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


@dataclass
class RandomSequencePlanner:
    """A sequence of random instructions, or the goal's own in random order, imagined only to be carried out.

    Attributes:
        world_model: imagines.
        rng: the source of chance.
        told: whether the sequence is the goal's open pairs, so that only their order is left to chance. Otherwise it
            has as many random instructions, no block and no bowl of which comes twice.
        horizon: frames to imagine for each step.
        seed: of the slot sampling.
    """

    world_model: Imagines
    rng: np.random.Generator
    told: bool = False
    horizon: int = 24
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        """One sequence, as the only candidate; see `Planner.plan`."""
        began = perf_counter()
        parsed = self.world_model.parse(rgb[None], seed=self.seed)
        grounding = grounder(parsed).told(goal.things)
        pairs = open_pairs(parsed, grounding, goal) or goal.pairs
        if self.told:
            steps = tuple(pairs[i] for i in self.rng.permutation(len(pairs)))
        else:
            steps = self._invent(grounding, len(pairs))
        rollouts = imagine_steps(self.world_model, parsed, steps, horizon=self.horizon, seed=self.seed)
        return Plan((Candidate(steps, 0.0, False),), rollouts, grounding, perf_counter() - began)

    def _invent(self, grounding: Grounding, count: int) -> tuple[Instruction, ...]:
        if not grounding.instructions:
            raise GroundingError("no block or no bowl is seen")
        # Sorted, because the order of the slots must not matter to what is drawn.
        blocks, bowls = (
            sorted({getattr(one, name) for one in grounding.instructions}) for name in ("block", "bowl")
        )
        drawn = [self.rng.permutation(names).tolist()[:count] for names in (blocks, bowls)]
        return tuple(Instruction(block, bowl) for block, bowl in zip(*drawn, strict=False))


def imagine_steps(
    world_model: Imagines,
    start: Rollout,
    instructions: tuple[Instruction, ...],
    *,
    horizon: int = 24,
    seed: int = 0,
) -> tuple[Rollout, ...]:
    """Imagine instructions one after another (B = 1), each from where the last imagined one ended."""
    rollouts = []
    for instruction in instructions:
        rollout = world_model.rollout(start, [instruction.text], horizon=horizon, seed=seed)
        rollouts.append(rollout)
        start = rollout.last
    return tuple(rollouts)
