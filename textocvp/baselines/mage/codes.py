"""Every episode as codes, computed once: the training data of MAGE's second stage.

The cache is one HDF5 file: `codes` (N, h, w) uint16, all frames of all episodes one after another; `starts` (E + 1)
where each episode begins. It remembers which VQ-VAE and which episodes it was made from, and is refused for others.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from textocvp.baselines.mage.vqvae import VQVAE
from textocvp.data.episodes import EpisodeFile
from textocvp.data.slot_cache import SlotCacheError, episodes_fingerprint
from textocvp.parsers.base import to_frames


class CodeCacheError(SlotCacheError):
    """A code cache belongs to another VQ-VAE or other episodes, or is damaged; the message says which."""


@dataclass
class CodeCache:
    """A code cache in memory.

    Attributes:
        codes_Nhw: uint16.
        starts: (E + 1,) first frame of each episode, and N.
    """

    codes_Nhw: np.ndarray
    starts: np.ndarray

    def __len__(self) -> int:
        return len(self.starts) - 1

    def clips(self, episodes_B: np.ndarray, times_T: np.ndarray) -> Tensor:
        """Codes (B, T, h, w) int64 of these times of these episodes; after its end an episode stays as it is."""
        lengths_B = (self.starts[1:] - self.starts[:-1])[episodes_B]
        within_BT = np.minimum(times_T, lengths_B[:, None] - 1)
        rows_BT = self.starts[episodes_B][:, None] + within_BT
        return torch.from_numpy(self.codes_Nhw[rows_BT].astype(np.int64))


def vqvae_fingerprint(model: VQVAE) -> str:
    """A hash of the weights, those of a frozen encoder included."""
    digest = hashlib.sha256(model.config.encoder_fingerprint.encode())
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def cached_codes(model: VQVAE, episodes: EpisodeFile, path: Path, *, batch: int = 2) -> CodeCache:
    """The codes of all episodes: read from `path` if they are there, else computed and written there.

    Raises:
        CodeCacheError: if `path` is damaged, or holds the codes of another VQ-VAE or of other episodes.
    """
    made_from = {"vqvae": vqvae_fingerprint(model), "episodes": episodes_fingerprint(episodes)}
    if path.exists():
        return _read(path, made_from)
    device, grid = model.codebook.codes_KC.device, model.config.grid
    starts = np.concatenate([[0], np.cumsum(episodes.lengths)])
    cache = CodeCache(np.empty((starts[-1], grid, grid), np.uint16), starts)
    with tqdm(total=len(episodes), desc=f"encoding {path.stem}", unit="episode") as bar, torch.no_grad():
        for first in range(0, len(episodes), batch):
            numbers = range(first, min(first + batch, len(episodes)))
            frames = np.concatenate(episodes.frames(numbers))
            found_Nhw = model.encode(to_frames(frames[None], device)[0]).cpu().numpy()
            cache.codes_Nhw[starts[numbers[0]] : starts[numbers[-1] + 1]] = found_Nhw
            bar.update(len(numbers))
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".new")
    with h5py.File(unfinished, "w") as file:
        file.create_dataset(
            "codes", data=cache.codes_Nhw, chunks=(min(256, len(cache.codes_Nhw)), grid, grid)
        )
        file["starts"] = starts
        file.attrs.update(made_from)
    unfinished.replace(path)  # killed at any moment, either the whole file is there or none
    return cache


def _read(path: Path, made_from: dict[str, str]) -> CodeCache:
    try:
        with h5py.File(path, "r") as file:
            found = {name: str(file.attrs[name]) for name in made_from}
            cache = CodeCache(file["codes"][:], file["starts"][:])
    except (KeyError, OSError) as error:
        raise CodeCacheError(f"{path} is no code cache, or damaged: {error}") from error
    for what, wanted in made_from.items():
        if found[what] != wanted:
            raise CodeCacheError(
                f"{path} holds the codes of other {what} ({found[what][:12]}, wanted {wanted[:12]}): delete it, or "
                "train into another folder"
            )
    return cache
