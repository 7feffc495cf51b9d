"""A measured figure with its interval. Scenes are independent; slot seeds and variants of one scene are not."""

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from textocvp.metrics.intervals import Interval, bootstrap_interval, wilson_interval

Key = tuple[str, str, str, str]  # (method, split, variant, metric): what names a row


@dataclass(frozen=True)
class Row:
    """One figure with its 95 % interval.

    Raises:
        ValueError: if a name is empty, a number is not finite, or the figure lies outside its interval.
    """

    method: str  # who was measured, as `ours` or `copy frame`
    split: str  # the scenes, as `controllability` or `unseen_colors`
    variant: str  # which part of them, as `variant 1` or `9 frames`
    metric: str  # what was measured, as `predicted_success`
    value: float  # the figure
    low: float  # the lower end of its interval
    high: float  # the upper end
    n: int  # the number of independent scenes behind it

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in ("method", "split", "variant", "metric") and not (isinstance(value, str) and value):
                raise ValueError(f"row.{name} must be a word, got {value!r}")
            if name in ("value", "low", "high") and not is_number(value):
                raise ValueError(f"row.{name} of {self.method!r} must be a finite number, got {value!r}")
        if isinstance(self.n, bool) or not isinstance(self.n, int) or self.n < 1:
            raise ValueError(f"row.n of {self.method!r} must be a whole number of at least 1, got {self.n!r}")
        if not self.low <= self.value <= self.high:
            raise ValueError(f"{self.method!r}: {self.value} is outside its interval {self.low}..{self.high}")

    @property
    def key(self) -> Key:
        """What names it."""
        return self.method, self.split, self.variant, self.metric


def is_number(value: object) -> bool:
    """Whether it is a finite number; True and False are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def by_key(rows: Iterable[Row]) -> dict[Key, Row]:
    """The rows by their names."""
    return {row.key: row for row in rows}


def rate_row(method: str, split: str, variant: str, metric: str, success_NR: Any) -> Row:
    """A success rate with its Wilson interval.

    Args:
        success_NR: (N,) or (N, R) bool, N scenes with R repeats each. The repeats of a scene are averaged first.
    """
    success = np.asarray(success_NR, dtype=np.float64)
    rates_N = success.reshape(len(success), -1).mean(axis=1)
    # The interval of N trials with fractional successes: wider than if repeats counted as independent trials, and
    # never empty at 0 or 1. The formula does not mind that the sum is fractional.
    interval = wilson_interval(float(rates_N.sum()), len(rates_N))  # type: ignore[arg-type]
    return interval_row(method, split, variant, metric, interval)


def mean_row(method: str, split: str, variant: str, metric: str, values_N: Any) -> Row:
    """A mean over N scenes with its bootstrap interval."""
    interval = bootstrap_interval(np.asarray(values_N, dtype=np.float64))
    return interval_row(method, split, variant, metric, interval)


def interval_row(method: str, split: str, variant: str, metric: str, interval: Interval) -> Row:
    """A figure whose interval is known."""
    # Rounding of equal values may leave a mean outside its interval by one bit.
    low, high = min(interval.low, interval.value), max(interval.high, interval.value)
    return Row(method, split, variant, metric, interval.value, low, high, interval.n)


def pick_figures(rows: Iterable[Row], wanted: Mapping[str, Key]) -> dict[str, float]:
    """The figures of these names, rounded to 4 digits; those that were not measured are left out."""
    found = by_key(rows)
    return {name: round(found[key].value, 4) for name, key in wanted.items() if key in found}


def figure_rows(
    scenes: Iterable[tuple[str, Mapping[tuple[str, str, str], Any]]], rates: Collection[str] = ()
) -> list[Row]:
    """A row for each figure of each split: of truth values a rate, of numbers a mean.

    Args:
        scenes: the split of each and its figures: (method, variant, metric) -> a number, or one or more truth values.
        rates: metrics of which a scene's number is the share that came true.
    """
    values: dict[Key, list[Any]] = {}
    for split, figures in scenes:
        for (method, variant, metric), value in figures.items():
            values.setdefault((method, split, variant, metric), []).append(value)
    return [
        (rate_row if key[3] in rates or np.asarray(its).dtype == bool else mean_row)(*key, its)
        for key, its in values.items()
    ]
