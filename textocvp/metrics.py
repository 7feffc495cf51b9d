"""How good masks and frames are, and how sure a figure is.

Masks are compared with the simulator's segmentation: 0 is the background, 1 the arm, 2 + i object i. Nothing
here is used to train anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.special import ndtri
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

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


# ---------------------------------------------------------------- frames against true frames


def psnr(imagined: Tensor, real: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of each frame in dB; infinite for equal frames.

    Args:
        imagined, real: (..., 3, H, W) in 0..1.

    Returns:
        (...).
    """
    _same_frames(imagined, real)
    error = (imagined.float() - real.float()).square().flatten(-3).mean(dim=-1)
    return -10 * torch.log10(error)


def ssim(imagined: Tensor, real: Tensor) -> Tensor:
    """Structural similarity of each frame, Gaussian window of 11 pixels and deviation 1.5, as the authors
    measure it.

    The picture is mirrored at its edges, so that pixels there count too.

    Args:
        imagined, real: (..., 3, H, W) in 0..1.

    Returns:
        (...), at most 1.
    """
    _same_frames(imagined, real)
    flat = [
        frames.float().flatten(0, -4) if frames.ndim > 3 else frames.float()[None]
        for frames in (imagined, real)
    ]
    value = structural_similarity_index_measure(
        flat[0], flat[1], gaussian_kernel=True, sigma=1.5, kernel_size=11, reduction="none", data_range=1.0
    )
    assert isinstance(value, Tensor)
    return value.reshape(imagined.shape[:-3])


def _same_frames(imagined: Tensor, real: Tensor) -> None:
    if imagined.shape != real.shape or imagined.shape[-3] != 3:
        raise ValueError(
            f"need frames (..., 3, H, W) of one shape, got {tuple(imagined.shape)} and {tuple(real.shape)}"
        )


# ---------------------------------------------------------------- how sure a figure is


@dataclass(frozen=True)
class Interval:
    """A figure and its 95 % interval.

    Attributes:
        value: the figure. low, high: the interval. n: how many independent things it comes from.
    """

    value: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """A success rate and its Wilson score interval, which stays inside 0..1 also for few trials and for 0 or
    all.

    Raises:
        ValueError: unless 0 <= successes <= trials and trials >= 1.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"need 0 <= successes <= trials and at least one trial, got {successes} of {trials}")
    z = float(ndtri(0.5 + confidence / 2))
    rate = successes / trials
    center = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * (rate * (1 - rate) / trials + z**2 / (4 * trials**2)) ** 0.5
    # Exactly 0 and 1 at the ends, where rounding would leave the figure outside its own interval.
    low = 0.0 if successes == 0 else center - half
    high = 1.0 if successes == trials else center + half
    return Interval(rate, low, high, trials)


def ratio_interval(above: Interval, below: Interval) -> Interval:
    """The ratio of two independent figures that are not negative, with an interval made from theirs.

    MOVER (Donner and Zou, "Closed-form confidence intervals for functions of the normal mean and standard deviation",
    2012): unlike a bootstrap it is not empty for two rates of 1. `high` is inf where `below` may be 0.

    Raises:
        ValueError: if the figure `below` is 0.
    """
    p, q = above.value, below.value
    if q <= 0:
        raise ValueError("the ratio to 0 is not defined")

    def bound(one: float, other: float, sign: int) -> float:
        scale = other * (2 * q - other)
        inner = max(0.0, (p * q) ** 2 - one * other * (2 * p - one) * (2 * q - other))
        return (p * q + sign * inner**0.5) / scale if scale > 0 else float("inf")

    low, high = bound(above.low, below.high, -1), bound(above.high, below.low, 1)
    return Interval(p / q, 0.0 if low == float("inf") else max(0.0, low), high, min(above.n, below.n))


def bootstrap_interval(
    values: Any, *, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> Interval:
    """A mean and its percentile bootstrap interval.

    Args:
        values: (N,) one value for each independent thing (a sequence, an episode: not its frames, which are
            alike). nan values are left out.
        confidence: of the interval.
        resamples: how many times the values are drawn again.
        seed: of the drawing.

    Raises:
        ValueError: if no value is left.
    """
    array = np.asarray(values, dtype=np.float64).ravel()
    array = array[~np.isnan(array)]
    if len(array) == 0:
        raise ValueError("no values to take a mean of")
    rng = np.random.default_rng(seed)
    means = array[rng.integers(len(array), size=(resamples, len(array)))].mean(axis=1)
    low, high = np.quantile(means, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return Interval(float(array.mean()), float(low), float(high), len(array))


def relative_change(
    values: Any, reference: Any, *, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> Interval:
    """How much larger the mean of one set of scenes is than that of another: mean / reference mean - 1.

    The two sets are other scenes, so each is drawn again on its own for the percentile bootstrap interval. A resample
    whose reference mean is 0 is left out.

    Args:
        values, reference: (N,) and (M,), one value for each independent thing; nan values are left out.
        confidence, resamples, seed: of the interval.

    Returns:
        the change, 0.1 for 10 % more; its n is that of the smaller set.

    Raises:
        ValueError: if a set is empty or the mean of `reference` is 0.
    """
    sets = [np.asarray(a, dtype=np.float64).ravel() for a in (values, reference)]
    new, old = (a[~np.isnan(a)] for a in sets)
    if len(new) == 0 or len(old) == 0:
        raise ValueError("no values to take a mean of")
    if old.mean() == 0:
        raise ValueError("a change relative to a mean of 0 is not defined")
    rng = np.random.default_rng(seed)
    new_S, old_S = (a[rng.integers(len(a), size=(resamples, len(a)))].mean(axis=1) for a in (new, old))
    changes = new_S[old_S != 0] / old_S[old_S != 0] - 1
    low, high = np.quantile(changes, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return Interval(float(new.mean() / old.mean() - 1), float(low), float(high), min(len(new), len(old)))
