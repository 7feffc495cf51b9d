"""How much imagined frames look like the real ones, frame by frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from experiments.study.predictions import Prediction
from textocvp.metrics.frames import psnr, ssim
from textocvp.metrics.jedi import VJepaFeatures, load_vjepa
from textocvp.metrics.perceptual import MetricUnavailable, PerceptualDistance, load_lpips, load_st_lpips

#: The second view leaves out the lowest rows of the picture. The robot stands beyond the upper edge, and its arm
#: reaches this far down in fewer than one frame in a hundred: nearly nothing but still table, which is easy.
BOTTOM_ROWS = 10
#: Equal frames have an infinite PSNR, which no mean survives. 60 dB is a mean error of a quarter of a grey level.
PSNR_CAP = 60.0
#: Metric -> name in tables. Lower is better for the distances, which JEDi is one of.
PERCEPTUAL = {"lpips": "LPIPS", "st_lpips": "ST-LPIPS"}
METRICS = {"psnr": "PSNR", "ssim": "SSIM", **PERCEPTUAL, "jedi": "JEDi"}
UPPER = "_without_bottom_rows"


@lru_cache
def perceptual(metric: str) -> PerceptualDistance:
    """The distance of that name, made once a process.

    Raises:
        MetricUnavailable: if it cannot be had here.
    """
    return load_lpips() if metric == "lpips" else load_st_lpips()


@lru_cache
def video_features(name: str) -> VJepaFeatures:
    """V-JEPA, made once a process."""
    return load_vjepa(name)


@dataclass(frozen=True)
class Measures:
    """What is measured beside PSNR and SSIM."""

    perceptual: tuple[str, ...] = ()  # which of `PERCEPTUAL`
    jedi: str | None = None  # the V-JEPA of JEDi, or None
    jedi_lengths: tuple[int, ...] = ()  # how many frames are a video for it
    reasons: tuple[tuple[str, str], ...] = ()  # metric -> why it is absent

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics of single frames."""
        return ("psnr", "ssim", *self.perceptual)

    @property
    def main(self) -> str:
        """The metric by which cases are ranked: LPIPS, else ST-LPIPS, else SSIM."""
        return self.perceptual[0] if self.perceptual else "ssim"

    def badness(self, value: float) -> float:
        """A figure of `main`, so that more is worse."""
        return -value if self.main == "ssim" else value

    @property
    def absent(self) -> str:
        """Sentences for a report; empty if nothing is absent."""
        return " ".join(f"{METRICS[name]} is absent: {reason}." for name, reason in self.reasons)


def available_measures(
    wanted: Sequence[str] = tuple(PERCEPTUAL),
    jedi: str | None = None,
    jedi_lengths: tuple[int, ...] = (),
    without_jedi: str = "",
) -> Measures:
    """What can be measured on this machine.

    Args:
        wanted: of `PERCEPTUAL`.
        jedi: the V-JEPA that is wanted, or None. without_jedi: why none is.
    """
    reasons = {"jedi": without_jedi} if jedi is None and without_jedi else {}
    for metric in (*wanted, *(["jedi"] if jedi else [])):
        try:
            _ = video_features(jedi) if jedi and metric == "jedi" else perceptual(metric)
        except MetricUnavailable as error:
            reasons[metric] = str(error)
    found = tuple(metric for metric in wanted if metric not in reasons)
    order = [(metric, reasons[metric]) for metric in METRICS if metric in reasons]
    return Measures(found, None if "jedi" in reasons else jedi, jedi_lengths, tuple(order))


@dataclass(frozen=True, eq=False)
class FrameScores:
    """One prediction, measured."""

    method: str  # whose
    # metric -> (t,), one value for each frame after the first; the metrics of `Measures.metrics`, and the
    # same with the ending `UPPER` without the bottom rows, where they were asked for
    curves: Mapping[str, np.ndarray]
    features: Mapping[int, np.ndarray]  # length -> (D,) for JEDi


class Scorer:
    """Measures the predictions of one scene; what concerns the real frames is computed once.

    `real` are these (T + 1, 3, H, W) in 0..1, the first included; with `upper` also without the bottom rows.
    """

    def __init__(self, real: Tensor, measures: Measures, *, upper: bool) -> None:
        self.measures = measures
        rows = real.shape[-2]
        self._views = {"": rows, UPPER: rows - BOTTOM_ROWS} if upper else {"": rows}
        self._real = real[1:]
        self._real_features = {
            (metric, view): perceptual(metric).features(self._real[..., :height, :])
            for metric in measures.perceptual
            for view, height in self._views.items()
        }

    def score(self, prediction: Prediction) -> FrameScores:
        """All metrics of a prediction."""
        imagined = prediction.frames_T3HW[1:].float()
        t = len(imagined)
        curves: dict[str, np.ndarray] = {}
        for view, height in self._views.items():
            a, b = imagined[..., :height, :], self._real[:t, ..., :height, :]
            curves["psnr" + view] = psnr(a, b).clamp(max=PSNR_CAP).numpy()
            curves["ssim" + view] = ssim(a, b).numpy()
            for metric in self.measures.perceptual:
                distance = perceptual(metric)
                real = self._real_features[metric, view].first(t)
                curves[metric + view] = distance.compare(distance.features(a), real).numpy()
        return FrameScores(prediction.method, curves, self._features_by_length(imagined))

    def real_features(self) -> dict[int, np.ndarray]:
        """Those of the real frames for JEDi: length -> (D,)."""
        return self._features_by_length(self._real)

    @torch.no_grad()
    def _features_by_length(self, frames: Tensor) -> dict[int, np.ndarray]:
        if self.measures.jedi is None:
            return {}
        extract = video_features(self.measures.jedi)
        lengths = [length for length in self.measures.jedi_lengths if length <= len(frames)]
        return {length: extract(frames[None, :length])[0].numpy() for length in lengths}
