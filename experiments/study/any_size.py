"""Episodes of any size: what models of another size imagine, how it fits the truth, and films of both."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from experiments.report.gif import gif, paint, segmentation_colors, slot_colors
from experiments.report.page import Clip
from experiments.report.tables import Column
from experiments.study.frame_metrics import METRICS, Scorer
from experiments.study.pool import Worker
from experiments.study.predictions import Prediction, hold_last, reach, to_uint8
from textocvp.data.episodes import Episode
from textocvp.metrics import foreground_ari, object_ious
from textocvp.rollout import Rollout

# Frames that are decoded at once: masks of a whole episode at 336x336 take a quarter of a gigabyte.
AT_ONCE = 8
TITLES = {**METRICS, "iou": "mask IoU", "ari": "FG-ARI"}


class Seen(NamedTuple):
    """What a method shows of a sentence."""

    frames: Tensor  # (T, 3, H, W) in 0..1
    labels: np.ndarray  # (T, H, W), the slots that win the pixels


def fitted(frames: np.ndarray, model: Any) -> np.ndarray:
    """Frames (..., H, W, 3) as a model takes them: as they are, or reduced to its size by area.

    Models with slots also take whole multiples of their size.
    """
    side, own = frames.shape[-2], model.image_size[0]
    if side == own or (hasattr(model, "rollout") and side % own == 0):
        return frames
    flat = map(Image.fromarray, frames.reshape(-1, *frames.shape[-3:]))
    small = [np.asarray(one.resize((own, own), Image.Resampling.BOX)) for one in flat]
    return np.stack(small).reshape(*frames.shape[:-3], own, own, 3)


def enlarged(pictures_NCHW: Tensor, side: int) -> Tensor:
    """Pictures at side x side, where they are smaller."""
    if pictures_NCHW.shape[-1] == side:
        return pictures_NCHW
    return F.interpolate(pictures_NCHW, (side, side), mode="bilinear", align_corners=False)


def drawn(rollout: Rollout, side: int) -> Seen:
    """All frames of a rollout (B = 1), a few at a time."""
    times, frames, labels = range(rollout.slots.shape[1]), [], []
    for at in times[::AT_ONCE]:
        some = times[at : at + AT_ONCE]
        part = rollout.select(0)  # a fresh one, which forgets what it has drawn
        frames.append(enlarged(part.decode_frames(some)[0].cpu(), side))
        labels.append(enlarged(part.decode_masks(some)[0].cpu(), side).argmax(1).to(torch.uint8))
    return Seen(torch.cat(frames), torch.cat(labels).numpy())


def imagine(worker: Worker, model: Any, first_HW3: np.ndarray, text: str, horizon: int, seed: int) -> Seen:
    """What a model imagines, as far as it can; masks of a model without slots are those of our parser."""
    side, first, ahead = len(first_HW3), fitted(first_HW3, model), reach(model, horizon)
    if hasattr(model, "rollout"):
        return drawn(model.rollout(first, [text], horizon=ahead, seed=seed), side)
    frames = enlarged(model.imagine(first, [text], horizon=ahead, seed=seed)[0].float().cpu(), side)
    ours = worker.world_model
    return Seen(frames, drawn(ours.parse(fitted(to_uint8(frames), ours), seed=seed), side).labels)


def mask_curves(labels_THW: np.ndarray, truth: Episode) -> dict[str, np.ndarray]:
    """Mean overlap with every object that is seen, and foreground ARI, of each frame after the first."""
    if truth.segmentation is None or not truth.objects:
        return {}
    ids = [o.label for o in truth.objects]
    pairs = list(zip(labels_THW[1:], truth.segmentation[1:], strict=True))
    overlaps = [object_ious(labels, masks, ids, min_pixels=1).ious for labels, masks in pairs]
    iou = [its.mean() if len(its) else np.nan for its in overlaps]
    return {"iou": np.array(iou), "ari": np.array([foreground_ari(*pair) for pair in pairs])}


def compare(
    scorer: Scorer, method: str, seen: Seen, truth: Episode, lengths: Mapping[str, int]
) -> dict[tuple[str, str, str], float]:
    """Means over the first so many frames after the observed one; what is shown is held where it ends too early."""
    T = len(truth.frames)
    frames = scorer.score(Prediction(method, hold_last(seen.frames, T))).curves
    curves = {**frames, **mask_curves(hold_last(seen.labels, T), truth)}
    return {
        (method, length, metric): float(np.nanmean(curve[:n]))
        for (length, n), (metric, curve) in product(lengths.items(), curves.items())
        if 0 < n < T and np.isfinite(curve[:n]).any()
    }


def length_columns(split: str, lengths: Iterable[str], metrics: Iterable[str]) -> list[Column]:
    """A column for each metric at each length, such as `9 frames`."""
    return [
        Column(f"{TITLES[m]} {length.removesuffix(' frames')}", split, length, m, 2 if m == "psnr" else 3)
        for length, m in product(lengths, metrics)
    ]


@dataclass(frozen=True)
class Film:
    """A unit of work: what happened beside what ours imagines, above the masks."""

    study: str  # its name
    watch: Callable[[Worker], Episode]  # what happened
    seed: int
    caption: str
    details: Callable[[Episode, Seen], str] | None = None  # what the caption ends in
    best: bool = True
    rank: int = 1

    def run(self, worker: Worker) -> Clip:
        """Imagine it once more."""
        truth, place = self.watch(worker), f"{'best' if self.best else 'worst'} {self.rank}"
        seen = imagine(worker, worker.world_model, truth.frames[0], truth.instruction, len(truth.frames) - 1, self.seed)
        return Clip(
            name=f"{self.study}-{place.replace(' ', '-')}.gif",
            gif=film(truth, seen),
            panels=("real", "ours"),
            title=truth.instruction,
            caption=self.caption + (self.details(truth, seen) if self.details else ""),
            badge=place,
        )


def film(truth: Episode, seen: Seen) -> bytes:
    """A GIF: what happened beside what is imagined, above the masks where they are known."""
    rows = [[truth.frames, to_uint8(seen.frames)]]
    if truth.segmentation is not None:
        n, slots = len(truth.objects), int(seen.labels.max()) + 1
        colors = slot_colors(seen.labels[0], truth.segmentation[0], slots, n)
        rows.append([paint(truth.segmentation, segmentation_colors(n)), paint(seen.labels, colors)])
    step = max(1, truth.frames.shape[1] // 168)  # a page of films at 336x336 is too large to be sent
    return gif([[its[:, ::step, ::step] for its in row] for row in rows], scale=1)
