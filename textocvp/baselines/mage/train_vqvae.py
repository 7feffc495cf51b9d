"""MAGE, stage 1: train the VQ-VAE to redraw frames from codes.

    textocvp train vqvae --data data/tabletop-train.h5 --val data/tabletop-val.h5 --out runs/vqvae

The loss is the squared error of the redrawn frame, things weighted above the canvas, plus the two terms that draw codes
and features to each other ("Neural Discrete Representation Learning" 2017, equation 3).
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from accelerate import Accelerator
from torch import Tensor
from tqdm import tqdm

from textocvp.baselines.mage.checkpoint import save_vqvae
from textocvp.baselines.mage.config import mage_preset
from textocvp.baselines.mage.vqvae import VQVAE, perplexity
from textocvp.config import with_settings
from textocvp.data.episodes import EpisodeFile
from textocvp.data.feature_cache import FeatureCache, encode_share
from textocvp.data.prefetch import prefetch
from textocvp.metrics.frames import psnr
from textocvp.parsers.base import to_frames
from textocvp.parsers.dino import DinoEncoder
from textocvp.training.losses import thing_weights
from textocvp.training.run import (
    Run,
    SettingsError,
    TrainingSettings,
    allowed_settings,
    check_frame_size,
    finish,
    start,
    step_rng,
)


@dataclass(kw_only=True)
class VQVAETraining(TrainingSettings):
    """Train the VQ-VAE of MAGE (stage 1)."""

    preset: str = "mage-small"
    """Architecture; `textocvp models` lists the presets."""
    steps: int = 2000
    batch: int = 8
    """Clips an update, shared out among the processes."""
    learning_rate: float = 2e-3
    warmup: int = 100
    workers: int = 0
    """Processes (beside each training process) that read clips ahead."""
    clip: int = 4
    """Frames a clip."""
    stride: int = 6
    """Episode frames between two frames of a clip, drawn from 1 to this."""
    thing_weight: float = 4.0
    """How much more a pixel that is not canvas counts."""
    commitment: float = 2.0
    """Weight of the term that draws features to their codes (published)."""
    restart_every: int = 25
    """Updates after which codes that none of them used are put where the features are."""
    restart_until: float = 0.7
    """Share of the updates after which codes are left where they are."""
    cache_features: bool = False
    """Encode all training episodes once and read their features from disk (`vqvae.encoder=dinov2` only)."""


@dataclass(frozen=True)
class ReconstructionMetrics:
    """How well held-out frames are redrawn.

    Attributes:
        psnr: mean peak signal-to-noise ratio of the frames, in dB.
        thing_psnr: the same over the pixels that are not canvas.
        perplexity: how many codes are used, effectively.
        codes: how many codes are used at all.
    """

    psnr: float
    thing_psnr: float
    perplexity: float
    codes: int

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


@dataclass
class Clips:
    """What one update learns from.

    Attributes:
        frames_BTHW3: uint8.
        features_BTLF: of the frozen encoder, float16, where they are cached.
    """

    frames_BTHW3: Tensor
    features_BTLF: Tensor | None = None

    def on(self, device: torch.device) -> tuple[Tensor, Tensor | None]:
        """Frames (B, T, 3, H, W) in -1..1 and features (B, T, L, F), both float32."""
        known = self.features_BTLF
        return to_frames(self.frames_BTHW3, device), None if known is None else known.to(device).float()


@dataclass(frozen=True)
class FrameReader:
    """Reads the frames of a step, in whichever process.

    Attributes:
        episodes: the training episodes.
        args: the stage's settings.
        rows: of the step's clips, those to read.
        features: of the same episodes, if they are cached.
    """

    episodes: EpisodeFile
    args: VQVAETraining
    rows: slice
    features: FeatureCache | None = None

    def __call__(self, step: int) -> Clips:
        args, rng = self.args, step_rng(self.args.seed, step)
        stride = int(rng.integers(1, args.stride + 1))
        length = (args.clip - 1) * stride + 1
        starts = self.episodes.random_starts(rng, args.batch, length)[self.rows]
        clips = Clips(torch.from_numpy(self.episodes.clips(starts, length)[:, ::stride].copy()))
        if self.features is not None:
            clips.features_BTLF = torch.from_numpy(self.features.clips(starts, length, stride))
        return clips


def train(args: VQVAETraining) -> ReconstructionMetrics | None:
    """Run or continue stage 1; writes `out`/checkpoint and returns the figures on the held-out episodes.

    They are None on all processes but the main one.

    Raises:
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
        DinoWeightsError: if the weights of a frozen encoder are missing.
        FeatureCacheError: if `out` holds features of another encoder or of other episodes.
    """
    accelerator = start(args.out, args.precision)
    torch.manual_seed(args.seed)
    with allowed_settings():
        model = VQVAE(with_settings(mage_preset(args.preset), args.set).vqvae).to(accelerator.device)
    uses = CodeUses(model.config.codebook_size)
    accelerator.register_for_checkpointing(uses)
    run, redrawn = Run(args, accelerator, model), None
    with EpisodeFile(args.data, first=args.episodes) as episodes, EpisodeFile(args.val) as held_out:
        check_frame_size(model.config.image_size, "vqvae.image_size", episodes, held_out)
        features = all_features(model.dino, episodes, args, accelerator) if args.cache_features else None
        reader = FrameReader(episodes, args, run.rows, features)
        batches = prefetch(reader, range(run.first, args.steps), args.workers)
        for step, clips in zip(run.steps("vqvae"), batches, strict=True):
            if step % args.restart_every == 0 and step <= args.restart_until * args.steps:
                # Every process looks at the same whole batch, so that all of them move the same codes alike.
                restart_codes(model, uses, replace(reader, rows=slice(None))(step), args.seed + step)
            frames_BT3HW, features_BTLF = clips.on(run.device)
            weights_BT1HW = thing_weights(frames_BT3HW, args.thing_weight)
            whole = run.total(weights_BT1HW.sum())
            counts_K = torch.zeros(model.config.codebook_size, dtype=torch.int64, device=run.device)
            for part in run.parts():
                frames_N3HW, weights_N1HW = (
                    frames_BT3HW[part].flatten(0, 1),
                    weights_BT1HW[part].flatten(0, 1),
                )
                known = () if features_BTLF is None else (features_BTLF[part].flatten(0, 1),)
                with accelerator.autocast():
                    drawn_N3HW, found = run.module(frames_N3HW, *known)
                image = (weights_N1HW * (drawn_N3HW - frames_N3HW).square()).sum() / (3 * whole)
                codebook, commitment = (
                    run.share(part) * term for term in (found.codebook_loss, found.commitment_loss)
                )
                run.backward(
                    image + codebook + args.commitment * commitment,
                    {"loss/image": image, "loss/commitment": commitment},
                )
                counts_K += found.codes_Nhw.flatten().bincount(minlength=len(counts_K))
            counts_K = run.total(counts_K).cpu()
            uses.counts_K += counts_K
            run.update(step, {"perplexity": perplexity(counts_K)})

            if run.is_main and (step + 1) % args.evaluate_every == 0:
                redrawn = measure(model, held_out, range(min(args.evaluate_episodes, len(held_out))))
                run.log(step, {f"val/{name}": value for name, value in asdict(redrawn).items()})
                tqdm.write(f"step {step + 1}: {redrawn}")
                draw_samples(model, held_out, range(4), args.out / "samples" / f"{step + 1:06d}.png")
        if run.is_main:
            save_vqvae(model, args.out / "checkpoint")
            redrawn = measure(model, held_out, range(len(held_out)))
            print(f"final: {redrawn}")
            (args.out / "redrawn.json").write_text(json.dumps(asdict(redrawn), indent=2) + "\n")
    finish(accelerator)
    return redrawn


def all_features(
    dino: DinoEncoder | None, episodes: EpisodeFile, args: VQVAETraining, accelerator: Accelerator
) -> FeatureCache:
    """The cached features of all training episodes, each process having encoded its share.

    Raises:
        SettingsError: if there is no frozen encoder.
    """
    if dino is None:
        raise SettingsError("cache_features needs a frozen encoder: vqvae.encoder=dinov2")
    folder, share = args.out / "features-train", (accelerator.process_index, accelerator.num_processes)
    encode_share(dino, episodes, folder, *share, device=accelerator.device)
    accelerator.wait_for_everyone()
    return FeatureCache(dino, episodes, folder)


@torch.no_grad()
def restart_codes(model: VQVAE, uses: CodeUses, clips: Clips, seed: int) -> int:
    """Put the unused codes onto features of these frames and begin to count anew; how many there were."""
    device = model.codebook.codes_KC.device
    frames_BT3HW, features_BTLF = clips.on(device)
    known = () if features_BTLF is None else (features_BTLF.flatten(0, 1),)
    features_XC = model.features(frames_BT3HW.flatten(0, 1), *known).flatten(0, 2)
    generator = torch.Generator().manual_seed(seed)
    moved = model.codebook.restart((uses.counts_K == 0).to(device), features_XC, generator)
    uses.counts_K = torch.zeros_like(uses.counts_K)
    return moved


@torch.no_grad()
def measure(
    model: VQVAE, episodes: EpisodeFile, chosen: Iterable[int], frame_step: int = 3
) -> ReconstructionMetrics:
    """Figures over every so many-th frame of some episodes."""
    device = model.codebook.codes_KC.device
    ratios, errors, weights = [], [], []
    counts_K = torch.zeros(model.config.codebook_size, dtype=torch.int64)
    for index in chosen:
        frames_N3HW = to_frames(episodes.episode(index).frames[None, ::frame_step], device)[0]
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
def draw_samples(
    model: VQVAE, episodes: EpisodeFile, chosen: Iterable[int], path: Path, columns: int = 8
) -> None:
    """A picture with two rows an episode: frames, and the same redrawn from their codes."""
    rows = []
    for index in chosen:
        frames = episodes.episode(index).frames
        frames = frames[np.linspace(0, len(frames) - 1, columns).round().astype(int)]
        redrawn = model.decode(model.encode(to_frames(frames[None], model.codebook.codes_KC.device)[0]))
        drawn = (
            ((redrawn.clamp(-1, 1) + 1) * 127.5).round().permute(0, 2, 3, 1).cpu().numpy().astype(np.uint8)
        )
        rows += [np.concatenate(list(strip), axis=1) for strip in (frames, drawn)]
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, np.concatenate(rows).repeat(2, 0).repeat(2, 1))
