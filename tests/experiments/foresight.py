"""Test doubles that know what the expert did: one imagines exactly that, the others are broken on purpose.

They are for units that play a scene before they imagine it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from tests.experiments import oracle
from textocvp.rollout import Rollout

Kind = Literal["sees", "copies", "shuffles"]


@dataclass(frozen=True)
class LoadForesight:
    """Makes the double.

    Attributes:
        kind: `sees` the true future, if it is told the instruction that was carried out, and else a still picture;
            `copies` the first frame whatever it is told; `shuffles` sees the future, but from the first imagined frame
            on each slot holds its neighbour's thing.
        ahead: its longest horizon.
    """

    kind: Kind
    ahead: int | None = 24

    def __call__(self) -> Foresight:
        oracle._listen()
        return Foresight(self.kind, self.ahead)


class Foresight(oracle.StudyOracle):
    """See `LoadForesight`."""

    def __init__(self, kind: Kind, ahead: int | None) -> None:
        super().__init__(())
        self.kind, self.longest_horizon = kind, ahead  # type: ignore[assignment]

    def parse(self, video: np.ndarray, *, seed: int = 0) -> Rollout:
        """All frames since the last reset, or for one frame the first of them."""
        frames = sum(len(info["frame_states"]["object_position"]) for info in oracle._history)
        film = super().parse(np.zeros((max(frames, 2), 1)), seed=seed)
        return film if len(video) > 1 else replace(film, slots=film.slots[:, :1])

    def rollout(
        self, obs: Rollout | np.ndarray, text: Sequence[str], *, horizon: int = 24, seed: int = 0
    ) -> Rollout:
        film = self.parse(np.zeros((2, 1)), seed=seed)
        rest = torch.arange(horizon + 1).clamp(max=film.slots.shape[1] - 1)
        true_TKD = film.slots[0, rest]
        still_TKD = true_TKD[:1].expand_as(true_TKD)
        if self.kind == "shuffles":
            true_TKD = true_TKD.clone()
            true_TKD[1:, 1:] = true_TKD[1:, 1:].roll(1, dims=1)  # slot 0 is the background
        told = oracle._history[0]["instruction"]
        films = [still_TKD if self.kind == "copies" or t != told else true_TKD for t in text]
        return replace(film, slots=torch.stack(films), texts=tuple(text))
