"""Stage 1: train the parser and the renderer to redraw short clips.

    textocvp train parser --data data/tabletop-train.h5 --val data/tabletop-val.h5 --out runs/parser

No label is used: the loss compares the drawn frame with the frame, the drawn masks with the parser's own attention,
and the places that the transition expected with those that the corrector found.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
import torch.nn.functional as F
from accelerate import Accelerator
from torch import Tensor, nn
from tqdm import tqdm

from textocvp.config import with_settings
from textocvp.data.episodes import EpisodeFile
from textocvp.data.feature_cache import FeatureCache, encode_share
from textocvp.data.prefetch import prefetch
from textocvp.drawing import color_masks
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.presets import preset
from textocvp.slots import SlotState
from textocvp.training.evaluate_parser import ParserMetrics, measure_parser
from textocvp.training.losses import (
    ParserLoss,
    image_loss,
    mask_loss,
    place_loss,
    read_place_loss,
    thing_weights,
)
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
class ParserTraining(TrainingSettings):
    """Train the scene parser and the renderer (stage 1)."""

    preset: str = "tabletop-small"
    """Architecture; `textocvp models` lists the presets."""
    episodes: int | None = 2000
    steps: int = 2000
    batch: int = 16
    """Clips an update, shared out among the processes."""
    learning_rate: float = 4e-4
    warmup: int = 300
    workers: int = 0
    """Processes (beside each training process) that read clips ahead."""
    clip: int = 3
    """Frames a clip."""
    stride: int = 2
    """Episode frames between two frames of a clip, drawn from 1 to this."""
    thing_weight: float = 4.0
    """How much more a pixel that is not canvas counts."""
    mask_weight: float = 0.1
    """Weight of the agreement between drawn masks and attention."""
    place_weight: float = 0.1
    """Weight of the transition's error in place, or of the error of the places that the renderer reads."""
    feature_weight: float = 1.0
    """Weight of the error of reconstructed features (renderer `features` only)."""
    cache_features: bool = False
    """Encode all training episodes once and read their features from disk (parser with a frozen encoder only)."""


@dataclass
class Clips:
    """What one update learns from.

    Attributes:
        frames_BTHW3: uint8.
        seeds_B: one for each clip, for parsers that draw their first slots.
        features_BTLF: of the frozen encoder, float16, where they are cached.
    """

    frames_BTHW3: Tensor
    seeds_B: Tensor
    features_BTLF: Tensor | None = None


@dataclass(frozen=True)
class ClipReader:
    """Reads the clips of a step, in whichever process.

    Attributes:
        episodes: the training episodes.
        args: the stage's settings.
        rows: of the step's batch, those to read.
        features: of the same episodes, if they are cached.
    """

    episodes: EpisodeFile
    args: ParserTraining
    rows: slice
    features: FeatureCache | None = None

    def __call__(self, step: int) -> Clips:
        args, rng = self.args, step_rng(self.args.seed, step)
        stride = int(rng.integers(1, args.stride + 1))
        length = (args.clip - 1) * stride + 1
        starts = self.episodes.random_starts(rng, args.batch, length)[self.rows]
        frames = self.episodes.clips(starts, length)
        seeds_B = rng.integers(2**63, size=args.batch)[self.rows]
        clips = Clips(torch.from_numpy(frames[:, ::stride].copy()), torch.from_numpy(seeds_B))
        if self.features is not None:
            clips.features_BTLF = torch.from_numpy(self.features.clips(starts, length, stride))
        return clips


class ParserStage(nn.Module):
    """What stage 1 trains, as one module, so that several processes can share its gradients."""

    def __init__(self, model: TextOCVP) -> None:
        super().__init__()
        self.parser, self.renderer = model.parser, model.renderer

    def forward(self, frames_BT3HW: Tensor, weights_N1HW: Tensor, **portion: Any) -> ParserLoss:
        """See `parser_loss`."""
        return parser_loss(self, frames_BT3HW, weights_N1HW, **portion)


def parser_loss(
    model: TextOCVP | ParserStage,
    frames_BT3HW: Tensor,
    weights_N1HW: Tensor,
    *,
    whole: Tensor | None = None,
    share: float = 1.0,
    generator: Sequence[torch.Generator] | None = None,
    features_BTLF: Tensor | None = None,
) -> ParserLoss:
    """The terms of stage 1 for clips in -1..1, or what a part of a batch adds to those of the batch.

    Args:
        weights_N1HW: how much each pixel of the N = B * T frames counts, see `thing_weights`.
        whole: the sum of those weights over the whole batch; None for clips that are a whole batch.
        share: how much of the batch these clips are.
        generator: for parsers that draw their first slots, one for each clip.
        features_BTLF: of the parser's frozen encoder, where they are known already.
    """
    known = {} if features_BTLF is None else {"features_BTLF": features_BTLF}
    parsed = model.parser(frames_BT3HW, generator=generator, **known)
    target = frames_BT3HW.flatten(0, 1)
    slots_NKD, attention_NKHW = parsed.slots_BTKD.flatten(0, 1), parsed.attention_BTKHW.flatten(0, 1)
    rendered = model.renderer(slots_NKD)
    mask = place = feature = target.new_zeros(())
    places = model.renderer.places(slots_NKD)
    if places is not None:
        place = read_place_loss(*places, attention_NKHW)
    if parsed.expected_BTKD is not None:
        layout = model.parser.layout
        mask = mask_loss(rendered, attention_NKHW, weights_N1HW, whole)
        found = SlotState.split(parsed.slots_BTKD[:, 1:], layout)
        place = place_loss(SlotState.split(parsed.expected_BTKD, layout), found)
    if rendered.features_BLF is not None and parsed.features_BTLF is not None:
        feature = F.mse_loss(rendered.features_BLF, parsed.features_BTLF.flatten(0, 1))
    image = image_loss(rendered, target, weights_N1HW, whole)
    return ParserLoss(image, mask, share * place, share * feature)


