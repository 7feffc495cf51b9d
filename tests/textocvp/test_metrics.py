"""Metrics against values worked out by hand and against other implementations."""

from itertools import combinations, permutations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from textocvp.metrics.frames import psnr, ssim
from textocvp.metrics.intervals import bootstrap_interval, ratio_interval, relative_change, wilson_interval
from textocvp.metrics.masks import followed, foreground_ari, object_ious, slot_labels


def ari_by_counting_pairs(labels: np.ndarray, truth: np.ndarray) -> float:
    """The definition: how many pairs of pixels are treated alike, adjusted for chance. Slow and
    independent."""
    a = b = c = n = 0
    for i, j in combinations(range(len(labels)), 2):
        same_label, same_truth = labels[i] == labels[j], truth[i] == truth[j]
        a += same_label and same_truth
        b += same_label
        c += same_truth
        n += 1
    expected = b * c / n
    most = (b + c) / 2
    return 1.0 if most == expected else (a - expected) / (most - expected)


def test_ari_of_a_case_worked_out_by_hand():
    # Two things of 3 pixels; one slot takes 2 + 1, the other 1 + 2. Pairs: together 2, by slot 6, by thing
    # 6, of 15: expected 36 / 15 = 2.4, most 6, so (2 - 2.4) / (6 - 2.4) = -1 / 9.
    segmentation = np.array([[1, 1, 1, 2, 2, 2]])
    labels = np.array([[0, 0, 1, 0, 1, 1]])
    assert foreground_ari(labels, segmentation) == pytest.approx(-1 / 9)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 4))
def test_ari_agrees_with_counting_pairs_and_ignores_the_background(seed, slots, things):
    rng = np.random.default_rng(seed)
    labels, truth = rng.integers(slots, size=(5, 6)), rng.integers(things + 1, size=(5, 6))
    inside = truth > 0
    if inside.sum() < 2:
        return
    assert foreground_ari(labels, truth) == pytest.approx(
        ari_by_counting_pairs(labels[inside], truth[inside])
    )
    changed = np.where(inside, labels, rng.integers(slots, size=(5, 6)))
    assert foreground_ari(changed, truth) == foreground_ari(labels, truth)


def test_ari_of_nothing_is_nan_and_of_a_perfect_division_one():
    assert np.isnan(foreground_ari(np.zeros((4, 4), int), np.zeros((4, 4), int)))
    truth = np.array([[0, 1, 2, 3]])
    assert foreground_ari(np.array([[9, 5, 7, 6]]), truth) == 1.0


def test_objects_share_no_slot_and_get_the_best_total():
    segmentation = np.zeros((10, 10), int)
    segmentation[:, 2:5], segmentation[:, 5:10] = 2, 3
    labels = np.zeros((10, 10), int)
    labels[:, 2:8], labels[:, 8:10] = 4, 6
    matched = object_ious(labels, segmentation)
    # Slot 4 overlaps object 2 by 30/60 and object 3 by 30/80; slot 6 has only object 3, by 20/50.
    assert matched.ids.tolist() == [2, 3] and matched.slots.tolist() == [4, 6]
    assert matched.ious == pytest.approx([0.5, 0.4])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_matching_is_as_good_as_trying_every_assignment(seed):
    rng = np.random.default_rng(seed)
    segmentation, labels = rng.integers(2, 5, size=(12, 12)), rng.integers(4, size=(12, 12))
    found = object_ious(labels, segmentation)

    def iou(slot, thing):
        a, b = labels == slot, segmentation == thing
        return (a & b).sum() / (a | b).sum()

    best = max(sum(iou(s, i) for s, i in zip(p, found.ids, strict=True)) for p in permutations(range(4), 3))
    assert found.ious.sum() == pytest.approx(best)


def test_fewer_slots_than_objects_leaves_an_object_with_nothing():
    segmentation = np.repeat(np.array([[2, 3]]), 10, axis=0).repeat(2, axis=1)
    matched = object_ious(np.zeros_like(segmentation), segmentation)
    assert sorted(matched.slots.tolist()) == [-1, 0] and sorted(matched.ious.tolist()) == [0.0, 0.5]


