"""From judged scenes to rows with intervals. Scenes are independent; seeds and variants of one are not."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.reporting import Row
from textocvp.metrics.intervals import Interval, bootstrap_interval, wilson_interval


def rate_row(method: str, split: str, variant: str, metric: str, success_NR: Any) -> Row:
    """A success rate.

    Repeats of one scene (slot seeds, variants) are averaged first, and the Wilson interval is that of N
    trials with
    fractional successes: wider than if the repeats counted as independent, and never empty at 0 or 1.

    Args:
        success_NR: (N,) or (N, R) bool, N scenes with R repeats each.
    """
    success = np.asarray(success_NR, dtype=np.float64)
    rates_N = success.reshape(len(success), -1).mean(axis=1)
    # The sum is fractional where repeats of a scene disagree; the formula does not mind.
    interval = wilson_interval(float(rates_N.sum()), len(rates_N))  # type: ignore[arg-type]
    return interval_row(method, split, variant, metric, interval)


def mean_row(method: str, split: str, variant: str, metric: str, values_N: Any) -> Row:
    """A mean over N scenes with its bootstrap interval."""
    return interval_row(
        method, split, variant, metric, bootstrap_interval(np.asarray(values_N, dtype=np.float64))
    )


def interval_row(method: str, split: str, variant: str, metric: str, interval: Interval) -> Row:
    """A figure whose interval is known."""
    # Rounding of equal values may leave a mean outside its interval by one bit.
    low, high = min(interval.low, interval.value), max(interval.high, interval.value)
    return Row(method, split, variant, metric, interval.value, low, high, interval.n)
