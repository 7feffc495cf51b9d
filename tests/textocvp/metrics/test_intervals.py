"""Intervals against other implementations, and how often they hold the truth."""

import numpy as np
import pytest
from scipy import stats

from textocvp.metrics import bootstrap_interval, ratio_interval, relative_change, wilson_interval


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (10, 10), (7, 10), (95, 100), (1, 1)])
def test_wilson_agrees_with_scipy(successes, trials):
    found = wilson_interval(successes, trials)
    reference = stats.binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    assert (found.low, found.high) == pytest.approx((reference.low, reference.high), abs=1e-9)
    assert found.low <= found.value <= found.high and found.n == trials


def test_wilson_refuses_impossible_counts():
    with pytest.raises(ValueError, match="11 of 10"):
        wilson_interval(11, 10)


def test_a_ratio_of_rates_is_as_sure_as_they_are():
    # 8 of 8 twice: nothing was lost, but each rate may be as low as .676, and so the ratio 1.48 either way.
    all_of_8 = wilson_interval(8, 8)
    found = ratio_interval(all_of_8, all_of_8)
    assert (found.value, found.low, found.high, found.n) == pytest.approx((1, all_of_8.low, 1 / all_of_8.low, 8))
    # For many trials it is the textbook's interval on the logarithm (Katz 1978).
    p, q, n = 0.6, 0.8, 4000
    found = ratio_interval(wilson_interval(int(p * n), n), wilson_interval(int(q * n), n))
    half = 1.96 * ((1 - p) / (p * n) + (1 - q) / (q * n)) ** 0.5
    assert (found.low, found.high) == pytest.approx((p / q * np.exp(-half), p / q * np.exp(half)), rel=1e-3)
    with pytest.raises(ValueError, match="ratio to 0"):
        ratio_interval(all_of_8, wilson_interval(0, 8))


def test_bootstrap_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(200):
        interval = bootstrap_interval(rng.normal(3.0, 1.0, size=40), resamples=400, seed=trial)
        covered += interval.low <= 3.0 <= interval.high
    assert 0.88 <= covered / 200 <= 0.98


def test_bootstrap_repeats_and_leaves_nan_out():
    values = [1.0, 2.0, float("nan"), 4.0]
    assert bootstrap_interval(values, seed=1) == bootstrap_interval(values, seed=1)
    assert bootstrap_interval(values).n == 3
    with pytest.raises(ValueError, match="no values"):
        bootstrap_interval([float("nan")])


def test_relative_change_by_hand():
    found = relative_change([0.3, 0.5, float("nan")], [0.25, 0.25, 0.25, 0.25])
    assert found.value == pytest.approx(0.6) and found.n == 2
    # Resamples of two values are 0.3, 0.4 or 0.5, and the reference never changes.
    assert (found.low, found.high) == pytest.approx((0.2, 1.0))
    with pytest.raises(ValueError, match="mean of 0"):
        relative_change([1.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="no values"):
        relative_change([], [1.0])


def test_relative_change_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(200):
        new, old = rng.normal(3.0, 0.5, size=40), rng.normal(2.0, 0.5, size=30)
        interval = relative_change(new, old, resamples=400, seed=trial)
        covered += interval.low <= 0.5 <= interval.high
    assert 0.88 <= covered / 200 <= 0.98
