"""A contact sheet: what collected episodes look like, at a glance."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from envs.episode import EpisodeConfig, record_episode

COLUMNS = 9
PIXELS = 128
GAP = 4


def save_contact_sheet(config: EpisodeConfig, episodes: int, out: Path) -> None:
    """Write a PNG with one row for each episode: frames evenly spread from the first to the last."""
    env = config.make()
    try:
        rows = [contact_row(record_episode(env, config, number).frames) for number in range(episodes)]
    finally:
        env.close()
    out.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(out, np.concatenate(rows))


def contact_row(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`COLUMNS` frames of (T, H, W, 3), first and last among them, beside each other with a gap; small ones
    enlarged."""
    chosen = frames[np.linspace(0, len(frames) - 1, COLUMNS).round().astype(int)]
    factor = max(1, PIXELS // frames.shape[1])
    large = chosen.repeat(factor, axis=1).repeat(factor, axis=2)
    spaced = np.pad(large, ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255)
    return np.concatenate(list(spaced), axis=1)
