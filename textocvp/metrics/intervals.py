"""How good masks and frames are, and how sure a figure is.

Masks are compared with the simulator's segmentation: 0 is the background, 1 the arm, 2 + i object i. Nothing
here is used to train anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri

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
