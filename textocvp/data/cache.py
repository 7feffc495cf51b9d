"""What frozen networks make of every frame, computed once: slots, features of image encoders, codes.

A cache is a folder of HDF5 files of a few episodes each: `values` (N, ...), one row a frame. A file is refused for
another network or other episodes than it was made from. Computing goes on where it was killed.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from tqdm import tqdm

from textocvp.data.episodes import Episodes
from textocvp.files import replacing
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.parsers.frozen import FrozenEncoder

PART = 16  # episodes a file: what is lost at most when computing is killed
CHUNK = 1 << 20  # bytes that are read at once, or one frame where that is more


class CacheError(ValueError):
    """A cache belongs to another network or other episodes, is incomplete or damaged; the message says which."""


class FrameCache:
    """One value for each frame of some episodes, on disk. Picklable, and safe to use after a fork: no file stays open.

    Args:
        folder: where the files are; `fill` makes those that are missing.
        episodes: whose frames they are.
        network: fingerprint of what computes the values.

    Raises:
        CacheError: if a file is damaged, or was made by another network or from other episodes.
    """

    def __init__(self, folder: Path, episodes: Episodes, network: str) -> None:
        self.folder, self.instructions = folder, episodes.instructions
        self.lengths, self.starts = episodes.lengths, episodes.starts
        self._made_from = {"network": network, "episodes": episodes.fingerprint}
        self._firsts = range(0, len(episodes), PART)
        for first in self._firsts:
            if self._path(first).exists():
                self._check(first)

    def fill(self, compute: Callable[[range], NDArray[Any]], process: int = 0, processes: int = 1) -> FrameCache:
        """Compute every `processes`-th part, from part number `process` on, unless it is there already.

        Args:
            compute: gives the values (N, ...) of all frames of these episodes, one episode after another.

        Returns:
            itself.
        """
        mine = [first for first in self._firsts[process::processes] if not self._path(first).exists()]
        if mine:
            self.folder.mkdir(parents=True, exist_ok=True)
        for first in tqdm(mine, desc=f"computing {self.folder.name}", unit="part", disable=process > 0):
            values = compute(range(first, min(first + PART, len(self))))
            # HDF5 crashes on a full disk: it writes to memory.
            with h5py.File(content := io.BytesIO(), "w") as file:
                file.attrs.update(self._made_from)
                rows = max(1, min(len(values), CHUNK // max(1, values[0].nbytes)))
                file.create_dataset("values", data=values, chunks=(rows, *values.shape[1:]))
            with replacing(self._path(first)) as new:
                new.write_bytes(content.getbuffer())
        return self

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    @cached_property
    def values(self) -> NDArray[Any]:
        """The values (N, ...) of all frames, in memory; a CacheError if a part is missing."""
        return np.concatenate([self._read(first, slice(None)) for first in self._firsts])

    def episode(self, index: int) -> NDArray[Any]:
        """The values (T, ...) of one episode, in memory."""
        return self.values[self.starts[index] : self.starts[index] + self.lengths[index]]

    def at(self, episodes_B: NDArray[np.int64], times_T: NDArray[np.int64]) -> NDArray[Any]:
        """The values (B, T, ...) of these times of these episodes, in memory; ended, an episode stays as it is."""
        within_BT = np.minimum(times_T, self.lengths[episodes_B][:, None] - 1)
        return self.values[self.starts[episodes_B][:, None] + within_BT]

    def clips(self, starts: NDArray[np.int64], length: int, stride: int = 1) -> NDArray[Any]:
        """The values (len(starts), S, ...) of every `stride`-th of the `length` frames from each start on, from disk.

        Args:
            starts: from `Episodes.random_starts`: no clip crosses episodes.

        Raises:
            CacheError: if a part is missing.
        """
        edges = self.starts[::PART]
        parts = np.searchsorted(edges, starts, side="right") - 1
        pairs = zip(parts, starts - edges[parts], strict=True)
        return np.stack([self._read(self._firsts[part], slice(at, at + length, stride)) for part, at in pairs])

    def _path(self, first: int) -> Path:
        return self.folder / f"{first:06d}.h5"

    def _check(self, first: int) -> None:
        path, frames = self._path(first), int(self.lengths[first : first + PART].sum())
        try:
            with h5py.File(path, "r") as file:
                found = {name: str(file.attrs[name]) for name in self._made_from}
                count = len(file["values"])
        except (KeyError, OSError) as error:
            raise CacheError(f"{path} is no cache, or damaged: {error}") from error
        for name, other in (("network", "by another network"), ("episodes", "from other episodes")):
            if found[name] != self._made_from[name]:
                raise CacheError(
                    f"{path} was made {other} ({found[name][:12]}, wanted {self._made_from[name][:12]}): delete "
                    f"{self.folder}, or train into another folder"
                )
        if count != frames:
            raise CacheError(f"{path} is damaged: values of {count} frames, there should be {frames}")

    def _read(self, first: int, rows: slice) -> NDArray[Any]:
        try:
            with h5py.File(self._path(first), "r") as file:
                return file["values"][rows]
        except FileNotFoundError:
            raise CacheError(f"{self._path(first)} is missing: the cache is not complete") from None


def weights_fingerprint(module: nn.Module, *also: str) -> str:
    """A hash of a module's weights, and of what else decides its output."""
    digest = hashlib.sha256("\n".join(also).encode())
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def parser_fingerprint(model: TextOCVP) -> str:
    """A hash of the parser's configuration and weights."""
    # Of a frozen encoder the configuration has the fingerprint; where its weights lie changes nothing.
    settings = {k: v for k, v in model.config.to_dict()["parser"].items() if k != "encoder_weights"}
    return weights_fingerprint(model.parser, json.dumps(settings, sort_keys=True))


