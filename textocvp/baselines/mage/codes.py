"""Every frame as codes, computed once: the training data of MAGE's second stage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from textocvp.baselines.mage.vqvae import VQVAE
from textocvp.data.cache import FrameCache, weights_fingerprint
from textocvp.data.episodes import Episodes
from textocvp.parsers.base import to_frames


def cached_codes(
    model: VQVAE, episodes: Episodes, folder: Path, process: int = 0, processes: int = 1, *, batch: int = 2
) -> FrameCache:
    """The codes (h, w) uint16 of every frame; those that are not in `folder` yet are computed and written there.

    Args:
        process, processes: which share of the work is this process's.
        batch: episodes at once.

    Raises:
        CacheError: if `folder` is damaged, or holds the codes of another VQ-VAE or of other episodes.
    """

    @torch.no_grad()
    def compute(chosen: range) -> NDArray[np.uint16]:
        found = []
        for first in range(chosen.start, chosen.stop, batch):
            numbers = range(first, min(first + batch, chosen.stop))
            frames_NHW3 = np.concatenate([episodes.frames(number) for number in numbers])
            found.append(model.encode(to_frames(frames_NHW3[None], model.codebook.codes_KC.device)[0]))
        return torch.cat(found).cpu().numpy().astype(np.uint16)

    network = weights_fingerprint(model, model.config.encoder_fingerprint)
    return FrameCache(folder, episodes, network).fill(compute, process, processes)
