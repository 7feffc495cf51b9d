"""What every model and every control makes of one scene, as films beside what really happened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from experiments.protocol.contenders import Contender
from experiments.protocol.object_scenes import resting
from experiments.protocol.scenes import Drawn, TestScene, draw, play, wrong_text
from experiments.protocol.workers import Worker
from textocvp import Rollout, WorldModel


@dataclass(frozen=True, eq=False)
class Happened:
    """A scene and what the expert did in it.

    Attributes:
        drawn: the scene as it was drawn.
        text, wrong_text: its instruction, and another one.
        frames: (T + 1, H, W, 3) uint8, the first observation included. An episode of the tabletop has 24 more; what
            comes after its end is its last frame, because the arm has come to rest (in the simulator 16 further frames
            differ from it by less than .2 of 255 grey levels in the mean; a test checks it).
        segmentations: (T + 1, H, W), as in `Played`.
    """

    drawn: Drawn
    text: str
    wrong_text: str
    frames: np.ndarray
    segmentations: np.ndarray

    @property
    def film(self) -> Tensor:
        """The frames as (T + 1, 3, H, W) in 0..1."""
        return torch.from_numpy(self.frames).permute(0, 3, 1, 2).float() / 255


@dataclass(frozen=True, eq=False)
class Film:
    """What a method makes of a scene.

    Attributes:
        method: `ours`, a baseline, or a control: `true frames` (parser and renderer fed with the real frames, the
            ceiling), `wrong text` (ours, told something else), `copy frame` (the first real frame, for ever).
        frames: (t + 1, 3, H, W) in 0..1, the redrawn first one included. Shorter than asked for where a model cannot
            look as far.
        rollout: its slots, where it has any (B = 1).
    """

    method: str
    frames: Tensor
    rollout: Rollout | None = None


def film(
    worker: Worker,
    scene: TestScene,
    contenders: Sequence[Contender],
    *,
    horizon: int,
    seed: int,
    controls: bool = True,
) -> tuple[Happened, list[Film]]:
    """Let everybody imagine a scene, and then the expert carry out its instruction.

    Args:
        contenders: the baselines.
        horizon: how many frames are looked ahead.
        seed: of the slots.
        controls: whether the controls are wanted.

    Returns:
        what happened; the films of ours, the baselines and the controls, in the order of a table.
    """
    env = worker.environment(scene)
    drawn = draw(env, scene)
    text, wrong = drawn.texts[0], wrong_text(drawn)
    model, seen = worker.world_model, drawn.observation["rgb"]
    both = model.rollout(seen, [text, wrong], horizon=_ahead(model.longest_horizon, horizon), seed=seed)
    ours, told_wrong = both.select(0), both.select(1)
    films = [Film("ours", ours.frames[0], ours)]
    films += [_baseline(worker, contender, seen, text, horizon, seed) for contender in contenders]
    played = play(env, drawn)
    happened = Happened(
        drawn=drawn,
        text=text,
        wrong_text=wrong,
        frames=resting(played.frames, horizon + 1),
        segmentations=resting(played.segmentations, horizon + 1),
    )
    if controls:
        parsed = model.parse(played.frames, seed=seed)
        last = torch.arange(horizon + 1).clamp(max=len(played.frames) - 1)
        films += [
            Film("true frames", parsed.frames[0][last], parsed),
            Film("wrong text", told_wrong.frames[0], told_wrong),
            Film("copy frame", happened.film[:1].expand(horizon + 1, -1, -1, -1)),
        ]
    return happened, films


def _baseline(
    worker: Worker, contender: Contender, seen: np.ndarray, text: str, horizon: int, seed: int
) -> Film:
    model = worker.other(contender.load)
    ahead = _ahead(contender.longest, horizon)
    if not contender.slots:
        frames_1T3HW = model.imagine(seen, [text], horizon=ahead, seed=seed)
        return Film(contender.method, frames_1T3HW[0].float().cpu())
    rollout = cast(WorldModel, model).rollout(seen, [text], horizon=ahead, seed=seed)
    return Film(contender.method, rollout.frames[0], rollout)


def slots_of(worker: Worker, film: Film, seed: int) -> Rollout:
    """The slots of a film: its own, or for a model without slots what our parser sees in its frames (B = 1)."""
    if film.rollout is not None:
        return film.rollout
    return worker.world_model.parse(as_pictures(film.frames), seed=seed)


def as_pictures(frames_T3HW: Tensor) -> np.ndarray:
    """Frames in 0..1 as (T, H, W, 3) uint8."""
    return (frames_T3HW * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


def _ahead(longest: int | None, asked: int) -> int:
    return asked if longest is None else min(longest, asked)
