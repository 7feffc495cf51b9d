"""LPIPS is computed as it should be, or absent with a reason."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor, nn

from textocvp.metrics.perceptual import MetricUnavailable, load_lpips


@pytest.fixture(autouse=True)
def no_kept_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TEXTOCVP_CACHE", str(tmp_path))


class MeanDifference(nn.Module):
    """Stands in for the library's network: the mean of the difference, in the network's own shape."""

    def __init__(self, **_: object) -> None:
        super().__init__()

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        assert a.min() >= -1 and a.max() <= 1 and a.ndim == 4
        return (a - b).mean(dim=(1, 2, 3), keepdim=True)


def test_frames_of_any_leading_shape_are_measured_in_the_networks_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=MeanDifference))
    distance = load_lpips()
    real = torch.zeros(2, 4, 3, 8, 8)
    imagined = real.clone()
    imagined[1, 2] = 0.5
    found = distance(imagined, real)
    assert found.shape == (2, 4) and found[1, 2] == 1.0 and found.sum() == 1.0
    assert distance(real[0, 0], real[0, 0]).shape == ()
    with pytest.raises(ValueError, match="one shape"):
        distance(real, real[:1])


def test_without_the_library_the_reason_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(MetricUnavailable, match="needs the package lpips and a torchvision"):
        load_lpips()


def test_without_the_weights_the_reason_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(**_: object) -> nn.Module:
        raise OSError("no network")

    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=offline))
    with pytest.raises(MetricUnavailable, match=r"weights of AlexNet: no network"):
        load_lpips()


def test_with_both_it_is_named_after_its_backbone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=MeanDifference))
    assert load_lpips().name == "LPIPS (AlexNet)"


def test_the_real_network_finds_equal_pictures_equal() -> None:
    try:
        distance = load_lpips()
    except MetricUnavailable as reason:
        pytest.skip(str(reason))
    picture = torch.rand(2, 3, 64, 64)
    assert distance(picture, picture).abs().max() < 1e-6
    assert distance(picture, 1 - picture).min() > 0.01
