"""What each update of stage 2 trains: how much is given, how much is imagined, and which slots count how much.

Everything random here is drawn for the whole batch, so that a process that computes some of its rows gets the rows that
a process alone would have computed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from textocvp.config import PredictorConfig
from textocvp.predictor_data import SlotBatch, SlotBatches
from textocvp.predictor_loss import moving_weights
from textocvp.training import step_rng

if TYPE_CHECKING:
    from textocvp.train_predictor import PredictorTraining


@dataclass(frozen=True)
class Lesson:
    """What one update trains.

    Attributes:
        seen: how many true frames are given, from the first on.
        imagined: how many frames the model adds to them itself.
    """

    seen: int
    imagined: int


def next_lesson(
    args: PredictorTraining, predictor: PredictorConfig, step: int, frames: int, rng: np.random.Generator
) -> Lesson:
    """The lesson of update number `step`, for episodes of `frames` frames."""
    begin = round(args.steps * (1 - args.autoregressive)) if predictor.attention == "causal" else 0
    if step < begin:
        return Lesson(frames - 1, 0)
    grown = min(1.0, (step - begin) / max(1.0, 0.8 * (args.steps - begin)))
    longest = min(frames - 1, args.horizon + round(grown * (frames - 1 - args.horizon)))
    horizon = int(rng.integers((longest + 1) // 2, longest + 1))
    if predictor.attention == "causal":
        return Lesson(frames - horizon, horizon - 1)
    return Lesson(int(rng.integers(1, frames - horizon + 1)), horizon - 1)


@dataclass
class Exercise:
    """A lesson with the episodes it is given on.

    Attributes:
        lesson: how much is seen and imagined.
        batch: the episodes.
        seen_BTKD: the slots that are given.
        forgetful_B: sequences whose frames do not see their past.
        true_BSKD: the slots that are to be predicted.
        weights_BSK: how much each of them counts; over all rows of the batch they sum to 1.
        drawn_BF: which of the S predicted frames are drawn for the image loss.
        first: number of the first predicted frame.
    """

    lesson: Lesson
    batch: SlotBatch
    seen_BTKD: Tensor
    forgetful_B: Tensor
    true_BSKD: Tensor
    weights_BSK: Tensor
    drawn_BF: np.ndarray
    first: int

    def select(self, rows: slice) -> Exercise:
        """Some rows of it."""
        return replace(
            self,
            batch=self.batch.select(rows),
            seen_BTKD=self.seen_BTKD[rows],
            forgetful_B=self.forgetful_B[rows],
            true_BSKD=self.true_BSKD[rows],
            weights_BSK=self.weights_BSK[rows],
            drawn_BF=self.drawn_BF[rows],
        )

    def to(self, device: torch.device) -> Exercise:
        return replace(
            self,
            batch=self.batch.to(device),
            seen_BTKD=self.seen_BTKD.to(device),
            forgetful_B=self.forgetful_B.to(device),
            true_BSKD=self.true_BSKD.to(device),
            weights_BSK=self.weights_BSK.to(device),
        )


def exercise(
    args: PredictorTraining, predictor: PredictorConfig, batches: SlotBatches, step: int
) -> Exercise:
    """What all processes together do in update number `step`."""
    rng = step_rng(args.seed, step)
    batch = batches.draw(rng, args.batch)
    lesson = next_lesson(args, predictor, step, batches.frames, rng)
    seen_BTKD = batches.noisy(rng, batch.slots_BTKD[:, : lesson.seen])
    forgetful_B = torch.from_numpy(rng.random(args.batch) < args.forgetful)
    last = lesson.seen + lesson.imagined  # the number of the last frame that is predicted
    # The causal form predicts from every frame the next, the window form only new frames.
    predictions = last if predictor.attention == "causal" else lesson.imagined + 1
    drawn_BF = rng.integers(predictions, size=(args.batch, args.image_frames))
    first = last + 1 - predictions
    true_BTKD = batch.slots_BTKD[:, first - 1 : last + 1]
    weights_BSK = moving_weights(true_BTKD, batches.layout, args.moving, ever=lesson.imagined > 0)
    weights_BSK = weights_BSK / weights_BSK.sum().clamp(min=1e-6)
    return Exercise(lesson, batch, seen_BTKD, forgetful_B, true_BTKD[:, 1:], weights_BSK, drawn_BF, first)
