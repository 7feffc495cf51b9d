"""A value and its 95 % interval: rates, means, ratios and relative changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri


@dataclass(frozen=True)
class Interval:
    """A value and its 95 % interval.

    Attributes:
        value: the estimate.
        low: lower end of the interval.
        high: upper end.
        n: how many independent samples it comes from.
    """

    value: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """A success rate and its Wilson score interval, which stays inside 0..1 also for few trials and for 0 or all.

    Raises:
        ValueError: unless 0 <= successes <= trials and trials >= 1.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"need 0 <= successes <= trials and at least one trial, got {successes} of {trials}")
    z = float(ndtri(0.5 + confidence / 2))
    rate = successes / trials
    center = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * (rate * (1 - rate) / trials + z**2 / (4 * trials**2)) ** 0.5
    # Exactly 0 and 1 at the ends: rounding would leave the value outside its own interval.
    low = 0.0 if successes == 0 else center - half
    high = 1.0 if successes == trials else center + half
    return Interval(rate, low, high, trials)


def ratio_interval(above: Interval, below: Interval) -> Interval:
    """The ratio of two independent values that are not negative, with an interval made from theirs.

    MOVER (Donner and Zou, "Closed-form confidence intervals for functions of the normal mean and standard deviation",
    2012): unlike a bootstrap it is not empty for two rates of 1. `high` is inf where `below` may be 0.

    Raises:
        ValueError: if the value of `below` is 0.
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
        values: (N,) one value for each independent sample: a sequence or an episode, not its frames, which are
            alike. nan values are left out.
        confidence: of the interval.
        resamples: how many times the values are drawn again.
        seed: of the drawing.

    Raises:
        ValueError: if no value is left.
    """
    array = _without_nan(values)
    means = _resampled_means(array, resamples, np.random.default_rng(seed))
    low, high = np.quantile(means, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return Interval(float(array.mean()), float(low), float(high), len(array))


def relative_change(
    values: Any, reference: Any, *, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> Interval:
    """How much larger the mean of one set of scenes is than that of another: mean / reference mean - 1.

    The two sets are of different scenes, so each is drawn again on its own for the percentile bootstrap interval. A
    resample whose reference mean is 0 is left out.

    Args:
        values, reference: (N,) and (M,), one value for each independent sample; nan values are left out.
        confidence, resamples, seed: as in `bootstrap_interval`.

    Returns:
        the change, 0.1 for 10 % more; its n is that of the smaller set.

    Raises:
        ValueError: if a set is empty or the mean of `reference` is 0.
    """
    new, old = _without_nan(values), _without_nan(reference)
    if old.mean() == 0:
        raise ValueError("a change relative to a mean of 0 is not defined")
    rng = np.random.default_rng(seed)
    new_S, old_S = (_resampled_means(array, resamples, rng) for array in (new, old))
    changes = new_S[old_S != 0] / old_S[old_S != 0] - 1
    low, high = np.quantile(changes, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return Interval(float(new.mean() / old.mean() - 1), float(low), float(high), min(len(new), len(old)))


def _without_nan(values: Any) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64).ravel()
    array = array[~np.isnan(array)]
    if len(array) == 0:
        raise ValueError("no values to take a mean of")
    return array


def _resampled_means(array: np.ndarray, resamples: int, rng: np.random.Generator) -> np.ndarray:
    return array[rng.integers(len(array), size=(resamples, len(array)))].mean(axis=1)
