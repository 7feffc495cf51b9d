"""JEDi: the discrepancy by hand and by an explicit feature map; features from real files or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import VJEPA2Config, VJEPA2ForVideoClassification, VJEPA2Model

from textocvp.metrics.jedi import jedi, load_vjepa, polynomial_mmd
from textocvp.metrics.perceptual import MetricUnavailable

TINY = VJEPA2Config(
    crop_size=16, patch_size=8, frames_per_clip=4, hidden_size=12, num_attention_heads=1, num_hidden_layers=1,
    num_pooler_layers=1, pred_hidden_size=12, pred_num_attention_heads=1, pred_num_hidden_layers=1, num_labels=2,
)  # fmt: skip


def distance_of_means(x: np.ndarray, y: np.ndarray) -> float:
    """(x . y / D)^2 is the inner product of all products of two coordinates, so the value is a distance of means."""
    means = [z.T @ z / len(z) / z.shape[1] for z in (x, y)]
    return 100 * ((means[0] - means[1]) ** 2).sum()


def test_discrepancy_by_hand() -> None:
    # D = 2. Own pairs of x: k(a, a) = (1 / 2)^2, k(b, b) = (4 / 2)^2, k(a, b) = 0: mean 17 / 16. y is one point with
    # k = (2 / 2)^2 = 1. Between: (1 / 2)^2 and (2 / 2)^2: mean 5 / 8. Together 17 / 16 + 1 - 5 / 4 = 13 / 16.
    x, y = np.array([[1.0, 0.0], [0.0, 2.0]]), np.array([[1.0, 1.0]])
    assert polynomial_mmd(x, y) == pytest.approx(100 * 13 / 16)


def test_discrepancy_agrees_with_the_features_that_the_kernel_stands_for() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(9, 5)), rng.normal(0.3, 1.2, size=(7, 5))
    assert polynomial_mmd(x, y) == pytest.approx(distance_of_means(x, y))
    assert polynomial_mmd(y, x) == pytest.approx(distance_of_means(x, y))


def test_equal_sets_in_any_order_are_at_0_and_no_interval_leaves_its_value() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(20, 6))
    assert polynomial_mmd(x, x[::-1]) == pytest.approx(0, abs=1e-9)
    found = jedi(x, x)
    assert found.low <= found.value <= found.high and found.n == 20
    y = x + rng.normal(0, 0.5, size=x.shape)
    other = jedi(y, x)
    assert 0 <= other.low < other.value < other.high
    assert other == jedi(y, x) and other.value == polynomial_mmd(y, x)


def test_the_interval_holds_the_truth_about_as_often_as_it_says() -> None:
    """Videos that differ by a shift: the truth is the value of very many of them."""
    many = np.random.default_rng(2).normal(size=(4000, 3))
    shift = np.array([1.0, 0.5, 0.0])
    truth = distance_of_means(many + shift, many)
    inside = 0
    for trial in range(100):
        x = np.random.default_rng(100 + trial).normal(size=(60, 3))
        found = jedi(x + shift, x, resamples=300)
        inside += found.low <= truth <= found.high
    assert 85 <= inside <= 100


@pytest.mark.parametrize("shapes", [((3, 4), (3, 5)), ((0, 4), (3, 4)), ((4,), (4,))])
def test_features_that_do_not_fit_are_refused(shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    with pytest.raises(ValueError, match=r"need features \(N, D\)"):
        polynomial_mmd(np.ones(shapes[0]), np.ones(shapes[1]))


def test_videos_without_a_partner_are_refused() -> None:
    with pytest.raises(ValueError, match="a real video for each"):
        jedi(np.ones((3, 4)), np.ones((4, 4)))


def test_features_are_those_of_the_attentive_probe(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = VJEPA2ForVideoClassification(TINY).eval()
    model.save_pretrained(tmp_path)
    videos = torch.rand(2, 4, 3, 16, 16)
    found = load_vjepa(tmp_path)(videos)
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    pixels = (videos - mean.view(3, 1, 1)) / deviation.view(3, 1, 1)
    seen: list[torch.Tensor] = []
    model.classifier.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    model(pixel_values_videos=pixels)
    assert found.shape == (2, 12)
    assert torch.allclose(found, seen[0], atol=1e-5)


def test_without_a_probe_they_are_the_mean_of_the_tokens_and_videos_are_stretched(tmp_path: Path) -> None:
    torch.manual_seed(0)
    VJEPA2Model(TINY).save_pretrained(tmp_path)
    features = load_vjepa(tmp_path)
    video = torch.rand(1, 2, 3, 16, 16)
    slow = video.repeat_interleave(2, dim=1)  # what stretching two frames to four gives
    assert features(video).shape == (1, 12)
    assert torch.equal(features(video), features(slow))
    assert not torch.allclose(features(video), features(video.flip(1)))


def test_without_weights_the_reason_says_what_to_fetch(tmp_path: Path) -> None:
    with pytest.raises(MetricUnavailable, match="hf download facebook/vjepa2"):
        load_vjepa(tmp_path / "nothing")


def test_incomplete_weights_are_refused_and_never_filled_with_random_ones(tmp_path: Path) -> None:
    VJEPA2Model(TINY).save_pretrained(tmp_path)
    stored = load_file(tmp_path / "model.safetensors")
    del stored["encoder.layernorm.weight"]
    save_file(stored, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(MetricUnavailable, match=r"1 weights are missing, as encoder\.layernorm\.weight"):
        load_vjepa(tmp_path)
