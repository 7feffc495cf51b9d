"""A value and its 95 % interval: rates, means, ratios and relative changes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are first used

CONFIDENCE = 0.95
QUANTILES = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)


@dataclass(frozen=True)
class Interval:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float
    n: int  # how many independent samples it comes from

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def wilson_interval(successes: int, trials: int) -> Interval:
    """A success rate and its Wilson score interval, which stays inside 0..1 also for few trials and for 0 or all.

    Raises:
        ValueError: unless 0 <= successes <= trials and trials >= 1.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"need 0 <= successes <= trials and at least one trial, got {successes} of {trials}")
    z = float(scipy.special.ndtri(QUANTILES[1]))
    rate = successes / trials
    center = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * (rate * (1 - rate) / trials + z**2 / (4 * trials**2)) ** 0.5
    # Exactly 0 and 1 at the ends: rounding would leave the value outside its own interval.
    low = 0.0 if successes == 0 else center - half
    high = 1.0 if successes == trials else center + half
    return Interval(rate, low, high, trials)


def ratio_interval(above: Interval, below: Interval) -> Interval:
    """The ratio of two independent values of at least 0; its upper end is inf where `below` may be 0.

    MOVER (Donner and Zou, "Closed-form confidence intervals for functions of the normal mean and standard deviation",
    2012), because a bootstrap's interval is empty for two rates of 1.

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


def bootstrap_interval(values: Any, *, resamples: int = 2000, seed: int = 0) -> Interval:
    """A mean and its percentile bootstrap interval.

    Args:
        values: (N,), one for each independent sample, nan left out. Frames of one episode are not independent.
        resamples: how many times the values are drawn again.
        seed: of the drawing.

    Raises:
        ValueError: if no value is left.
    """
    array = _without_nan(values)
    low, high = np.quantile(_resampled_means(array, resamples, np.random.default_rng(seed)), QUANTILES)
    return Interval(float(array.mean()), float(low), float(high), len(array))


def relative_change(values: Any, reference: Any, *, resamples: int = 2000, seed: int = 0) -> Interval:
    """How much larger the mean of one set of scenes is than that of another: 0.1 for 10 %. Its n is the smaller one.

    Arguments as `bootstrap_interval`; (N,) values and (M,) of the reference. The sets are of different scenes, so each
    is drawn again on its own. A resample whose reference mean is 0 is left out.

    Raises:
        ValueError: if a set is empty or the mean of `reference` is 0.
    """
    new, old = _without_nan(values), _without_nan(reference)
    if old.mean() == 0:
        raise ValueError("a change relative to a mean of 0 is not defined")
    rng = np.random.default_rng(seed)
    new_S, old_S = (_resampled_means(array, resamples, rng) for array in (new, old))
    changes = new_S[old_S != 0] / old_S[old_S != 0] - 1
    low, high = np.quantile(changes, QUANTILES)
    return Interval(float(new.mean() / old.mean() - 1), float(low), float(high), min(len(new), len(old)))


def _without_nan(values: Any) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64).ravel()
    array = array[~np.isnan(array)]
    if len(array) == 0:
        raise ValueError("no values to take a mean of")
    return array


def _resampled_means(array: np.ndarray, resamples: int, rng: np.random.Generator) -> np.ndarray:
    return array[rng.integers(len(array), size=(resamples, len(array)))].mean(axis=1)
