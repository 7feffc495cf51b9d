"""MAGE, stage 1: train the VQ-VAE to redraw frames from codes.

    textocvp train vqvae --data data/tabletop-train.h5 --val data/tabletop-val.h5 --out runs/vqvae

The loss is the squared error of the redrawn frame, things weighted above the canvas, plus the two terms that draw codes
and features to each other ("Neural Discrete Representation Learning" 2017, equation 3).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from textocvp.baselines.mage.presets import mage_preset
from textocvp.baselines.mage.vqvae import VQVAE, perplexity, save_vqvae
from textocvp.config import with_settings
from textocvp.data.episodes import Episodes
from textocvp.metrics import psnr
from textocvp.parsers.base import to_frames
from textocvp.training.clips import Clips, ClipTraining, check_clips, clip_reader, save_samples, to_pictures
from textocvp.training.losses import thing_weights
from textocvp.training.run import Metrics, Run, allowed_settings, close_run, open_data, open_run

COMMITMENT = 2.0  # weight of the term that draws features to their codes (published)
RESTART_UNTIL = 0.7  # share of the updates after which codes are left where they are


@dataclass(kw_only=True)
class VQVAETraining(ClipTraining):
    """Train the VQ-VAE of MAGE (stage 1)."""

    preset: str = "mage-small"
    """Architecture; `textocvp models` lists the presets."""
    steps: int = 2000
    batch: int = 8
    learning_rate: float = 2e-3
    warmup: int = 100
    clip: int = 4
    stride: int = 6
    restart_every: int = 25
    """Updates after which codes that none of them used are put where the features are."""


@dataclass(frozen=True)
class ReconstructionMetrics(Metrics):
    """How well held-out frames are redrawn."""

    psnr: float  # mean over the frames, in dB
    thing_psnr: float  # of the pixels that are not canvas, in dB
    perplexity: float  # how many codes are used, effectively
    codes: int  # how many codes are used at all

    def __str__(self) -> str:
        return (
            f"redrawn at {self.psnr:.2f} dB, things at {self.thing_psnr:.2f} dB; {self.codes} codes used, "
            f"perplexity {self.perplexity:.0f}"
        )


class CodeUses:
    """How often each code was used since codes were last restarted; part of a run's saved state."""

    def __init__(self, codes: int) -> None:
        self.counts_K = torch.zeros(codes, dtype=torch.int64)

    def state_dict(self) -> dict[str, Tensor]:
        return {"counts_K": self.counts_K}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.counts_K = state["counts_K"]


