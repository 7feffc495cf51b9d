"""Planning over sequences of instructions, for goals that need two or three steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.goals import Goal
from planning.grounding import Grounder
from planning.planners import Imagines, Plan
from planning.scores import CarryScore, Judge, PlacementScore, Score, WeightedSum


@dataclass
class SequencePlanner:
    """Beam search over sequences of instructions; each step is imagined from where the last imagined one ended.

    Attributes:
        beam: how many sequences are kept after each step (0 keeps all: exhaustive).
        others as `InstructionPlanner`.
    """

    world_model: Imagines
    score: Score = WeightedSum((PlacementScore(), CarryScore()), (0.8, 0.2))
    judge: Judge = Judge()
    horizon: int = 24
    stride: int = 2
    beam: int = 4
    seed: int = 0

    def plan(self, rgb: NDArray[np.uint8], goal: Goal, grounder: Grounder) -> Plan:
        raise NotImplementedError
