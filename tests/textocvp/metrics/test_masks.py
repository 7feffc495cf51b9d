"""Overlap of slots with objects against values worked out by hand and against slow definitions."""

from itertools import combinations, permutations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from textocvp.metrics import followed, foreground_ari, masks, object_ious, slot_labels


def ari_by_counting_pairs(labels: np.ndarray, truth: np.ndarray) -> float:
    """The definition: how many pairs of pixels are treated alike, adjusted for chance. Slow and independent."""
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
    assert foreground_ari(labels, truth) == pytest.approx(ari_by_counting_pairs(labels[inside], truth[inside]))
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
    matched = object_ious(labels, segmentation, [2, 3, 4])
    # Slot 4 overlaps object 2 by 30/60 and object 3 by 30/80; slot 6 has only object 3, by 20/50.
    assert matched.ids.tolist() == [2, 3] and matched.slots.tolist() == [4, 6]
    assert matched.ious == pytest.approx([0.5, 0.4])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_matching_is_as_good_as_trying_every_assignment(seed):
    rng = np.random.default_rng(seed)
    segmentation, labels = rng.integers(2, 5, size=(12, 12)), rng.integers(4, size=(12, 12))
    found = object_ious(labels, segmentation, [2, 3, 4])

    def iou(slot, thing):
        a, b = labels == slot, segmentation == thing
        return (a & b).sum() / (a | b).sum()

    best = max(sum(iou(s, i) for s, i in zip(p, found.ids, strict=True)) for p in permutations(range(4), 3))
    assert found.ious.sum() == pytest.approx(best)


def test_fewer_slots_than_objects_leaves_an_object_with_nothing():
    segmentation = np.repeat(np.array([[2, 3]]), 10, axis=0).repeat(2, axis=1)
    matched = object_ious(np.zeros_like(segmentation), segmentation, [2, 3])
    assert sorted(matched.slots.tolist()) == [-1, 0] and sorted(matched.ious.tolist()) == [0.0, 0.5]


def test_slivers_and_labels_that_are_no_objects_do_not_count(monkeypatch):
    segmentation, one_slot = np.ones((10, 10), int), np.zeros((10, 10), int)
    segmentation[0, :3], segmentation[5:, :] = 2, 3
    assert object_ious(one_slot, segmentation, [2, 3]).ids.tolist() == [3]
    # The robot, where it is asked for.
    assert object_ious(one_slot, segmentation, [1, 3, 9]).ids.tolist() == [1, 3]
    assert object_ious(one_slot, segmentation, []).ids.tolist() == []
    monkeypatch.setattr(masks, "MIN_PIXELS", 1)
    assert object_ious(one_slot, segmentation, [2, 3]).ids.tolist() == [2, 3]


def test_the_background_has_the_label_that_the_data_gives_it():
    truth = np.array([[7, 7, 1, 2, 0, 0]])
    labels = np.array([[3, 5, 4, 6, 8, 8]])
    assert foreground_ari(labels, truth, background=7) == 1.0
    assert foreground_ari(labels, truth) < 1.0  # the two pixels of 7 are in two slots


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
    assert followed(labels, segmentation, [2, 3]).tolist() == [True, True]
    labels[2] = np.where(labels[2] == 2, 3, np.where(labels[2] == 3, 2, 0))
    assert followed(labels, segmentation, [2, 3]).tolist() == [False, False]
    stuck = np.repeat(segmentation[:1], 4, axis=0)  # the slot stays where the object was
    assert followed(stuck, segmentation, [2, 3]).tolist() == [False, True]


def test_frames_where_the_object_is_hidden_do_not_count_against_its_slot():
    segmentation = moving_squares()
    labels = segmentation.copy()
    segmentation[1, 2:7, 2:8] = 1  # the arm hides most of the object; its slot is elsewhere meanwhile
    labels[1, 2:7] = 0
    assert followed(labels, segmentation, [2, 3]).tolist() == [True, True]
