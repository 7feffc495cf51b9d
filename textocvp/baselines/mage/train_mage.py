"""MAGE, stage 2: train the text encoder and the axial transformer on the codes of a trained VQ-VAE.

    textocvp train mage --vqvae runs/vqvae/checkpoint --data data/tabletop-train.h5 --val data/tabletop-val.h5 \\
        --out runs/mage

Every episode is encoded once. The transformer learns from whole episodes in one pass, teacher forced: cross-entropy of
the next frame's codes. In the last updates it also learns from frames that it imagined itself, as TextOCVP's predictor
does here (dataset aggregation, Ross et al. 2011); with `--autoregressive 0` it is trained as published.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from textocvp.baselines.mage.axial import code_loss
from textocvp.baselines.mage.model import Mage
from textocvp.baselines.mage.presets import mage_preset
from textocvp.baselines.mage.vqvae import VQVAE, load_vqvae
from textocvp.config import with_settings
from textocvp.data.cache import FrameCache, weights_fingerprint
from textocvp.data.episodes import Episodes
from textocvp.metrics import psnr
from textocvp.model import evaluating
from textocvp.parsers.base import to_frames
from textocvp.text.base import WordBatch
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
    """Episode frames between two frames of a video, drawn from 1 to this; an input of the model."""
    changed_weight: float = 5.0
    """How much more a code counts that is not that of the first frame."""
    autoregressive: float = 0.3
    """Share of the updates, the last ones, that learn from imagined frames; 0 as published."""
    evaluate_every: int = 300
    evaluate_episodes: int = 16


@dataclass(frozen=True)
class PredictionMetrics(Metrics):
    """How well rollouts from the first frame to the longest horizon are predicted."""

    psnr: float  # mean over the imagined frames, in dB
    still_psnr: float  # what it would be if the first frame, redrawn, never changed
    redrawn_psnr: float  # what it would be if every code were right: the VQ-VAE's own
    codes: float  # share of the imagined codes that are right
    changed_codes: float  # the same over the codes that are not those of the first frame

    def __str__(self) -> str:
        return (
            f"imagined at {self.psnr:.2f} dB (nothing moves {self.still_psnr:.2f}, all codes right "
            f"{self.redrawn_psnr:.2f}); {100 * self.codes:.1f} % of the codes right, "
            f"{100 * self.changed_codes:.1f} % of those that change"
        )


class MageStage(nn.Module):
    """What stage 2 trains, as one module, so that several processes can share its gradients."""

    def __init__(self, model: Mage) -> None:
        super().__init__()
        self.text, self.axial = model.text, model.axial

    def forward(self, seen_BThw: Tensor, words: WordBatch, speed_B: Tensor, imagined: int) -> Tensor:
        """Scores (B, S, g, g, P, K) of the codes of frames 1 to S, from T seen frames and S - T `imagined` ones."""
        text = self.text.encode(words)
        if imagined:
            added_BShw = self.axial.imagine(seen_BThw, text, imagined, speed_B)
            # Under autocast some versions of torch would reuse weights that were cast without a gradient.
            torch.clear_autocast_cache()
            seen_BThw = torch.cat([seen_BThw, added_BShw], dim=1)
        return self.axial(seen_BThw, text, speed_B)


def train(args: MageTraining) -> PredictionMetrics | None:
    """Run or continue stage 2; writes `out`/checkpoint, a whole model, whose metrics the main process returns.

    Raises:
        CheckpointError: if `vqvae` is no checkpoint of a VQ-VAE.
        CacheError: if `out` holds codes of another VQ-VAE or of other episodes.
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
    """
    accelerator = open_run(args.out, args.precision)
    torch.manual_seed(args.seed)
    vqvae = load_vqvae(args.vqvae)
    with open_data(args, vqvae.config.image_size, "vqvae.image_size") as (episodes, held_out):
        model = assemble(args, vqvae, episodes).to(accelerator.device)
        run, frames = Run(args, accelerator, MageStage(model)), model.config.axial.frames

        def measured(count: int | None) -> PredictionMetrics:
            return measure(model, held_out, range(len(held_out))[:count])

        share = (accelerator.process_index, accelerator.num_processes)
        cache = cached_codes(model.vqvae, episodes, args.out / "codes-train", *share)
        accelerator.wait_for_everyone()
        words = model.text.lookup(episodes.instructions)
        for step in run.steps("mage"):
            rng = step_rng(args.seed, step)
            imagined = schedule(args, step, frames, rng)
            stride = int(rng.integers(1, args.stride + 1))
            chosen_B = rng.integers(len(cache), size=args.batch)[run.rows]
            clips = cache.at(chosen_B, stride * np.arange(frames)).astype(np.int64)
            codes_BThw = torch.from_numpy(clips).to(run.device)
            weights_BThw = 1 + args.changed_weight * (codes_BThw[:, 1:] != codes_BThw[:, :1])
            whole = run.total(weights_BThw.sum())
            for part in run.micro_batches():
                codes, weights = codes_BThw[part], model.axial.patches(weights_BThw[part])
                seen, target = codes[:, : frames - 1 - imagined], model.axial.patches(codes[:, 1:])
                speed_B = torch.full((len(codes),), float(stride), device=run.device)
                sentences = words.select(torch.from_numpy(chosen_B[part]))
                with accelerator.autocast():
                    scores = run.module(seen, sentences, speed_B, imagined)
                run.backward(code_loss(scores, target, weights) / whole)
            run.update(step, {"imagined": float(imagined)})
            run.evaluate(step, measured)
        metrics = run.finish(model.save, measured, "imagined.json")
    close_run(accelerator)
    return metrics


def assemble(args: MageTraining, vqvae: VQVAE, episodes: Episodes) -> Mage:
    """A model of the trained VQ-VAE, frozen, and a transformer and a text encoder for the episodes' words to train."""
    for setting in args.set:
        if setting.startswith(("vqvae", "name", "architecture")):
            raise SettingsError(f"{setting!r}: the VQ-VAE comes trained; set text.* and axial.* only")
    with allowed_settings():
        config = with_settings(mage_preset(args.preset), args.set)
        text = config.text.for_captions(episodes.instructions, episodes.vocabulary)
        model = Mage(replace(config, vqvae=vqvae.config, text=text))
    model.vqvae.load_state_dict(vqvae.state_dict())
    model.vqvae.requires_grad_(False).eval()
    return model


