"""Clusters on painted scenes whose true regions are known."""

from __future__ import annotations

import itertools

import pytest
import torch

from textocvp.parsers.clustering import ClusterInitializer, FeatureClusters, color_features

RED, BLUE, GRAY, DARK = (255, 87, 89), (78, 121, 167), (186, 176, 172), (47, 47, 47)


def paint(*boxes: tuple[tuple[int, int, int], slice, slice], size: int = 64) -> torch.Tensor:
    """(1, 3, size, size) in -1..1: the table with coloured boxes."""
    frame = torch.tensor(DARK, dtype=torch.float32)[:, None, None].expand(3, size, size).clone()
    for color, rows, columns in boxes:
        frame[:, rows, columns] = torch.tensor(color, dtype=torch.float32)[:, None, None]
    return frame[None] / 127.5 - 1


SCENE = ((RED, slice(5, 13), slice(8, 16)), (BLUE, slice(30, 50), slice(20, 45)), (GRAY, slice(4, 20), slice(40, 58)))


def test_every_box_is_one_region_and_the_rest_is_background() -> None:
    clusters = ClusterInitializer()(paint(*SCENE), 8)
    assert clusters.presence.tolist() == [[1, 1, 1, 1, 0, 0, 0, 0]]
    torch.testing.assert_close(clusters.masks.sum(1), torch.ones(1, 64, 64))
    by_area = sorted(SCENE, key=lambda box: -(box[1].stop - box[1].start) * (box[2].stop - box[2].start))
    for region, (_, rows, columns) in zip(clusters.masks[0, 1:4], by_area, strict=True):
        expected = torch.zeros(64, 64)
        expected[rows, columns] = 1
        assert torch.equal(region, expected)


def test_lit_and_shaded_side_are_one_thing_but_touching_colors_are_two() -> None:
    shaded = tuple(int(0.85 * value) for value in BLUE)
    frame = paint(
        (BLUE, slice(20, 30), slice(10, 40)),
        (shaded, slice(30, 40), slice(10, 40)),
        (RED, slice(20, 28), slice(40, 50)),
    )
    clusters = ClusterInitializer()(frame, 8)
    areas = clusters.masks[0].sum((1, 2))
    assert areas[1:4].tolist() == [600, 80, 0]


def test_more_slots_change_nothing_for_the_first_ones() -> None:
    few, many = (ClusterInitializer()(paint(*SCENE), k).masks for k in (6, 14))
    assert torch.equal(few, many[:, :6])


def test_the_largest_regions_win_when_slots_are_few() -> None:
    clusters = ClusterInitializer()(paint(*SCENE), 3)
    assert clusters.masks[0].sum((1, 2)).tolist() == [4096 - 500 - 288, 500, 288]


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_regions_do_not_depend_on_the_order_of_the_color_channels(order: tuple[int, ...]) -> None:
    frame = paint(*SCENE)
    assert torch.equal(ClusterInitializer()(frame, 8).masks, ClusterInitializer()(frame[:, list(order)], 8).masks)


def test_shading_moves_color_features_less_than_another_color_does() -> None:
    def features(color: tuple[int, ...], light: float = 1.0) -> torch.Tensor:
        return color_features(torch.tensor(color) * light / 127.5 - 1)

    shade = (features(RED) - features(RED, 0.85)).norm()
    assert shade < 0.5 * (features(RED) - features(BLUE)).norm()


def test_one_slot_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        ClusterInitializer()(paint(), 1)


def test_features_of_one_kind_are_one_region_whatever_their_length() -> None:
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(4, 32), dim=-1)
    labels = torch.zeros(12, 12, dtype=torch.long)
    labels[1:5, 1:5], labels[6:11, 5:11], labels[1:4, 8:11] = 1, 2, 3
    features = directions[labels] * (1 + torch.rand(12, 12, 1)) + 0.02 * torch.randn(12, 12, 32)
    found = FeatureClusters()(features.permute(2, 0, 1)[None], 4)
    assert found.presence.tolist() == [[1, 1, 1, 1]]
    by_area = torch.tensor([0, 2, 1, 3])  # the background, then the largest
    expected = torch.nn.functional.one_hot(labels, 4).permute(2, 0, 1)[by_area].float()
    assert torch.equal(found.masks[0], expected)
    with pytest.raises(ValueError, match="at least 2"):
        FeatureClusters()(torch.zeros(1, 8, 4, 4), 1)


def test_features_that_are_all_alike_are_all_background() -> None:
    found = FeatureClusters()(torch.ones(1, 8, 4, 4), 3)
    assert found.masks[0, 0].min() == 1 and found.presence.tolist() == [[1, 0, 0]]
