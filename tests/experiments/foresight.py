"""Test doubles that know what the expert will do: one imagines exactly that, the others are broken on purpose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from envs import Expert
from tests.experiments import oracle
from textocvp.rollout import Rollout

Kind = Literal["sees", "copies", "shuffles"]


@dataclass(frozen=True)
class LoadForesight:
    """Makes the double.

    Attributes:
        kind: `sees` the true future of the scene's own instruction, and a still picture for any other; `copies` the
            first frame whatever the text; `shuffles` sees the future, but from the first imagined frame on each slot
            holds its neighbour's thing.
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

    def rollout(self, obs: Rollout | np.ndarray, text: Sequence[str], *, horizon: int = 24, seed: int = 0) -> Rollout:
        film = self._future(seed)
        rest = torch.arange(horizon + 1).clamp(max=film.slots.shape[1] - 1)
        true_TKD = film.slots[0, rest]
        still_TKD = true_TKD[:1].expand_as(true_TKD)
        if self.kind == "shuffles":
            true_TKD = true_TKD.clone()
            true_TKD[1:, 1:] = true_TKD[1:, 1:].roll(1, dims=1)  # slot 0 is the background
        own = oracle._history[0]["instruction"]
        films = [still_TKD if self.kind == "copies" or t != own else true_TKD for t in text]
        return replace(film, slots=torch.stack(films), texts=tuple(text))

    def _future(self, seed: int) -> Rollout:
        """What the expert would do now, with the scene put back afterwards."""
        env, reset = oracle._history[0]["env"](), oracle._history[0]["reset"]
        for action in Expert(env).actions():
            env.step(action)
        frames = sum(len(info["frame_states"]["object_position"]) for info in oracle._history)
        film = self.parse(np.zeros((frames, 1)), seed=seed)
        env.reset(**reset)
        return film