def cached_codes(model: VQVAE, episodes: Episodes, folder: Path, process: int = 0, processes: int = 1) -> FrameCache:
    """The codes (h, w) uint16 of every frame, kept in `folder`; processes share the work as in `FrameCache.fill`.

    Raises:
        CacheError: if `folder` is damaged, or holds the codes of another VQ-VAE or of other episodes.
    """

    @torch.no_grad()
    def compute(chosen: range) -> NDArray[np.uint16]:
        found = []
        for first in range(0, len(chosen), 2):  # more at once take more memory
            frames_NHW3 = np.concatenate([episodes.frames(number) for number in chosen[first : first + 2]])
            found.append(model.encode(to_frames(frames_NHW3[None], model.device)[0]))
        return torch.cat(found).cpu().numpy().astype(np.uint16)

    network = weights_fingerprint(model, model.config.encoder_fingerprint)
    return FrameCache(folder, episodes, network).fill(compute, process, processes)


def schedule(args: MageTraining, step: int, frames: int, rng: np.random.Generator) -> int:
    """How many of the frames that update `step` learns from are imagined; grows to all but the first."""
    begin = round(args.steps * (1 - args.autoregressive))
    if step < begin:
        return 0
    grown = min(1.0, (step - begin + 1) / max(1.0, 0.8 * (args.steps - begin)))
    return int(rng.integers(0, max(1, round(grown * (frames - 2))) + 1))


@torch.no_grad()
def measure(model: Mage, episodes: Episodes, numbers: Sequence[int]) -> PredictionMetrics:
    """Metrics of some episodes; frames after an episode's end are its last."""
    ratios: dict[str, list[Tensor]] = {"psnr": [], "still_psnr": [], "redrawn_psnr": []}
    hits, changes = [], []
    times_T = np.arange(model.config.axial.frames)
    for first in range(0, len(numbers), 8):  # more at once take more memory
        part = numbers[first : first + 8]
        clips = [clip[np.minimum(times_T, len(clip) - 1)] for clip in map(episodes.frames, part)]
        frames_BT3HW = to_frames(np.stack(clips), model.device)
        B, T = frames_BT3HW.shape[:2]
        true_BThw = model.vqvae.encode(frames_BT3HW.flatten(0, 1)).unflatten(0, (B, T))
        with evaluating(model):
            text = model.text([episodes.instructions[number] for number in part])
            imagined_BShw = model.axial.imagine(true_BThw[:, :1], text, T - 1)
        still_BShw, right_BShw = true_BThw[:, :1].expand_as(imagined_BShw), true_BThw[:, 1:]
        for name, codes in zip(ratios, (imagined_BShw, still_BShw, right_BShw), strict=True):
            drawn = model.vqvae.decode(codes.flatten(0, 1)).unflatten(0, (B, T - 1))
            ratios[name].append(psnr((drawn.clamp(-1, 1) + 1) / 2, (frames_BT3HW[:, 1:] + 1) / 2))
        hits.append(imagined_BShw == right_BShw)
        changes.append(right_BShw != still_BShw)
    hits_NShw, changes_NShw = torch.cat(hits), torch.cat(changes)
    return PredictionMetrics(
        **{name: float(torch.cat(values).mean()) for name, values in ratios.items()},
        codes=float(hits_NShw.float().mean(dim=(1, 2, 3)).mean()),
        changed_codes=int((hits_NShw & changes_NShw).sum()) / max(1, int(changes_NShw.sum())),
    )
