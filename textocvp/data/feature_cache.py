"""Every frame of the training episodes encoded once: what stage 1 reads when its image encoder is frozen.

The cache is a folder of HDF5 files of a few episodes each, `features` (N, L, F) float16 with one frame a chunk: at the
published size 0.9 MB a frame. Every file remembers which weights and which episodes it was made from, and is refused
for others. Encoding goes on where it was killed, and several processes can share it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from textocvp.data.episodes import EpisodeFile
from textocvp.data.slot_cache import episodes_fingerprint
from textocvp.parsers.base import to_frames
from textocvp.parsers.dino import DinoEncoder

PART = 16  # episodes a file: what is lost at most when encoding is killed


class FeatureCacheError(ValueError):
    """A feature cache belongs to another encoder or other episodes, is not complete or damaged; says which."""


class FeatureCache:
    """The features of all frames of an episode file, on disk.

    Picklable, and safe to use after a fork: each process opens the files for itself.

    Args:
        encoder: whose features they are.
        episodes: of which they are.
        folder: filled by `encode_share`.

    Raises:
        FeatureCacheError: if a file is missing or damaged, or of another encoder or other episodes.
    """

    def __init__(self, encoder: DinoEncoder, episodes: EpisodeFile, folder: Path) -> None:
        self.paths = [_path(folder, first) for first in range(0, len(episodes), PART)]
        self._firsts = np.array([_frames(episodes, first).start for first in range(0, len(episodes), PART)])
        self._files: dict[int, h5py.File] = {}
        self._process = -1
        source = episodes_fingerprint(episodes)
        for number, path in enumerate(self.paths):
            if not path.exists():
                raise FeatureCacheError(f"{path} is missing: the cache is not complete")
            frames = _frames(episodes, number * PART)
            check_part(path, encoder.load().fingerprint, source, frames.stop - frames.start)

    def clips(self, starts: NDArray[np.int64], length: int, stride: int) -> NDArray[np.float16]:
        """Features (len(starts), S, L, F) of every `stride`-th of the `length` frames from each start on.

        Args:
            starts: numbers of frames in the episode file, from `EpisodeFile.random_starts`: no clip crosses episodes.
        """
        parts = np.searchsorted(self._firsts, starts, side="right") - 1
        rows = starts - self._firsts[parts]
        read = [
            self._open(int(part))["features"][row : row + length : stride]
            for part, row in zip(parts, rows, strict=True)
        ]
        return np.stack(read)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_files": {}, "_process": -1}

    def _open(self, part: int) -> h5py.File:
        # HDF5 handles must not be shared across a fork: two processes would move one file position.
        if self._process != os.getpid():
            self._files, self._process = {}, os.getpid()
        if part not in self._files:
            self._files[part] = h5py.File(self.paths[part], "r")
        return self._files[part]


def encode_share(
    encoder: DinoEncoder,
    episodes: EpisodeFile,
    folder: Path,
    process: int = 0,
    processes: int = 1,
    *,
    device: torch.device | str = "cpu",
    batch: int = 16,
) -> None:
    """Encode every `processes`-th part, from part number `process` on, unless it is there already.

    Args:
        batch: frames at once.

    Raises:
        DinoWeightsError: if the encoder's weights are missing.
        FeatureCacheError: if a part that is there is of another encoder or other episodes.
    """
    source, made_by = episodes_fingerprint(episodes), encoder.load().fingerprint
    folder.mkdir(parents=True, exist_ok=True)
    mine = range(0, len(episodes), PART)[process::processes]
    for first in tqdm(mine, desc=f"encoding {folder.name}", unit="part", disable=process > 0):
        path, frames = _path(folder, first), _frames(episodes, first)
        if path.exists():
            check_part(path, made_by, source, frames.stop - frames.start)
            continue
        unfinished = path.with_name(path.name + ".new")
        with h5py.File(unfinished, "w") as file:
            file.attrs["encoder"], file.attrs["episodes"] = made_by, source
            features_NLF = _encoded(encoder, episodes, range(first, first + PART), device, batch)
            file.create_dataset("features", data=features_NLF, chunks=(1, *features_NLF.shape[1:]))
        unfinished.replace(path)


def check_part(path: Path, encoder: str, source: str, frames: int) -> None:
    """Raise a FeatureCacheError unless the file holds so many frames' features of this encoder and these episodes."""
    try:
        with h5py.File(path, "r") as file:
            has = {name: str(file.attrs[name]) for name in ("encoder", "episodes")}
            count = len(file["features"])
    except (KeyError, OSError) as error:
        raise FeatureCacheError(f"{path} is no feature cache, or damaged: {error}") from error
    for what, wanted in (("encoder", encoder), ("episodes", source)):
        if has[what] != wanted:
            raise FeatureCacheError(
                f"{path} holds the features of another {what} ({has[what][:12]}, wanted {wanted[:12]}): delete the "
                "folder, or train into another one"
            )
    if count != frames:
        raise FeatureCacheError(f"{path} is damaged: features of {count} frames, there should be {frames}")


def _encoded(
    encoder: DinoEncoder, episodes: EpisodeFile, chosen: range, device: torch.device | str, batch: int
) -> NDArray[np.float16]:
    frames_NHW3 = np.concatenate(episodes.frames([index for index in chosen if index < len(episodes)]))
    found = [
        encoder(to_frames(frames_NHW3[None, i : i + batch], device)[0]).half().cpu().numpy()
        for i in range(0, len(frames_NHW3), batch)
    ]
    return np.concatenate(found)


def _path(folder: Path, first: int) -> Path:
    return folder / f"{first:06d}.h5"


def _frames(episodes: EpisodeFile, first: int) -> range:
    """The frames of the part that starts with episode `first`, numbered as in the file."""
    ends = np.cumsum(episodes.lengths)
    start = int(ends[first] - episodes.lengths[first])
    return range(start, int(ends[min(first + PART, len(episodes)) - 1]))
