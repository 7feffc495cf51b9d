"""Clips of frames, for the stages that learn to redraw them: stage 1 and the VQ-VAE of MAGE."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from textocvp.data.cache import FrameCache, cached_features
from textocvp.data.episodes import Episodes
from textocvp.data.prefetch import prefetch
from textocvp.files import replacing
from textocvp.parsers.base import to_frames
from textocvp.parsers.frozen import FrozenEncoder
from textocvp.training.light import relight
from textocvp.training.run import Run, SettingsError, TrainingSettings, step_rng
from textocvp.training.teacher import Teacher


@dataclass(kw_only=True)
class ClipTraining(TrainingSettings):
    """Settings of a stage that learns from clips."""

    batch: int = 16
    """Clips an update, shared out among the processes."""
    workers: int = 0
    """Processes (beside each training process) that read clips ahead."""
    clip: int = 3
    """Frames a clip."""
    stride: int = 2
    """Episode frames between two frames of a clip, drawn from 1 to this."""
    thing_weight: float = 4.0
    """How much more a pixel that is not canvas counts."""
    cache_features: bool = False
    """Encode all training episodes once and read their features from disk (frozen image encoders only)."""


@dataclass
class Clips:
    """What one update learns from."""

    frames_BTHW3: Tensor  # uint8
    seeds_B: Tensor  # one for each clip, for parsers that draw their first slots
    features_BTLF: Tensor | None = None  # of the frozen encoder, float16, where they are cached
    lit_BTHW3: Tensor | None = None  # the same frames under other light, uint8
    labels_BTHW: Tensor | None = None  # what these show, for parsers that are taught

    def on(self, device: torch.device) -> tuple[Tensor, Tensor | None]:
        """Frames (B, T, 3, H, W) in -1..1 and features (B, T, L, F), both float32."""
        features = self.features_BTLF
        return to_frames(self.frames_BTHW3, device), None if features is None else features.to(device).float()

    def lesson(self, device: torch.device) -> tuple[Tensor, Tensor] | None:
        """Frames (B, T, 3, H, W) in -1..1 under other light and their labels (B, T, H, W), where there are any."""
        if self.lit_BTHW3 is None or self.labels_BTHW is None:
            return None
        return to_frames(self.lit_BTHW3, device), self.labels_BTHW.to(device)


@dataclass(frozen=True)
class ClipReader:
    """Reads these rows of the batch of a step, in whichever process."""

    episodes: Episodes
    args: ClipTraining
    rows: slice
    features: FrameCache | None = None
    teacher: Teacher | None = None

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
        if self.teacher is not None:
            labels = self.teacher.labels(starts, frames[:, ::stride], stride)
            seeds = rng.integers(2**63, size=args.batch)[self.rows]
            lit, seen = zip(*map(relight, frames[:, ::stride], labels, map(np.random.default_rng, seeds)), strict=True)
            clips.lit_BTHW3, clips.labels_BTHW = (torch.from_numpy(np.stack(part)) for part in (lit, seen))
        return clips

    def steps(self, run: Run, name: str) -> Iterator[tuple[int, Clips]]:
        """The steps that are left of a run, each with its clips."""
        batches = prefetch(self, range(run.first, self.args.steps), self.args.workers)
        return zip(run.steps(name), batches, strict=True)


def clip_reader(
    run: Run, args: ClipTraining, episodes: Episodes, encoder: FrozenEncoder | None, teacher: Teacher | None = None
) -> ClipReader:
    """A reader of this process's clips; with `args.cache_features` the features of all episodes are computed first.

    Raises:
        WeightsError: if the encoder's weights are missing.
        CacheError: if `args.out` holds features of another encoder or of other episodes.
    """
    features = None
    if args.cache_features:
        assert encoder is not None  # `check_clips` saw to it
        share = (run.accelerator.process_index, run.accelerator.num_processes)
        features = cached_features(encoder, episodes, args.out / "features-train", *share, device=run.device)
        run.accelerator.wait_for_everyone()
    return ClipReader(episodes, args, run.rows, features, teacher)


def check_clips(args: ClipTraining, episodes: Episodes, encoder: FrozenEncoder | None) -> None:
    """What a `clip_reader` needs, before a run begins.

    Raises:
        SettingsError: if no episode is long enough for a clip, or there is no frozen encoder to cache features of.
    """
    longest, wanted = int(episodes.lengths.max()), (args.clip - 1) * args.stride + 1
    if wanted > longest:
        raise SettingsError(
            f"clip={args.clip} and stride={args.stride} need episodes of {wanted} frames, the longest of "
            f"{args.data} has {longest}"
        )
    if args.cache_features and encoder is None:
        raise SettingsError(
            "cache_features needs a frozen image encoder: set parser.encoder (or vqvae.encoder) to dinov2"
        )


def save_samples(
    path: Path,
    episodes: Episodes,
    redraw: Callable[[int, Tensor, NDArray[np.int64]], Iterable[NDArray[np.uint8]]],
    device: torch.device | str,
) -> None:
    """A picture of the first four episodes: a row of eight frames each, and below it what `redraw` makes of them.

    Args:
        redraw: from an episode's number, its frames (T, 3, H, W) in -1..1, and the times that are shown, pictures
            (8, H, W, 3) for each further row.
    """
    rows = []
    for index in range(min(4, len(episodes))):
        frames = episodes.frames(index)
        times = np.linspace(0, len(frames) - 1, 8).round().astype(int)
        for strip in (frames[times], *redraw(index, to_frames(frames[None], device)[0], times)):
            rows.append(np.concatenate(list(strip), axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as new:
        iio.imwrite(new, np.concatenate(rows).repeat(2, 0).repeat(2, 1))


def to_pictures(frames_N3HW: Tensor) -> NDArray[np.uint8]:
    """Frames in -1..1 as pictures (N, H, W, 3), 0..255."""
    pictures_N3HW = ((frames_N3HW.clamp(-1, 1) + 1) * 127.5).round()
    return pictures_N3HW.permute(0, 2, 3, 1).cpu().numpy().astype(np.uint8)
