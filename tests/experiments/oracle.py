"""A test double of the world model for whole studies: it imagines by geometry from the simulator's own poses.

It listens to the environments of its process, so it knows the scene that was reset last and every frame
since. That is cheating on purpose: the studies can then be proven without a trained checkpoint.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from envs.tabletop import TabletopEnv
from planning import PinholeCamera
from tests.planning.oracle import ARM, OracleWorldModel
from textocvp.presets import SMALL_TEXT
from textocvp.rollout import Rollout
from textocvp.text import build_text_encoder
from textocvp.world_model import Checkpoint

READER = build_text_encoder(SMALL_TEXT.for_captions(["put the red block in the blue bowl"]))

_history: list[dict[str, Any]] = []


def _listen() -> None:
    if getattr(TabletopEnv, "_heard", False):
        return
    reset, step = TabletopEnv.reset, TabletopEnv.step

    def heard_reset(self: TabletopEnv, *, seed: int | None = None, options: Any = None) -> Any:
        result = reset(self, seed=seed, options=options)
        # A weak reference: what a test drops must be free to end.
        _history[:] = [{**result[1], "env": weakref.ref(self), "reset": {"seed": seed, "options": options}}]
        return result

    def heard_step(self: TabletopEnv, action: Any) -> Any:
        result = step(self, action)
        _history.append(result[-1])
        return result

    TabletopEnv.reset, TabletopEnv.step, TabletopEnv._heard = heard_reset, heard_step, True  # type: ignore


@dataclass(frozen=True)
class LoadOracle:
    """Makes the double; `stubborn` blocks of these colours it imagines unmoved."""

    stubborn: tuple[str, ...] = ()

    def __call__(self) -> StudyOracle:
        _listen()
        return StudyOracle(self.stubborn)


class StudyOracle:
    """See the module."""

    checkpoint = Checkpoint("oracle", "0" * 64)
    longest_horizon = 24

    def __init__(self, stubborn: Sequence[str]) -> None:
        self._stubborn = stubborn

    def parse(self, video: np.ndarray, *, seed: int = 0, num_slots: int | None = None) -> Rollout:
        """One frame: the scene as it is now. Several: as many frames since the last reset, whatever they show.

        It has a slot for everything, whatever `num_slots` says.
        """
        oracle, now = self._oracle(), None
        parsed = oracle.parse(video[-1:], seed=seed)
        if len(video) == 1:
            return parsed
        states = [info["frame_states"] for info in _history]
        position_TN3 = np.concatenate([state["object_position"] for state in states])
        tip_T3 = np.concatenate([state["gripper"] for state in states])[:, :3]
        assert len(position_TN3) >= len(video)
        slots = []
        for t in range(len(video)):
            now = [{**item, "position": position_TN3[t, i]} for i, item in enumerate(_history[-1]["objects"])]
            slots_KD = OracleWorldModel(lambda now=now: now, oracle.camera).parse(video[:1], seed=seed).slots[0, 0]
            (arm,) = (slots_KD[:, 3] == ARM).nonzero().flatten().tolist()
            color = slots_KD[arm, 4:7] * 0.5 + 0.5
            slots_KD[arm] = oracle._slot(ARM, tip_T3[t] + [0, 0, 0.01], color)
            slots.append(slots_KD)
        return oracle._rollout(torch.stack(slots)[None], ())

    def rollout(self, obs: Rollout | np.ndarray, text: Sequence[str], *, horizon: int = 24, seed: int = 0) -> Rollout:
        parsed = obs if isinstance(obs, Rollout) else self.parse(obs[None], seed=seed)
        text = [READER.reads(one) for one in text]
        return self._oracle().rollout(parsed, text, horizon=horizon, seed=seed)

    def _oracle(self) -> OracleWorldModel:
        camera = PinholeCamera.from_info(_history[-1]["camera"])
        return OracleWorldModel(lambda: _history[-1]["objects"], camera, hands_off=self._stubborn)
