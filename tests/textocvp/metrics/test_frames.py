"""PSNR by hand and SSIM against its formula."""

import numpy as np
import pytest
import torch

from textocvp.metrics import psnr, ssim


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
        np.pad(x, ((0, 0), (5, 5), (5, 5)), "reflect"), np.pad(y, ((0, 0), (5, 5), (5, 5)), "reflect"), strict=True
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
