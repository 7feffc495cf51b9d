"""Test doubles with an attention to words that is known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from planning import Instruction
from tests.experiments import oracle
from tests.planning.oracle import BLOCK, BOWL
from textocvp.rollout import Rollout

Kind = Literal["attends", "uniform", "swapped", "one head", "late"]
LAYERS, HEADS = 2, 3


@dataclass(frozen=True)
class LoadAttentive:
    """Makes the double.

    Attributes:
        kind: `attends`: the named block's slot gives .9 of its attention to its colour word, the named bowl's slot
            to its own, and all others the same share to every word. `uniform`: all slots are like those others.
            `swapped`: block and bowl attend to each other's word. `one head`: only layer 2, head 3 attends.
            `late`: it attends from step 12 on.
    """

    kind: Kind

    def __call__(self) -> Attentive:
        oracle._listen()
        return Attentive(self.kind)


class Attentive(oracle.StudyOracle):
    """See `LoadAttentive`."""

    def __init__(self, kind: Kind) -> None:
        super().__init__(())
        self.kind = kind

    def words(self, text: str) -> list[str]:
        return [*text.split(), "</s>"]

    def rollout(
        self,
        obs: Rollout | np.ndarray,
        text: Sequence[str],
        *,
        horizon: int = 24,
        seed: int = 0,
        attention: bool = False,
    ) -> Rollout:
        rollout = super().rollout(obs, text, horizon=horizon, seed=seed)
        maps = [self._attend(rollout.slots[b, 0], Instruction.parse(t), horizon) for b, t in enumerate(text)]
        return replace(rollout, attention=torch.stack(maps) if attention else None)

    def _attend(self, slots_KD: torch.Tensor, asked: Instruction, steps: int) -> torch.Tensor:
        block = self._oracle()._find(slots_KD, BLOCK, asked.thing.color)
        bowl = self._oracle()._find(slots_KD, BOWL, asked.target.color)
        map_TnhKL = torch.full((steps, LAYERS, HEADS, len(slots_KD), 9), 1 / 9)
        if self.kind == "uniform":
            return map_TnhKL
        words = (6, 2) if self.kind == "swapped" else (2, 6)
        attending = torch.zeros(steps, LAYERS, HEADS, dtype=torch.bool)
        if self.kind == "one head":
            attending[:, 1, 2] = True
        else:
            attending[12 if self.kind == "late" else 0 :] = True
        for slot, word in zip((block, bowl), words, strict=True):
            attentive_L = torch.full((9,), 0.1 / 8)
            attentive_L[word] = 0.9
            map_TnhKL[..., slot, :] = torch.where(attending[..., None], attentive_L, map_TnhKL[..., slot, :])
        return map_TnhKL
