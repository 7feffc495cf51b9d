"""Masks against a segmentation: adjusted Rand index, overlap with objects, and whether slots keep their objects.

A segmentation gives each pixel the label of what is seen there. What the labels mean is up to the data. `masks` are
soft masks (K, H, W), or the labels (H, W) of the slots that win the pixels; functions raise a ValueError where they
differ in size from the segmentation (H, W).
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are first used
from torch import Tensor

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]

# Objects with fewer visible pixels are left out: the overlap of a sliver says more about edges than about slots.
MIN_PIXELS = 10
# Later frames of a video count for an object where this share of its first frame's pixels is visible.
MIN_VISIBLE = 0.5


def slot_labels(masks: Any) -> np.ndarray:
    """The slot that wins each pixel: soft masks (..., K, H, W) to labels (..., H, W). Whole numbers pass as labels."""
    array = masks.detach().cpu().numpy() if isinstance(masks, Tensor) else np.asarray(masks)
    return array.argmax(axis=-3) if np.issubdtype(array.dtype, np.floating) else array


def foreground_ari(masks: Any, segmentation: np.ndarray, *, background: int = 0) -> float:
    """Adjusted Rand index over the pixels that are not background (Hubert and Arabie 1985).

    It is 1 if slots and objects divide the foreground alike, about 0 by chance, and nan without a foreground.
    """
    labels, truth = _same_pixels(masks, segmentation)
    foreground = truth != background
    if foreground.sum() < 2:
        return float("nan")
    counts, _, _ = _contingency(labels[foreground], truth[foreground])

    def pairs(n: np.ndarray) -> float:
        return float((n * (n - 1) / 2).sum())

    together = pairs(counts)
    by_label, by_truth = pairs(counts.sum(axis=1)), pairs(counts.sum(axis=0))
    expected = by_label * by_truth / pairs(np.array([counts.sum()]))
    most = (by_label + by_truth) / 2
    return 1.0 if most == expected else (together - expected) / (most - expected)


@dataclass
class ObjectMatches:
    """One slot for each visible object, no slot twice, so that the sum of the overlaps is largest."""

    ids: np.ndarray  # (N,), the objects' labels in the segmentation
    slots: np.ndarray  # (N,), the matched slot; -1 if there are fewer slots than objects
    ious: np.ndarray  # (N,), intersection over union of the two; 0 if there is no slot


def overlaps(
    masks: Any, segmentation: np.ndarray, objects: Collection[int], *, min_pixels: int | None = None
) -> Arrays:
    """Intersection over union of every slot with every visible object.

    Args:
        objects: labels of the objects that count.
        min_pixels: those of fewer pixels are not visible; `MIN_PIXELS` by default.

    Returns:
        ious (S, N), the S slots that win a pixel, the labels of the N objects, both ascending.
    """
    counts, slots, ids = _contingency(*_same_pixels(masks, segmentation))
    unions = counts.sum(axis=1, keepdims=True) + counts.sum(axis=0, keepdims=True) - counts
    seen = np.isin(ids, list(objects)) & (counts.sum(axis=0) >= (min_pixels or MIN_PIXELS))
    return (counts / unions)[:, seen], slots, ids[seen]


def object_ious(
    masks: Any, segmentation: np.ndarray, objects: Collection[int], *, min_pixels: int | None = None
) -> ObjectMatches:
    """Match slots to the visible objects of one frame (Hungarian algorithm). Arguments as `overlaps`."""
    ious, slots, ids = overlaps(masks, segmentation, objects, min_pixels=min_pixels)
    rows, columns = scipy.optimize.linear_sum_assignment(-ious)
    matched = ObjectMatches(ids, np.full(len(ids), -1), np.zeros(len(ids)))
    matched.slots[columns] = slots[rows]
    matched.ious[columns] = ious[rows, columns]
    return matched


def followed(masks: Any, segmentation: np.ndarray, objects: Collection[int]) -> np.ndarray:
    """For every object of an episode's first frame: does the slot that has it there keep it to the end?

    It does if that slot has the largest intersection over union in every later frame that shows the object: at least
    `MIN_PIXELS`, and `MIN_VISIBLE` of those of the first frame. Masks and segmentation are of T frames.

    Returns:
        (N,) bool, one for each visible object of the first frame. Their mean over many episodes is the follow rate.
    """
    labels, truth = _same_pixels(masks, segmentation)
    first = object_ious(labels[0], truth[0], objects)
    area = np.array([(truth[0] == i).sum() for i in first.ids])
    kept = first.slots >= 0
    for t in range(1, len(labels)):
        ious, slots, ids = overlaps(labels[t], truth[t], objects)
        for n, i in enumerate(first.ids):
            if not kept[n] or (truth[t] == i).sum() < max(MIN_VISIBLE * area[n], MIN_PIXELS):
                continue
            column = ious[:, np.flatnonzero(ids == i)[0]]
            kept[n] = slots[column.argmax()] == first.slots[n]
    return kept


def _same_pixels(masks: Any, segmentation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    labels, truth = slot_labels(masks), np.asarray(segmentation)
    if labels.shape != truth.shape:
        raise ValueError(f"masks are {labels.shape}, the segmentation {truth.shape}")
    return labels, truth


def _contingency(labels: np.ndarray, truth: np.ndarray) -> Arrays:
    """Pixel counts (labels, truths) and the sorted values that the two axes stand for."""
    label_values, label_index = np.unique(labels, return_inverse=True)
    truth_values, truth_index = np.unique(truth, return_inverse=True)
    counts = np.zeros((len(label_values), len(truth_values)), dtype=np.int64)
    np.add.at(counts, (label_index.ravel(), truth_index.ravel()), 1)
    return counts, label_values, truth_values
