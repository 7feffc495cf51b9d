"""Short runs of the stages on toy episodes, and what they left."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.textocvp.conftest import PLACED, PUBLISHED
from textocvp.training import run as training
from textocvp.training.parser import ParserTraining
from textocvp.training.predictor import PredictorTraining
from textocvp.training.run import TrainingSettings


def parser_run(folder: Path, out: str, **changes) -> ParserTraining:
    settings = dict(preset=PUBLISHED.name, steps=3, batch=5, clip=2, warmup=1) | changes
    return ParserTraining(folder / "train.h5", folder / "val.h5", folder / out, **settings)


def predictor_run(folder: Path, out: str, **changes) -> PredictorTraining:
    settings = dict(parser=folder / PLACED.name, steps=3, batch=5, warmup=1, horizon=2)
    return PredictorTraining(folder / "train.h5", folder / "val.h5", folder / out, **(settings | changes))


def train(args: TrainingSettings):
    """Run the stage whose settings these are."""
    return import_module(type(args).__module__).train(args)


def train_killed_after(args: TrainingSettings, step: int) -> None:
    """Train with a state saved after every update, and die when that of `step` is saved."""
    save = training.save_state

    def killed(accelerator, out, next_step):
        save(accelerator, out, next_step)
        if next_step == step:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "save_state", killed)
        patch.setattr(args, "save_minutes", 0.0)
        with pytest.raises(KeyboardInterrupt):
            train(args)


def weights(out: Path) -> dict[str, torch.Tensor]:
    return load_file(out / "checkpoint" / "model.safetensors")


def same_weights(one: Path, other: Path) -> bool:
    a, b = weights(one), weights(other)
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def losses(out: Path) -> list[float]:
    """What every step's loss was, as the log has it."""
    log = EventAccumulator(str(out / "logs" / "training"))
    log.Reload()
    return [scalar.value for scalar in log.Scalars("loss/total")]
