"""JEDi: how far a set of imagined videos is from a set of real ones (Luo et al., "Beyond FVD", ICLR 2025).

Maximum mean discrepancy with a polynomial kernel between V-JEPA features of the two sets. Lower is more alike, 0 for
equal sets. The original takes the attentive probe of V-JEPA (ViT-L, Something-Something v2); here it is that of V-JEPA
2, which transformers has, so values compare with each other and not with those of the paper.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from textocvp.metrics.intervals import QUANTILES, Interval
from textocvp.metrics.perceptual import MetricUnavailable

VJEPA = "facebook/vjepa2-vitl-fpc16-256-ssv2"
# Of ImageNet's colours for pictures in 0..1: what V-JEPA was trained on.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def polynomial_mmd(imagined_ND: np.ndarray, real_MD: np.ndarray) -> float:
    """100 times the squared maximum mean discrepancy, biased (a set's own pairs count), kernel (x . y / D) ** 2.

    Raises:
        ValueError: unless both are (any number, D) and not empty.
    """
    kernels = _kernels(imagined_ND, real_MD)
    return float(_discrepancy(kernels, *(np.full((1, len(own)), 1 / len(own)) for own in kernels[:2]))[0])


def jedi(imagined_ND: np.ndarray, real_ND: np.ndarray, *, resamples: int = 2000, seed: int = 0) -> Interval:
    """JEDi of N imagined videos and the N real ones, with a bootstrap interval over scenes.

    Args:
        imagined_ND, real_ND: features, row i of both from scene i; a scene is drawn with both its videos.
        resamples, seed: as in `bootstrap_interval`.

    Raises:
        ValueError: if the shapes differ or there is no video.
    """
    shapes = imagined_ND.shape, real_ND.shape
    if shapes[0] != shapes[1]:
        raise ValueError(f"need a real video for each imagined one, got {shapes[0]} and {shapes[1]}")
    kernels, N = _kernels(imagined_ND, real_ND), len(real_ND)
    value = polynomial_mmd(imagined_ND, real_ND)
    shares_SN = np.random.default_rng(seed).multinomial(N, np.full(N, 1 / N), size=resamples) / N
    found_S = _discrepancy(kernels, shares_SN, shares_SN)
    # A scene that is drawn twice is paired with itself, which adds to the biased value of every resample: the interval
    # is moved so that the resamples' mean lies on the value.
    low, high = np.quantile(found_S, QUANTILES) - found_S.mean() + value
    return Interval(value, max(0.0, min(float(low), value)), max(float(high), value), N)


def _kernels(x_ND: np.ndarray, y_MD: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = (np.asarray(a, dtype=np.float64) for a in (x_ND, y_MD))
    if x.ndim != 2 or y.ndim != 2 or x.shape[1] != y.shape[1] or 0 in (*x.shape, *y.shape):
        raise ValueError(f"need features (N, D) and (M, D), got {x.shape} and {y.shape}")
    D = x.shape[1]
    return (x @ x.T / D) ** 2, (y @ y.T / D) ** 2, (x @ y.T / D) ** 2


def _discrepancy(kernels: tuple[np.ndarray, ...], a_SN: np.ndarray, b_SM: np.ndarray) -> np.ndarray:
    """(S,) for S pairs of weightings of the two sets."""
    own, other, between = kernels

    def mean(a: np.ndarray, kernel: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("sn,nm,sm->s", a, kernel, b, optimize=True)

    found_S = mean(a_SN, own, a_SN) + mean(b_SM, other, b_SM) - 2 * mean(a_SN, between, b_SM)
    return 100 * np.maximum(found_S, 0.0)  # never below 0 but by rounding


@dataclass(frozen=True)
class VJepaFeatures:
    """The attentive probe of V-JEPA 2, or the mean of its tokens where a checkpoint has no probe."""

    name: str  # for tables
    model: Any  # `VJEPA2ForVideoClassification` or `VJEPA2Model`

    @torch.no_grad()
    def __call__(self, videos_NT3HW: Tensor) -> Tensor:
        """Features (N, D) of videos (N, T, 3, H, W) in 0..1, stretched to the model's length and size."""
        config = self.model.config
        moments = torch.linspace(0, videos_NT3HW.shape[1] - 1, config.frames_per_clip).round().long()
        frames = videos_NT3HW[:, moments].float().to(self.model.device)
        flat = F.interpolate(frames.flatten(0, 1), config.crop_size, mode="bicubic", antialias=True)
        mean, deviation = (flat.new_tensor(c).view(3, 1, 1) for c in (MEAN, DEVIATION))
        pixels = ((flat.clamp(0, 1) - mean) / deviation).unflatten(0, frames.shape[:2])
        probe = getattr(self.model, "pooler", None)
        encoder = self.model if probe is None else self.model.vjepa2
        # One at a time: a video is thousands of tokens.
        found = []
        for video in pixels:
            tokens_1ND = encoder(pixel_values_videos=video[None], skip_predictor=True).last_hidden_state
            found.append(tokens_1ND.mean(dim=1) if probe is None else probe(tokens_1ND))
        return torch.cat(found).cpu()


def load_vjepa(name_or_folder: str | Path = VJEPA) -> VJepaFeatures:
    """V-JEPA 2 from a folder, or by its hub id from the Hugging Face cache of this machine. Nothing is fetched.

    Raises:
        MetricUnavailable: if its weights are not there or not complete.
    """
    try:
        from transformers import AutoConfig, VJEPA2ForVideoClassification, VJEPA2Model
        from transformers.utils import logging
    except ImportError as error:
        raise MetricUnavailable(f"JEDi needs transformers >= 4.53, which has V-JEPA 2: {error}") from error

    name = str(name_or_folder)
    before = logging.get_verbosity()
    logging.set_verbosity_error()  # it would print the missing weights, which the error below names
    try:
        config = AutoConfig.from_pretrained(name, local_files_only=True)
        probed = VJEPA2ForVideoClassification.__name__ in (config.architectures or [])
        kind: Any = VJEPA2ForVideoClassification if probed else VJEPA2Model
        model, report = kind.from_pretrained(name, local_files_only=True, output_loading_info=True)
    except (OSError, ValueError, RuntimeError) as error:
        reason = str(error).split("\n")[0]
        raise MetricUnavailable(
            f"JEDi needs weights of V-JEPA 2 on this machine: `hf download {VJEPA}` fetches them (1.5 GB), "
            f"or give a folder: {reason}"
        ) from error
    finally:
        logging.set_verbosity(before)
    # transformers fills what is missing with random numbers.
    if wrong := [*report["missing_keys"], *report["mismatched_keys"]]:
        raise MetricUnavailable(f"{name} is not complete: {len(wrong)} weights are missing, as {wrong[0]}")
    return VJepaFeatures(f"V-JEPA 2, {Path(name).name}", model.float().eval().requires_grad_(False))
