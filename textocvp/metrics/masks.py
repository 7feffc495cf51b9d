"""How good masks and frames are, and how sure a figure is.

Masks are compared with the simulator's segmentation: 0 is the background, 1 the arm, 2 + i object i. Nothing
here is used to train anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from torch import Tensor

FIRST_OBJECT = 2
#: Objects of which fewer pixels are seen are left out: the overlap of a sliver says more about edges than
#: about slots.
MIN_PIXELS = 10


# ---------------------------------------------------------------- masks against the simulator's segmentation


def slot_labels(masks: Any) -> np.ndarray:
    """The slot that wins each pixel: (..., K, H, W) masks to (..., H, W) whole numbers; labels pass
    unchanged.

    A floating-point array (or tensor) is masks, a whole-number one is labels.
    """
    array = masks.detach().cpu().numpy() if isinstance(masks, Tensor) else np.asarray(masks)
    if np.issubdtype(array.dtype, np.floating):
        return array.argmax(axis=-3)
    return array


def contingency(labels: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel counts (labels, truths) and the sorted values that the two axes stand for."""
    label_values, label_index = np.unique(labels, return_inverse=True)
    truth_values, truth_index = np.unique(truth, return_inverse=True)
    counts = np.zeros((len(label_values), len(truth_values)), dtype=np.int64)
    np.add.at(counts, (label_index.ravel(), truth_index.ravel()), 1)
    return counts, label_values, truth_values


def foreground_ari(masks: Any, segmentation: np.ndarray) -> float:
    """Adjusted Rand index over the pixels that the simulator does not call background (Hubert and Arabie
    1985).

    Args:
        masks: (K, H, W) masks or (H, W) labels.
        segmentation: (H, W).

    Returns:
        1 if slots and things divide the foreground alike, about 0 by chance; nan where there is no
        foreground.
    """
    labels, truth = slot_labels(masks), np.asarray(segmentation)
    if labels.shape != truth.shape:
        raise ValueError(f"masks are {labels.shape} pixels, the segmentation {truth.shape}")
    foreground = truth != 0
    if foreground.sum() < 2:
        return float("nan")
    counts, _, _ = contingency(labels[foreground], truth[foreground])

    def pairs(n: np.ndarray) -> float:
        return float((n * (n - 1) / 2).sum())

    together = pairs(counts)
    by_label, by_truth = pairs(counts.sum(axis=1)), pairs(counts.sum(axis=0))
    expected = by_label * by_truth / pairs(np.array([counts.sum()]))
    most = (by_label + by_truth) / 2
    return 1.0 if most == expected else (together - expected) / (most - expected)


@dataclass
class ObjectMatches:
    """One slot for each object that is seen, no slot twice, so that the sum of the overlaps is largest.

    Attributes:
        ids: (N,) the objects' segmentation values.
        slots: (N,) the matched slot; -1 if there are fewer slots than objects.
        ious: (N,) intersection over union of the two; 0 if there is no slot.
    """

    ids: np.ndarray
    slots: np.ndarray
    ious: np.ndarray


def overlaps(masks: Any, segmentation: np.ndarray, *, min_pixels: int = MIN_PIXELS) -> tuple[np.ndarray, ...]:
    """Intersection over union of every slot with every object that is seen.

    Args:
        masks: (K, H, W) masks or (H, W) labels.
        segmentation: (H, W).
        min_pixels: objects with fewer visible pixels are left out.

    Returns:
        ious (slots, N), the slots' numbers (slots,), the objects' segmentation values (N,).
    """
    labels, truth = slot_labels(masks), np.asarray(segmentation)
    if labels.shape != truth.shape:
        raise ValueError(f"masks are {labels.shape} pixels, the segmentation {truth.shape}")
    counts, slots, ids = contingency(labels, truth)
    unions = counts.sum(axis=1, keepdims=True) + counts.sum(axis=0, keepdims=True) - counts
    seen = (ids >= FIRST_OBJECT) & (counts.sum(axis=0) >= min_pixels)
    return (counts / unions)[:, seen], slots, ids[seen]


def object_ious(masks: Any, segmentation: np.ndarray, *, min_pixels: int = MIN_PIXELS) -> ObjectMatches:
    """Match slots to the objects that are seen in one frame (Hungarian algorithm). Arguments as
    `overlaps`."""
    ious, slots, ids = overlaps(masks, segmentation, min_pixels=min_pixels)
    rows, columns = linear_sum_assignment(-ious)
    matched = ObjectMatches(ids, np.full(len(ids), -1), np.zeros(len(ids)))
    matched.slots[columns] = slots[rows]
    matched.ious[columns] = ious[rows, columns]
    return matched


def followed(masks: Any, segmentation: np.ndarray, *, visible: float = 0.5) -> np.ndarray:
    """For every object of an episode's first frame: does the slot that has it there keep it to the end?

    It does if that slot is the one that overlaps the object best (largest intersection over union, more than
    0) in every later frame where the object is visible enough.

    Args:
        masks: (T, K, H, W) masks or (T, H, W) labels.
        segmentation: (T, H, W).
        visible: share of its pixels in the first frame that must be visible for a later frame to count (and
            at least `MIN_PIXELS`).

    Returns:
        (N,) bool, one for each object seen in the first frame. Their mean over many episodes is the follow
        rate.
    """
    labels, truth = slot_labels(masks), np.asarray(segmentation)
    if labels.shape != truth.shape:
        raise ValueError(f"masks are {labels.shape} frames and pixels, the segmentation {truth.shape}")
    first = object_ious(labels[0], truth[0])
    area = np.array([(truth[0] == i).sum() for i in first.ids])
    kept = first.slots >= 0
    for t in range(1, len(labels)):
        ious, slots, ids = overlaps(labels[t], truth[t])
        for n, i in enumerate(first.ids):
            if not kept[n] or (truth[t] == i).sum() < max(visible * area[n], MIN_PIXELS):
                continue
            column = ious[:, np.flatnonzero(ids == i)[0]]
            kept[n] = slots[column.argmax()] == first.slots[n]
    return kept
