"""How good masks and frames are, and how sure one can be of it. Nothing here is used to train anything.

Metrics that need weights of their own are imported from `textocvp.metrics.perceptual` (LPIPS, ST-LPIPS) and
`textocvp.metrics.jedi`. Where these weights are missing, they raise `MetricUnavailable` instead of guessing.
"""

from textocvp.metrics.frames import psnr, ssim
from textocvp.metrics.intervals import (
    Interval,
    bootstrap_interval,
    ratio_interval,
    relative_change,
    wilson_interval,
)
from textocvp.metrics.masks import followed, foreground_ari, object_ious, overlaps, slot_labels

__all__ = [
    "Interval",
    "bootstrap_interval",
    "followed",
    "foreground_ari",
    "object_ious",
    "overlaps",
    "psnr",
    "ratio_interval",
    "relative_change",
    "slot_labels",
    "ssim",
    "wilson_interval",
]