def train(args: ParserTraining) -> ParserMetrics | None:
    """Run or continue stage 1; writes `out`/checkpoint and returns the final quality on the held-out episodes.

    The quality is None on all processes but the main one.

    Raises:
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
        DinoWeightsError: if the weights of the parser's frozen encoder are missing.
        FeatureCacheError: if `out` holds features of another encoder or of other episodes.
    """
    accelerator = start(
        args.out, args.precision, some_unused=args.clip == 1
    )  # the transition, on single frames
    torch.manual_seed(args.seed)
    with allowed_settings():
        config = replace(with_settings(preset(args.preset), args.set), stage="parser")
        model = TextOCVP(config).to(accelerator.device)
    run, quality = Run(args, accelerator, ParserStage(model)), None
    with EpisodeFile(args.data, first=args.episodes) as episodes, EpisodeFile(args.val) as held_out:
        check_frame_size(model.config.parser.image_size, "parser.image_size", episodes, held_out)
        longest, wanted = int(episodes.lengths.max()), (args.clip - 1) * args.stride + 1
        if wanted > longest:
            raise SettingsError(
                f"clip={args.clip} and stride={args.stride} need episodes of {wanted} frames, the longest of "
                f"{args.data} has {longest}"
            )
        features = None
        if args.cache_features:
            features = _all_features(model, episodes, args.out / "features-train", accelerator)
        left = range(run.first, args.steps)
        batches = prefetch(ClipReader(episodes, args, run.rows, features), left, args.workers)
        for step, clips in zip(run.steps("parser"), batches, strict=True):
            frames_BT3HW = to_frames(clips.frames_BTHW3, run.device)
            features_BTLF = clips.features_BTLF
            if features_BTLF is not None:
                features_BTLF = features_BTLF.to(run.device).float()
            weights_BT1HW = thing_weights(frames_BT3HW, args.thing_weight)
            whole = run.total(weights_BT1HW.sum())
            for part in run.parts():
                generators = [torch.Generator().manual_seed(int(seed)) for seed in clips.seeds_B[part]]
                loss: ParserLoss = run.module(
                    frames_BT3HW[part],
                    weights_BT1HW[part].flatten(0, 1),
                    whole=whole,
                    share=run.share(part),
                    generator=generators,
                    features_BTLF=None if features_BTLF is None else features_BTLF[part],
                )
                total = loss.total(args.mask_weight, args.place_weight, args.feature_weight)
                run.backward(total, loss.figures())
            run.update(step)

            if run.is_main and (step + 1) % args.evaluate_every == 0:
                quality = measure_parser(model, held_out, range(min(args.evaluate_episodes, len(held_out))))
                run.log(step, quality.figures())
                tqdm.write(f"step {step + 1}: {quality}")
                draw_samples(model, held_out, range(4), args.out / "samples" / f"{step + 1:06d}.png")
        if run.is_main:
            model.save_pretrained(args.out / "checkpoint")
            quality = measure_parser(model, held_out, range(len(held_out)))
            print(f"final: {quality}")
            for sentence in quality.missed_gates():
                print(f"not good enough to train a predictor on: {sentence}")
            (args.out / "quality.json").write_text(quality.to_json())
    finish(accelerator)
    return quality


def _all_features(
    model: TextOCVP, episodes: EpisodeFile, folder: Path, accelerator: Accelerator
) -> FeatureCache:
    dino = model.parser.dino
    if dino is None:
        raise SettingsError("cache_features needs a parser with a frozen encoder: parser.encoder=dinov2")
    share = (accelerator.process_index, accelerator.num_processes)
    encode_share(dino, episodes, folder, *share, device=accelerator.device)
    accelerator.wait_for_everyone()
    return FeatureCache(dino, episodes, folder)


@torch.no_grad()
def draw_samples(
    model: TextOCVP, episodes: EpisodeFile, chosen: Iterable[int], path: Path, columns: int = 8
) -> None:
    """A picture with three rows an episode: frames, frames redrawn from their slots, and the slots' masks.

    One slot has no mask worth a row.
    """
    rows = []
    for index in chosen:
        episode = episodes.episode(index)
        times = np.linspace(0, len(episode.frames) - 1, columns).round().astype(int)
        seeded = torch.Generator(model.device).manual_seed(index)
        frames = to_frames(episode.frames[None], model.device)
        slots = model.parser(frames, generator=seeded).slots_BTKD[0, times]
        rendered = model.renderer(slots)
        drawn_BHW3 = ((rendered.frames_B3HW.clamp(-1, 1) + 1) * 127.5).permute(0, 2, 3, 1)
        drawn = drawn_BHW3.cpu().numpy().astype(np.uint8)
        strips = [episode.frames[times], drawn]
        if slots.shape[1] > 1:
            strips.append(color_masks(rendered.masks_BKHW.cpu().numpy()))
        for strip in strips:
            rows.append(np.concatenate(list(strip), axis=1))
    picture = np.concatenate(rows).repeat(2, 0).repeat(2, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, picture)
