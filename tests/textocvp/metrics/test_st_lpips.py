"""Our ST-LPIPS against the authors' own class, and its properties."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor, nn

from textocvp.metrics import perceptual
from textocvp.metrics.perceptual import MetricUnavailable, load_st_lpips, st_lpips_weights


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> Iterator[nn.Module]:
    """The class in `stlpips_pytorch`. What it imports beside torch is not needed for AlexNet, so it gets blanks."""
    for name, word in (("torchvision", "models"), ("IPython", "embed"), ("torchsummary", "summary")):
        blank = ModuleType(name)
        setattr(blank, word, ModuleType(word))
        monkeypatch.setitem(sys.modules, name, blank)
    from stlpips_pytorch import stlpips

    yield stlpips.LPIPS(net="alex", variant="shift_tolerant", verbose=False)
    for name in [name for name in sys.modules if name.startswith("stlpips_pytorch")]:
        monkeypatch.delitem(sys.modules, name)


def pictures(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("size", [(64, 64), (54, 64), (21, 21)])
def test_distances_are_those_of_the_authors_class(published: nn.Module, size: tuple[int, int]) -> None:
    real, imagined = pictures(2, 6, 3, *size)
    imagined[3:] = 0.9 * real[3:] + 0.1 * imagined[3:]
    expected = published(imagined * 2 - 1, real * 2 - 1).flatten()
    found = load_st_lpips()(imagined, real)
    assert torch.allclose(found, expected, rtol=1e-4, atol=1e-7)
    assert expected[:3].min() > 2 * expected[3:].max()  # a case that can tell a right figure from a wrong one


def test_equal_frames_are_at_0_and_distance_grows_with_noise() -> None:
    real = pictures(2, 3, 64, 64)
    noise = torch.randn(real.shape, generator=torch.Generator().manual_seed(1))
    distance = load_st_lpips()
    found = [float(distance((real + s * noise).clamp(0, 1), real).mean()) for s in (0, 0.05, 0.1, 0.2, 0.4)]
    assert found[0] == 0 and all(a < b for a, b in pairwise(found))


def test_a_pixels_shift_counts_less_than_another_picture() -> None:
    """What the metric is for: PSNR of the two is nearly equal here, ST-LPIPS is not."""
    blocks = pictures(1, 3, 10, 10).repeat_interleave(8, 2).repeat_interleave(8, 3)
    real, shifted, other = (blocks[..., 8:72, 8:72], blocks[..., 8:72, 9:73], blocks.flip(-1)[..., 8:72, 8:72])
    distance = load_st_lpips()
    assert float(distance(shifted, real)) < 0.25 * float(distance(other, real))


def test_features_kept_of_the_real_video_give_the_same_distances() -> None:
    real, imagined = pictures(2, 5, 3, 32, 32)
    distance = load_st_lpips()
    kept = distance.features(real)
    assert torch.equal(distance.compare(distance.features(imagined), kept), distance(imagined, real))
    short = distance.compare(distance.features(imagined[:2]), kept.first(2))
    assert torch.allclose(short, distance(imagined, real)[:2], rtol=1e-5)


def test_small_pictures_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 21x21 pixels, not 20x64"):
        load_st_lpips()(pictures(1, 3, 20, 64), pictures(1, 3, 20, 64))


def test_other_weights_are_refused(tmp_path: Path) -> None:
    stored = torch.load(st_lpips_weights(), map_location="cpu", weights_only=True)
    del stored["lin3.model.1.weight"]
    torch.save(stored, tmp_path / "a.pth")
    with pytest.raises(MetricUnavailable, match=r"has not the weights .*lin3\.model\.1\.weight"):
        load_st_lpips(tmp_path / "a.pth")


def test_without_the_package_the_reason_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perceptual, "find_spec", lambda name: None)
    with pytest.raises(MetricUnavailable, match=r"ST-LPIPS cannot be computed: .*pip install stlpips_pytorch"):
        load_st_lpips()
