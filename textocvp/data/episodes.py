"""Reading episode files: whole episodes to look at, random clips to train on.

The files are written by ``python -m envs.collect``; this module knows their layout and nothing of the
simulator.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

FORMAT = "textocvp-episodes"
FORMAT_VERSION = 1


class EpisodeObject(NamedTuple):
    """One object of a scene. In a segmentation, object ``id`` has the label ``2 + id`` (0 is the table, 1 the
    arm)."""

    id: int
    kind: str
    color: str


@dataclass(frozen=True)
class Episode:
    """One episode of T frames."""

    frames: NDArray[np.uint8]
    """(T, H, W, 3), 0..255; frame 0 is seen before the robot moves."""
    segmentation: NDArray[np.uint8]
    """(T, H, W): 0 table, 1 arm, 2 + i object i."""
    instruction: str
    objects: tuple[EpisodeObject, ...]
    target: tuple[int, int]
    """Ids of the named block and of the named bowl."""
    success: bool
    """Whether the block ended up in the bowl, as the simulator judged."""
    seed: int


class EpisodeFile:
    """An episode file, open for reading.

    Usable as a context manager; picklable, and safe to use after a fork: each process opens the file for
    itself.

    Args:
        path: the HDF5 file.
        first: use only the first so many episodes, as if the file held no others.

    Raises:
        FileNotFoundError: when there is no such file.
        ValueError: when it is no episode file, is damaged, or is of another format version, or `first` is below 1.
    """

    def __init__(self, path: str | os.PathLike[str], first: int | None = None) -> None:
        if first is not None and first < 1:
            raise ValueError(f"first must be at least 1 episode, not {first}")
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._process = -1
        if not self.path.is_file():
            raise FileNotFoundError(
                f"there is no episode file {self.path}; collect one with: "
                f"python -m envs.collect --out {self.path}"
            )
        try:
            file = self._open()
            self._check_format(file)
            index = file["episode"]
            self._starts: NDArray[np.int64] = index["start"][:]
            self.lengths: NDArray[np.int64] = index["length"][:]
            """(E,) frames of each episode."""
            self.seeds: NDArray[np.int64] = index["seed"][:]
            """(E,) seeds, disjoint between splits."""
            self.success: NDArray[np.bool_] = index["success"][:]
            """(E,) whether the expert succeeded."""
            self.instructions: tuple[str, ...] = tuple(index["instruction"].asstr()[:])
            """The E instructions."""
            self.image_size = int(file["frames"].shape[1])
            """Height and width of the frames, in pixels."""
            self.split = str(file.attrs["split"])
            """Name of the split."""
            total = file["frames"].shape[0]
        except (OSError, KeyError) as error:
            self.close()
            raise ValueError(f"{self.path} is not an episode file, or is damaged: {error}") from error
        except ValueError:
            self.close()
            raise
        if total != int(self.lengths.sum()):
            self.close()
            raise ValueError(
                f"{self.path} is damaged: {total} frames, but its index tells {self.lengths.sum()}"
            )
        if first is not None:
            self._starts, self.lengths = self._starts[:first], self.lengths[:first]
            self.seeds, self.success = self.seeds[:first], self.success[:first]
            self.instructions = self.instructions[:first]

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    def __repr__(self) -> str:
        size = self.image_size
        return f"EpisodeFile({str(self.path)!r}: {len(self)} episodes of split {self.split!r}, {size}x{size})"

    def __iter__(self) -> Iterator[Episode]:
        return (self.episode(index) for index in range(len(self)))

    def episode(self, index: int) -> Episode:
        """Episode number ``index``; negative numbers count from the end.

        Raises:
            IndexError: when there is no such episode.
        """
        rows = self._rows(index)
        file = self._open()
        number = index % len(self)
        objects = json.loads(file["episode/objects"].asstr()[number])
        block, bowl = file["episode/target"][number].tolist()
        return Episode(
            frames=file["frames"][rows],
            segmentation=file["segmentation"][rows],
            instruction=self.instructions[number],
            objects=tuple(EpisodeObject(k, item["kind"], item["color"]) for k, item in enumerate(objects)),
            target=(block, bowl),
            success=bool(self.success[number]),
            seed=int(self.seeds[number]),
        )

    def frames(self, indices: Sequence[int] | NDArray[np.integer]) -> list[NDArray[np.uint8]]:
        """The frames of several episodes, each (T, H, W, 3); T may differ between them.

        Raises:
            IndexError: when there is no such episode.
        """
        return [self._open()["frames"][self._rows(int(index))] for index in indices]

    def random_clips(
        self, rng: np.random.Generator, count: int, length: int, rows: slice = slice(None)
    ) -> NDArray[np.uint8]:
        """Random clips (count, length, H, W, 3); every clip of the file is equally likely.

        Args:
            rng: the source of chance; the same state gives the same clips.
            count: how many, at least 1.
            length: frames of each, at least 1.
            rows: read only these of the `count` clips, for a process that computes a share of a batch.

        Raises:
            ValueError: when no episode is that long.
        """
        return self.clips(self.random_starts(rng, count, length)[rows], length)

    def random_starts(self, rng: np.random.Generator, count: int, length: int) -> NDArray[np.int64]:
        """Where random clips start: their first frames' numbers (count,) in the file; as `random_clips`."""
        if count < 1 or length < 1:
            raise ValueError(f"count and length must be at least 1, not {count} and {length}")
        # An episode of T frames has T - length + 1 clips.
        ends = np.cumsum(np.maximum(self.lengths - length + 1, 0))
        if len(self) == 0 or ends[-1] == 0:
            longest = int(self.lengths.max(initial=0))
            raise ValueError(f"no episode has {length} frames; the longest of {self.path} has {longest}")
        picks = rng.integers(ends[-1], size=count)
        episodes = np.searchsorted(ends, picks, side="right")
        offsets = picks - (ends[episodes] - np.maximum(self.lengths[episodes] - length + 1, 0))
        return self._starts[episodes] + offsets

    def clips(self, starts: NDArray[np.int64], length: int) -> NDArray[np.uint8]:
        """Clips (len(starts), length, H, W, 3) that start at these frames of the file."""
        clips = np.empty((len(starts), length, self.image_size, self.image_size, 3), dtype=np.uint8)
        dataset = self._open()["frames"]
        # In the file's order, so that clips of one chunk are read while it is cached.
        for place in np.argsort(starts):
            dataset.read_direct(clips, np.s_[starts[place] : starts[place] + length], np.s_[place])
        return clips

    def attribute(self, name: str) -> Any:
        """A file attribute, such as `camera_intrinsics` (3, 3), `camera_extrinsics` (4, 4), `config` or
        `versions`.

        Raises:
            KeyError: for an attribute the file does not have; the message lists those it has.
        """
        attributes = self._open().attrs
        if name not in attributes:
            raise KeyError(f"{self.path} has no attribute {name!r}; it has: {', '.join(sorted(attributes))}")
        return attributes[name]

    def close(self) -> None:
        """Close the file. A later read opens it again."""
        if self._file is not None and self._process == os.getpid():
            self._file.close()
        self._file = None

    def __enter__(self) -> EpisodeFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_file": None, "_process": -1}

    def _open(self) -> h5py.File:
        # HDF5 handles must not be shared across a fork: two processes would move one file position.
        if self._file is None or self._process != os.getpid():
            self._file, self._process = h5py.File(self.path, "r"), os.getpid()
        return self._file

    def _rows(self, index: int) -> slice:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path} has episodes 0 to {len(self) - 1}, not {index}")
        start = int(self._starts[index])
        return slice(start, start + int(self.lengths[index]))

    def _check_format(self, file: h5py.File) -> None:
        kind, version = file.attrs.get("format"), file.attrs.get("format_version")
        if kind != FORMAT:
            raise ValueError(f"{self.path} is an HDF5 file, but not an episode file")
        if version != FORMAT_VERSION:
            raise ValueError(
                f"{self.path} has format version {version}, and this program reads version {FORMAT_VERSION}; "
                "collect the episodes again with: python -m envs.collect"
            )
