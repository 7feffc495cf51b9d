"""MAGE, stage 2: train the text encoder and the axial transformer on the codes of a trained VQ-VAE.

    textocvp train mage --vqvae runs/vqvae/checkpoint --data data/tabletop-train.h5 --val data/tabletop-val.h5 \\
        --out runs/mage

Every episode is encoded once. Then the transformer learns from whole episodes, all frames in one pass, teacher forced:
cross-entropy of the next frame's codes. As TextOCVP's predictor here does, it may in the last updates learn from frames
that it imagined itself, from which it must predict the true next codes (dataset aggregation, Ross et al. 2011); with
`--autoregressive 0` it is trained as published.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from textocvp.baselines.mage.axial import code_loss
from textocvp.baselines.mage.checkpoint import load_vqvae
from textocvp.baselines.mage.codes import cached_codes
from textocvp.baselines.mage.config import mage_preset
from textocvp.baselines.mage.evaluation import Imagined, measure
from textocvp.baselines.mage.model import Mage
from textocvp.config import with_settings
from textocvp.data.cache import FrameCache
from textocvp.text.base import WordBatch
from textocvp.training.run import (
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
class MageTraining(TrainingSettings):
    """Train the text encoder and the transformer of MAGE on the codes of a trained VQ-VAE (stage 2)."""

    vqvae: Path
    """Checkpoint folder of the trained VQ-VAE, from `textocvp train vqvae`."""
    preset: str = "mage-small"
    """Text encoder and transformer; `textocvp models` lists the presets."""
    steps: int = 1200
    batch: int = 4
    """Episodes an update, shared out among the processes."""
    learning_rate: float = 1e-3
    warmup: int = 100
    stride: int = 1
    """Episode frames between two frames of a video, drawn from 1 to this; the model is told."""
    changed_weight: float = 5.0
    """How much more a code counts that is not that of the first frame."""
    autoregressive: float = 0.3
    """Share of the updates, the last ones, that learn from imagined frames; 0 as published."""
    evaluate_every: int = 300
    evaluate_episodes: int = 16


class MageStage(nn.Module):
    """What stage 2 trains, as one module, so that several processes can share its gradients."""

    def __init__(self, model: Mage) -> None:
        super().__init__()
        self.text, self.axial = model.text, model.axial

    def forward(self, seen_BThw: Tensor, words: WordBatch, speed_B: Tensor, imagined: int) -> Tensor:
        """Scores (B, S, g, g, P, K) of the codes of frames 1 to S = T + imagined.

        The transformer adds `imagined` frames to those that are seen, and predicts from every frame the next.
        """
        text = self.text.encode(words)
        if imagined:
            added_BShw = self.axial.imagine(seen_BThw, text, imagined, speed_B)
            # Under autocast some versions of torch would reuse weights that were cast without a gradient.
            torch.clear_autocast_cache()
            seen_BThw = torch.cat([seen_BThw, added_BShw], dim=1)
        return self.axial(seen_BThw, text, speed_B)


def train(args: MageTraining) -> Imagined | None:
    """Run or continue stage 2; writes `out`/checkpoint, a whole model, and returns its figures on all of `val`.

    They are None on all processes but the main one.

    Raises:
        CheckpointError: if `vqvae` is no checkpoint of a VQ-VAE.
        CacheError: if `out` holds codes of another VQ-VAE or of other episodes.
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
    """
    accelerator = open_run(args.out, args.precision)
    torch.manual_seed(args.seed)
    model = assemble(args).to(accelerator.device)
    run = Run(args, accelerator, MageStage(model))
    with open_data(args, model.config.vqvae.image_size, "vqvae.image_size") as (episodes, held_out):

        def measured(count: int | None) -> Imagined:
            return measure(model, held_out, range(len(held_out))[:count])

        share = (accelerator.process_index, accelerator.num_processes)
        cache = cached_codes(model.vqvae, episodes, args.out / "codes-train", *share)
        accelerator.wait_for_everyone()
        words = model.text.lookup(episodes.instructions)
        for step in run.steps("mage"):
            rng = step_rng(args.seed, step)
            imagined = next_imagined(args, step, model.config.axial.frames, rng)
            codes_BThw, speed, chosen = draw(args, cache, model.config.axial.frames, rng, run.rows)
            codes_BThw = codes_BThw.to(run.device)
            weights_BThw = 1 + args.changed_weight * (codes_BThw[:, 1:] != codes_BThw[:, :1])
            whole = run.total(weights_BThw.sum())
            for part in run.micro_batches():
                codes, weights = codes_BThw[part], model.axial.patches(weights_BThw[part])
                seen, target = codes[:, : codes.shape[1] - 1 - imagined], model.axial.patches(codes[:, 1:])
                speed_B = torch.full((len(codes),), float(speed), device=run.device)
                with accelerator.autocast():
                    scores = run.module(seen, words.select(chosen[part]), speed_B, imagined)
                run.backward(code_loss(scores, target, weights) / whole)
            run.update(step, {"imagined": float(imagined)})
            run.evaluate(step, measured)
        metrics = run.finish(model.save, measured, "imagined.json")
    close_run(accelerator)
    return metrics


def assemble(args: MageTraining) -> Mage:
    """A model with the trained VQ-VAE, frozen, and a text encoder and a transformer to train.

    Raises:
        SettingsError: if a setting is of the VQ-VAE.
    """
    for setting in args.set:
        if setting.startswith(("vqvae", "name", "architecture")):
            raise SettingsError(f"{setting!r}: the VQ-VAE comes trained; set text.* and axial.* only")
    vqvae = load_vqvae(args.vqvae)
    config = replace(with_settings(mage_preset(args.preset), args.set), vqvae=vqvae.config)
    with allowed_settings():
        model = Mage(config)
    model.take_vqvae(vqvae)
    return model


def next_imagined(args: MageTraining, step: int, frames: int, rng: np.random.Generator) -> int:
    """How many of the frames that update number `step` learns from are imagined; grows to all but the first."""
    begin = round(args.steps * (1 - args.autoregressive))
    if step < begin:
        return 0
    grown = min(1.0, (step - begin + 1) / max(1.0, 0.8 * (args.steps - begin)))
    return int(rng.integers(0, max(1, round(grown * (frames - 2))) + 1))


def draw(
    args: MageTraining, cache: FrameCache, frames: int, rng: np.random.Generator, rows: slice
) -> tuple[Tensor, int, Tensor]:
    """These rows of a step's batch: codes (B, T, h, w), the stride between their frames, the episodes' numbers (B)."""
    stride = int(rng.integers(1, args.stride + 1))
    chosen_B = rng.integers(len(cache), size=args.batch)[rows]
    codes_BThw = torch.from_numpy(cache.at(chosen_B, stride * np.arange(frames)).astype(np.int64))
    return codes_BThw, stride, torch.from_numpy(chosen_B)
