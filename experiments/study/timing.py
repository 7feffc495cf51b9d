"""How time is taken: competitors in turns, medians of rounds, and what figures in seconds depend on."""

import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from joblib import cpu_count
from scipy.stats import binom

from textocvp.metrics.intervals import Interval

Work = Callable[[], object]
CORES = cpu_count()
FEWEST = 3  # rounds that are always made, however long they take


def race(
    works: Mapping[str, Work], repeats: int, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> dict[str, np.ndarray]:
    """(rounds,) seconds of each piece of work, after one round that does not count.

    In every round each has its turn, starting with another one, so that whatever else the machine does meets all of
    them alike and the ratio of two of them in one round means something. What has used its equal share of `seconds`
    takes no part after the third of `repeats` rounds, so that it does not cut short what is quick.
    """
    for work in works.values():
        work()
    taken: dict[str, list[float]] = {name: [] for name in works}
    running = list(works)
    for number in range(repeats):
        if number >= FEWEST:
            running = [name for name in running if sum(taken[name]) < seconds / len(works)]
        turn = number % max(1, len(running))
        for name in running[turn:] + running[:turn]:
            began = clock()
            works[name]()
            taken[name].append(clock() - began)
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
    k = max(1, int(binom.ppf((1 - confidence) / 2, n, 0.5)))
    return Interval(float(np.median(ordered)), float(ordered[k - 1]), float(ordered[n - k]), n)


def machine_in_words() -> str:
    """What figures in seconds depend on, without the machine's name."""
    told = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").is_file() else ""
    named = [line.partition(":")[2].strip() for line in told.splitlines() if line.startswith("model name")]
    processor = (named or [platform.machine() or "unknown processor"])[0]
    return (
        f"{CORES} core{'s' if CORES != 1 else ''} ({processor}), PyTorch {torch.__version__} in float32, "
        f"Python {platform.python_version()}, {platform.system()}"
    )
