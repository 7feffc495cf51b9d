"""How good masks and frames are, and how sure one can be of it. Nothing here is used to train anything.

Metrics that need weights of their own are in `perceptual` (LPIPS, ST-LPIPS) and `jedi`. Where weights are missing they
raise `MetricUnavailable`: nothing is computed with random ones.
"""

from textocvp.metrics.frames import psnr, ssim
from textocvp.metrics.intervals import Interval, bootstrap_interval, ratio_interval, relative_change, wilson_interval
from textocvp.metrics.masks import followed, foreground_ari, object_ious, overlaps, slot_labels
