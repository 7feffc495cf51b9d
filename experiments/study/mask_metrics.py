"""How well masks fit the simulator's segmentation, frame by frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from textocvp.metrics import foreground_ari, object_ious, overlaps

BACKGROUND, ARM = 0, 1  # their labels in a segmentation


@dataclass(frozen=True, eq=False)
class MaskScores:
    """How well the masks of T frames fit. All (T,), frame 0 is the observed one; nan where nothing of it is seen."""

    # mean over the blocks and bowls that are seen; slots are matched to them afresh in every frame
    # (Hungarian), as in the paper
    iou: np.ndarray
    moving: np.ndarray  # mean of the named block and the arm, the only things that move; matched as above, with the arm
    block: np.ndarray  # these two by themselves
    arm: np.ndarray
    still: np.ndarray  # as `iou`, without the named block
    # mean over blocks and bowls, each held against the one slot that was matched to it in frame 0: a model
    # that lets two slots swap their objects loses here and nowhere else
    kept: np.ndarray
    kept_moving: np.ndarray  # the same for the named block and the arm
    ari: np.ndarray  # adjusted Rand index over the foreground, arm included


def score_masks(labels_THW: np.ndarray, truth_THW: np.ndarray, moved: int) -> MaskScores:
    """Compare masks with the simulator's segmentation.

    Args:
        labels_THW: the slot that wins each pixel.
        truth_THW: 0 background, 1 arm, 2 + i object i.
        moved: value of the named block there.

    Raises:
        ValueError: if the two differ in size.
    """
    if labels_THW.shape != truth_THW.shape:
        raise ValueError(f"labels are {labels_THW.shape}, the segmentation {truth_THW.shape}")
    things = [int(label) for label in np.unique(truth_THW) if label != BACKGROUND]
    first = object_ious(labels_THW[0], truth_THW[0], things)
    held = dict(zip(first.ids.tolist(), first.slots.tolist(), strict=True))
    frames = []
    for labels, truth in zip(labels_THW, truth_THW, strict=True):
        objects = object_ious(labels, truth, [label for label in things if label != ARM])
        matched = object_ious(labels, truth, things)
        of = dict(zip(matched.ids.tolist(), matched.ious.tolist(), strict=True))
        block, arm = of.get(moved, np.nan), of.get(ARM, np.nan)
        kept = _held_ious(labels, truth, held)
        everything, still = _mean(objects.ious), _mean(objects.ious[objects.ids != moved])
        kept_objects = _mean([iou for i, iou in kept.items() if i != ARM])
        kept_moving = _mean([kept.get(moved, np.nan), kept.get(ARM, np.nan)])
        moving, ari = _mean([block, arm]), foreground_ari(labels, truth)
        frames.append((everything, moving, block, arm, still, kept_objects, kept_moving, ari))
    return MaskScores(*np.array(frames, dtype=np.float64).T)


def _held_ious(labels: np.ndarray, truth: np.ndarray, held: Mapping[int, int]) -> dict[int, float]:
    """Overlap of each thing that is seen with the slot it has been given; 0 if that slot shows nothing."""
    ious, slots, ids = overlaps(labels, truth, list(held))
    # Each slot has one row at most, and one that shows nothing has none.
    return {i: float(ious[slots == held[i], column].sum()) for column, i in enumerate(ids.tolist())}


def _mean(values: object) -> float:
    array = np.asarray(values, dtype=np.float64)
    array = array[~np.isnan(array)]
    return float(array.mean()) if len(array) else float("nan")


def mean_known(values: Any, axis: int = 0) -> np.ndarray:
    """Over an axis; nan where nothing is known."""
    return np.asarray(np.ma.masked_invalid(values).mean(axis).filled(np.nan))