def train(args: VQVAETraining) -> ReconstructionMetrics | None:
    """Run or continue stage 1; writes `out`/checkpoint, whose metrics the main process returns.

    Raises:
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
        WeightsError: if the weights of a frozen encoder are missing.
        CacheError: if `out` holds features of another encoder or of other episodes.
    """
    accelerator = open_run(args.out, args.precision)
    torch.manual_seed(args.seed)
    with allowed_settings():
        model = VQVAE(with_settings(mage_preset(args.preset), args.set).vqvae).to(accelerator.device)
    uses = CodeUses(model.config.codebook_size)
    accelerator.register_for_checkpointing(uses)
    with open_data(args, model.config.image_size, "vqvae.image_size") as (episodes, held_out):
        check_clips(args, episodes, model.dino)
        run = Run(args, accelerator, model)

        def measured(count: int | None) -> ReconstructionMetrics:
            return measure(model, held_out, range(len(held_out))[:count])

        reader = clip_reader(run, args, episodes, model.dino)
        for step, clips in reader.steps(run, "vqvae"):
            if step % args.restart_every == 0 and step <= RESTART_UNTIL * args.steps:
                # Every process looks at the same whole batch, so that all of them move the same codes alike.
                restart_codes(model, uses, replace(reader, rows=slice(None))(step), args.seed + step)
            frames_BT3HW, features_BTLF = clips.on(run.device)
            weights_BT1HW = thing_weights(frames_BT3HW, args.thing_weight)
            whole = run.total(weights_BT1HW.sum())
            counts_K = torch.zeros(model.config.codebook_size, dtype=torch.int64, device=run.device)
            for part in run.micro_batches():
                frames_N3HW, weights_N1HW = (x[part].flatten(0, 1) for x in (frames_BT3HW, weights_BT1HW))
                known = None if features_BTLF is None else features_BTLF[part].flatten(0, 1)
                with accelerator.autocast():
                    drawn_N3HW, found = run.module(frames_N3HW, known)
                image = (weights_N1HW * (drawn_N3HW - frames_N3HW).square()).sum() / (3 * whole)
                terms = (found.codebook_loss, found.commitment_loss)
                codebook, commitment = (run.weight(part) * term for term in terms)
                total = image + codebook + COMMITMENT * commitment
                run.backward(total, {"image": image, "commitment": commitment})
                counts_K += found.codes_Nhw.flatten().bincount(minlength=len(counts_K))
            counts_K = run.total(counts_K).cpu()
            uses.counts_K += counts_K
            run.update(step, {"perplexity": perplexity(counts_K)})
            run.evaluate(step, measured, lambda path: draw_samples(model, held_out, path))
        metrics = run.finish(lambda folder: save_vqvae(model, folder), measured, "redrawn.json")
    close_run(accelerator)
    return metrics


@torch.no_grad()
def restart_codes(model: VQVAE, uses: CodeUses, clips: Clips, seed: int) -> None:
    """Put the unused codes onto features of these frames and begin to count anew."""
    frames_BT3HW, features_BTLF = clips.on(model.device)
    known = None if features_BTLF is None else features_BTLF.flatten(0, 1)
    features_XC = model.features(frames_BT3HW.flatten(0, 1), known).flatten(0, 2)
    generator = torch.Generator().manual_seed(seed)
    model.codebook.restart((uses.counts_K == 0).to(model.device), features_XC, generator)
    uses.counts_K = torch.zeros_like(uses.counts_K)


@torch.no_grad()
def measure(model: VQVAE, episodes: Episodes, numbers: Sequence[int]) -> ReconstructionMetrics:
    """Metrics of every third frame of some episodes."""
    ratios, errors, weights = [], [], []
    counts_K = torch.zeros(model.config.codebook_size, dtype=torch.int64)
    for index in numbers:
        frames_N3HW = to_frames(episodes.frames(index)[None, ::3], model.device)[0]
        codes_Nhw = model.encode(frames_N3HW)
        counts_K += codes_Nhw.flatten().bincount(minlength=len(counts_K)).cpu()
        real, drawn = (frames_N3HW + 1) / 2, (model.decode(codes_Nhw).clamp(-1, 1) + 1) / 2
        ratios.append(psnr(drawn, real))
        thing_N1HW = thing_weights(frames_N3HW, 1.0) - 1
        errors.append((thing_N1HW * (drawn - real).square()).sum() / 3)
        weights.append(thing_N1HW.sum())
    error = torch.stack(errors).sum() / torch.stack(weights).sum().clamp_min(1)
    return ReconstructionMetrics(
        psnr=float(torch.cat(ratios).mean()),
        thing_psnr=float(-10 * error.log10()),
        perplexity=perplexity(counts_K),
        codes=int((counts_K > 0).sum()),
    )


@torch.no_grad()
def draw_samples(model: VQVAE, episodes: Episodes, path: Path) -> None:
    """A picture with two rows an episode: frames, and the same redrawn from their codes."""

    def redraw(index: int, frames_T3HW: Tensor, times: NDArray[np.int64]) -> list[NDArray[np.uint8]]:
        return [to_pictures(model.decode(model.encode(frames_T3HW[times])))]

    save_samples(path, episodes, redraw, model.device)
