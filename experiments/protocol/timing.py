"""Timing: several pieces of work in turn, the median of repeats, and ratios that travel between machines."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from scipy.stats import binom

from experiments.protocol.workers import available_cores
from textocvp.metrics.intervals import Interval

FEWEST = 3
"""Rounds that are always made, however long they take."""


def race(
    works: Mapping[str, Callable[[], object]],
    repeats: int,
    seconds: float,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, np.ndarray]:
    """Seconds of each piece of work in each round, after one round that does not count.

    In every round each has its turn, starting with another one, so that whatever else the machine does meets all of
    them alike and the ratio of two of them in one round means something. What takes long drops out early, so that it
    does not cut short what is quick.

    Args:
        works: name -> what to do.
        repeats: rounds to make.
        seconds: for all together. What has used its equal share of it takes no part in rounds after the third.
        clock: gives the time in seconds.

    Returns:
        name -> (rounds,) seconds, of the first rounds, as many as it took part in.
    """
    for work in works.values():
        work()
    taken: dict[str, list[float]] = {name: [] for name in works}
    for number in range(repeats):
        running = [
            name
            for name, rounds in taken.items()
            if len(rounds) == number and (number < FEWEST or sum(rounds) < seconds / len(works))
        ]
        turn = number % max(1, len(running))
        for name in running[turn:] + running[:turn]:
            start = clock()
            works[name]()
            taken[name].append(clock() - start)
    return {name: np.array(rounds) for name, rounds in taken.items()}


def median_interval(values: np.ndarray, confidence: float = 0.95) -> Interval:
    """A median and its distribution-free interval: from one order statistic to another.

    With fewer than 6 values no such interval reaches 95 %; it is then their range.

    Raises:
        ValueError: if there is no value.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    n = len(ordered)
    if n == 0:
        raise ValueError("no values to take a median of")
    # P(the median lies between the k-th smallest and the k-th largest) = 1 - 2 P(Binomial(n, 1/2) < k)
    outside = (1 - confidence) / 2
    k = max((k for k in range(1, n // 2 + 1) if binom.cdf(k - 1, n, 0.5) <= outside), default=1)
    return Interval(float(np.median(ordered)), float(ordered[k - 1]), float(ordered[n - k]), n)


def machine_in_words() -> str:
    """What figures in seconds depend on, without the machine's name."""
    cores = available_cores()
    return (
        f"{cores} core{'s' if cores != 1 else ''} ({_processor()}), PyTorch {torch.__version__} in float32, "
        f"Python {platform.python_version()}, {platform.system()}"
    )


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.machine() or "unknown processor"


def other_load() -> float:
    """How busy the cores were over the last minute, before this study: 0 idle, 1 all busy, more if work queued."""
    if not hasattr(os, "getloadavg"):
        return 0.0
    return os.getloadavg()[0] / available_cores()