def test_slivers_and_the_arm_do_not_count():
    segmentation = np.ones((10, 10), int)
    segmentation[0, :3], segmentation[5:, :] = 2, 3
    assert object_ious(np.zeros((10, 10), int), segmentation).ids.tolist() == [3]
    assert object_ious(np.zeros((10, 10), int), segmentation, min_pixels=1).ids.tolist() == [2, 3]


def test_masks_and_labels_mean_the_same():
    masks = torch.rand(3, 5, 8, 8).softmax(dim=1)
    labels = slot_labels(masks)
    assert labels.shape == (3, 8, 8) and (labels == masks.argmax(1).numpy()).all()
    assert (slot_labels(labels) == labels).all()
    with pytest.raises(ValueError, match=r"\(8, 8\).*\(4, 4\)"):
        foreground_ari(masks[0], np.zeros((4, 4), int))


def moving_squares(frames: int = 4) -> np.ndarray:
    segmentation = np.zeros((frames, 20, 20), int)
    for t in range(frames):
        segmentation[t, 2:7, 2 + 2 * t : 7 + 2 * t] = 2
        segmentation[t, 12:17, 12:17] = 3
    return segmentation


def test_a_slot_follows_its_object_until_it_swaps():
    segmentation = moving_squares()
    labels = segmentation.copy()
    assert followed(labels, segmentation).tolist() == [True, True]
    labels[2] = np.where(labels[2] == 2, 3, np.where(labels[2] == 3, 2, 0))
    assert followed(labels, segmentation).tolist() == [False, False]
    stuck = np.repeat(segmentation[:1], 4, axis=0)  # the slot stays where the object was
    assert followed(stuck, segmentation).tolist() == [False, True]


def test_frames_where_the_object_is_hidden_do_not_count_against_its_slot():
    segmentation = moving_squares()
    labels = segmentation.copy()
    segmentation[1, 2:7, 2:8] = 1  # the arm hides most of the object; its slot is elsewhere meanwhile
    labels[1, 2:7] = 0
    assert followed(labels, segmentation).tolist() == [True, True]


def test_psnr_by_hand():
    real = torch.zeros(2, 3, 16, 16)
    imagined = real.clone()
    imagined[1] += 0.1
    assert psnr(imagined, real)[0] == float("inf")
    assert psnr(imagined, real)[1].item() == pytest.approx(20.0, abs=1e-4)


def ssim_by_the_formula(x: np.ndarray, y: np.ndarray) -> float:
    """Wang et al. 2004 with a Gaussian window, the image mirrored at its edges, channel by channel."""
    axis = np.arange(11) - 5
    window = np.exp(-(axis**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    values = []
    for a, b in zip(
        np.pad(x, ((0, 0), (5, 5), (5, 5)), "reflect"),
        np.pad(y, ((0, 0), (5, 5), (5, 5)), "reflect"),
        strict=True,
    ):
        A = np.lib.stride_tricks.sliding_window_view(a, (11, 11))
        B = np.lib.stride_tricks.sliding_window_view(b, (11, 11))
        ma, mb = (A * window).sum((-1, -2)), (B * window).sum((-1, -2))
        va, vb = (A**2 * window).sum((-1, -2)) - ma**2, (B**2 * window).sum((-1, -2)) - mb**2
        cov = (A * B * window).sum((-1, -2)) - ma * mb
        c1, c2 = 0.01**2, 0.03**2
        values.append((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    return float(np.mean(values))


def test_ssim_agrees_with_the_formula():
    torch.manual_seed(0)
    real = torch.rand(2, 2, 3, 24, 24)
    imagined = (real + 0.1 * torch.randn_like(real)).clamp(0, 1)
    value = ssim(imagined, real)
    assert value.shape == (2, 2)
    reference = ssim_by_the_formula(imagined[1, 0].double().numpy(), real[1, 0].double().numpy())
    assert value[1, 0].item() == pytest.approx(reference, abs=1e-5)
    assert ssim(real, real).min() > 0.9999


def test_frames_of_different_shapes_are_refused():
    with pytest.raises(ValueError, match="one shape"):
        psnr(torch.zeros(2, 3, 8, 8), torch.zeros(3, 3, 8, 8))


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
    assert (found.value, found.low, found.high, found.n) == pytest.approx(
        (1, all_of_8.low, 1 / all_of_8.low, 8)
    )
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
