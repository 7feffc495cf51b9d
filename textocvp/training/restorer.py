"""Train the restorer of a checkpoint, which takes noise, JPEG and burnt-out colours off pictures of its world.

    textocvp train restorer --parser tabletop-small --episodes 500 --data data/tabletop-train.h5 \\
        --val data/tabletop-val.h5 --out runs/restorer

It learns from frames and what a bad camera makes of them (`spoil`); no label is used, and all else of the checkpoint
stays as it is.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from textocvp.config import with_settings
from textocvp.data.episodes import Episodes
from textocvp.metrics import Interval, bootstrap_interval
from textocvp.model import TextOCVP, check_parts
from textocvp.pictures.restorer import Restorer, RestorerConfig
from textocvp.training.light import spoil
from textocvp.training.run import (
    Metrics,
    Run,
    SettingsError,
    TrainingSettings,
    allowed_settings,
    close_run,
    open_data,
    open_run,
    step_rng,
)


@dataclass(kw_only=True)
class RestorerTraining(TrainingSettings):
    """Train a network that puts pictures right before they are parsed."""

    parser: str
    """Checkpoint that gets it: a folder, a bundled name or a hub id. Its parser must know its own frames (`textocvp
    measure`)."""
    preset: ClassVar[None] = None
    steps: int = 3000
    learning_rate: float = 2e-3
    warmup: int = 150


@dataclass(frozen=True)
class RestorerMetrics(Metrics):
    """How far spoiled first frames of held-out episodes are from what they were, on average, in values of 0..255."""

    restored: Interval
    spoiled: Interval  # the same without the restorer

    def __str__(self) -> str:
        return f"pixels off by {self.restored}, unrestored {self.spoiled}"


def train(args: RestorerTraining) -> RestorerMetrics | None:
    """Run or continue the training; writes `out`/checkpoint, whose metrics the main process returns.

    Raises:
        CheckpointError: if `parser` is no checkpoint.
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
    """
    accelerator = open_run(args.out, args.precision)
    torch.manual_seed(args.seed)
    model = TextOCVP.from_pretrained(args.parser)
    if model.config.own_frames is None or not model.config.own_frames.canvas:
        raise SettingsError(f"{args.parser} knows no canvas of its frames, by which bad pictures are told")
    if other := [setting for setting in args.set if not setting.startswith("restorer.")]:
        raise SettingsError(f"{other[0]!r}: all else comes trained; set restorer.* only")
    with allowed_settings():
        model.config = with_settings(replace(model.config, restorer=RestorerConfig()), args.set)
        check_parts(model.config)
        assert model.config.restorer is not None
        model.restorer = Restorer(model.config.restorer)
    model.to(accelerator.device)
    with open_data(args, model.config.parser.image_size, "parser.image_size") as (episodes, held_out):
        run = Run(args, accelerator, model.restorer)
        measured = partial(measure, model.restorer, held_out)
        for step in run.steps("restorer"):
            rng = step_rng(args.seed, step)
            starts, seeds = episodes.random_starts(rng, args.batch, 1), rng.integers(2**63, size=args.batch)
            spoiled_B3HW, clean_B3HW = spoiled(episodes, starts[run.rows], seeds[run.rows], run.device)
            for part in run.micro_batches():
                off = (run.module(spoiled_B3HW[part]) - clean_B3HW[part]).abs().mean()
                run.backward(run.weight(part) * off)
            run.update(step)
            run.evaluate(step, measured)
        metrics = run.finish(model.save_pretrained, measured, "restored.json")
    close_run(accelerator)
    return metrics


def spoiled(
    episodes: Episodes, starts_B: NDArray[np.int64], seeds_B: NDArray[np.int64], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Frames (B, 3, H, W) in -1..1 as they came out badly, and as they were."""
    frames_BHW3 = episodes.clips(starts_B, 1)[:, 0]
    pairs = [spoil(frame, np.random.default_rng(seed)) for frame, seed in zip(frames_BHW3, seeds_B, strict=True)]
    before, after = (torch.from_numpy(np.stack(part)).permute(0, 3, 1, 2) for part in zip(*pairs, strict=True))
    return before.to(device) / 127.5 - 1, after.to(device) / 127.5 - 1


@torch.no_grad()
def measure(restorer: Restorer, episodes: Episodes, count: int | None) -> RestorerMetrics:
    """Metrics of the first frames of the first so many episodes, or of all (None)."""
    starts, device = episodes.starts[:count], next(restorer.parameters()).device
    found: tuple[list[Tensor], list[Tensor]] = ([], [])
    for at in range(0, len(starts), 16):
        part = starts[at : at + 16]
        before, clean = spoiled(episodes, part, np.arange(at, at + len(part)), device)
        for pictures, values in zip((restorer(before).clamp(-1, 1), before), found, strict=True):
            values.append((pictures - clean).abs().mean((1, 2, 3)).cpu() * 127.5)
    after_E, before_E = (torch.cat(values).numpy() for values in found)
    return RestorerMetrics(bootstrap_interval(after_E), bootstrap_interval(before_E))