def cached_slots(
    model: TextOCVP, episodes: Episodes, folder: Path, process: int = 0, processes: int = 1, *, every: int = 1
) -> FrameCache:
    """The slots (K, D) float16 of every frame; this process's share of those that `folder` lacks is computed.

    Args:
        every: parse an episode's first and last frame, and between them only every so many-th. The others get the
            slots of the last one that was parsed before them.

    Raises:
        CacheError: if `folder` holds the slots of another parser or of other episodes.
    """

    @torch.no_grad()
    def compute(chosen: range) -> NDArray[np.float16]:
        clips = [episodes.frames(index) for index in chosen]
        lengths = [len(clip) for clip in clips]
        times = [np.union1d(0, np.arange(length - 1, 0, -every)) for length in lengths]
        clips = [clip[parsed] for clip, parsed in zip(clips, times, strict=True)]
        longest = max(map(len, clips))
        # Parsing is causal: repeating the last frame of the shorter episodes changes nothing before it.
        padded = np.stack([clip[np.minimum(np.arange(longest), len(clip) - 1)] for clip in clips])
        # Initialisers that draw at random draw the same again for the same episodes.
        generator = torch.Generator(model.device).manual_seed(chosen.start)
        slots_BTKD = model.parser(to_frames(padded, model.device), generator=generator).slots_BTKD
        found = slots_BTKD.half().cpu().numpy()
        # From each frame on that was parsed its slots hold, until the next one was.
        held = [np.diff(parsed, append=length) for parsed, length in zip(times, lengths, strict=True)]
        return np.concatenate(
            [slots_TKD[: len(count)].repeat(count, 0) for slots_TKD, count in zip(found, held, strict=True)]
        )

    made_by = parser_fingerprint(model) + (f", every {every} frames" if every > 1 else "")
    return FrameCache(folder, episodes, made_by).fill(compute, process, processes)


def cached_features(
    encoder: FrozenEncoder,
    episodes: Episodes,
    folder: Path,
    process: int = 0,
    processes: int = 1,
    *,
    device: torch.device | str = "cpu",
) -> FrameCache:
    """The features (L, F) float16 of every frame, 0.9 MB each at the published size; shared out as `cached_slots`.

    Raises:
        WeightsError: if the encoder's weights are missing.
        CacheError: if `folder` holds features of another encoder or of other episodes.
    """

    def compute(chosen: range) -> NDArray[np.float16]:
        frames_NHW3 = np.concatenate([episodes.frames(index) for index in chosen])
        found = [
            encoder(to_frames(frames_NHW3[None, i : i + 16], device)[0]).half().cpu().numpy()
            for i in range(0, len(frames_NHW3), 16)  # what fits the memory
        ]
        return np.concatenate(found)

    return FrameCache(folder, episodes, encoder.load().identity).fill(compute, process, processes)
