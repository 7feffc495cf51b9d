"""CLIPort's own episodes, as a folder of npz files: one an episode, without pickled arrays (docs/data.md)."""

import json
import os
import warnings
import zipfile
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from textocvp.data.episodes import FIRST_OBJECT, ROBOT, Episode, EpisodeObject, Episodes, Truth, swapped_questions


class CliportEpisodes(Episodes):
    """The npz files of a folder in the order of their names, or one file.

    A file that cannot be used is left out, with a warning that names it and says why.

    Attributes:
        files: of the episodes.
        metas: what each file says of its episode, as `read_episode` gives it.
        problems: a line for each file that was left out.

    Raises:
        FileNotFoundError: when there is nothing at `path`.
        ValueError: when no file can be used, or `first` is below 1.
    """

    def __init__(self, path: str | os.PathLike[str], first: int | None = None) -> None:
        if first is not None and first < 1:
            raise ValueError(f"first must be at least 1 episode, not {first}")
        self.path = Path(path)
        if not self.path.exists():
            raise FileNotFoundError(f"there is no folder or file {self.path}")
        found = sorted(self.path.glob("*.npz")) if self.path.is_dir() else [self.path]
        usable: list[tuple[Path, dict[str, Any], tuple[int, ...]]] = []
        problems = []
        for file in found:
            try:
                arrays = read_episode(file)
            except ValueError as error:
                problems.append(str(error))
                continue
            usable.append((file, arrays["meta"], arrays["frames"].shape))
        sizes = Counter(shape[1] for _, _, shape in usable)
        self.image_size = max(sizes, key=lambda side: sizes[side], default=0)
        for file, _, (_, side, *_) in usable:
            if side != self.image_size:
                problems.append(f"{file}: frames of {side}x{side}, the others have {self.image_size}x{self.image_size}")
        kept = [one for one in usable if one[2][1] == self.image_size][:first]
        if not kept:
            why = f": {problems[0]}" if problems else ": no npz files"
            raise ValueError(f"{self.path} has no episode that can be used{why}")
        self.files = tuple(file for file, _, _ in kept)
        self.metas = tuple(meta for _, meta, _ in kept)
        self.instructions = tuple(meta["caption"] for meta in self.metas)
        self.lengths = np.array([shape[0] for _, _, shape in kept], np.int64)
        self.problems = tuple(problems)
        for problem in problems:
            warnings.warn(f"left out: {problem}", UserWarning, stacklevel=2)

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether it is an npz file or a folder with one."""
        return path.suffix == ".npz" or (path.is_dir() and any(path.glob("*.npz")))

    def frames(self, index: int) -> NDArray[np.uint8]:
        return read_episode(self.files[index])["frames"]

    def truth(self, index: int) -> Truth:
        """Masks, objects, poses and camera; the questions only where the sentence names one block and one bowl."""
        return _truth(read_episode(self.files[index]))

    def episode(self, index: int) -> Episode:
        arrays = read_episode(self.files[index])  # once, where `frames` and `truth` would read it twice
        known = vars(_truth(arrays))
        return Episode(frames=arrays["frames"], instruction=self.instructions[index], **known)


def _truth(arrays: dict[str, Any]) -> Truth:
    meta = arrays["meta"]
    pairs = enumerate(zip(meta["kinds"], meta["colors"], strict=True))
    objects = tuple(EpisodeObject(i, FIRST_OBJECT + i, kind, color) for i, (kind, color) in pairs)
    blocks, bowls = meta.get("named_blocks", ()), meta.get("named_bowls", ())
    one_pair = len(blocks) == len(bowls) == 1
    return Truth(
        segmentation=arrays["segmentation"],
        robot=ROBOT,
        objects=objects,
        questions=swapped_questions(meta["caption"], objects, blocks[0], bowls[0]) if one_pair else (),
        position=arrays["position"],
        intrinsics=arrays["intrinsics"],
        extrinsics=arrays["extrinsics"],
    )


def read_episode(file: Path) -> dict[str, Any]:
    """The arrays of an episode's file, checked, with `meta` as a dictionary. Pickled arrays are never loaded.

    Raises:
        ValueError: if it is damaged, lacks something, or does not hang together; the message names the file.
    """
    names = ("frames", "segmentation", "position", "intrinsics", "extrinsics", "meta")
    try:
        with np.load(file, allow_pickle=False) as stored:
            if lacking := [name for name in names if name not in stored.files]:
                raise ValueError(f"it has no {lacking[0]!r}")
            arrays: dict[str, Any] = {name: stored[name] for name in names}
        arrays["meta"] = meta = json.loads(str(arrays["meta"]))
        _check(arrays, meta)
    except (ValueError, KeyError, TypeError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).splitlines()[0]
        if "allow_pickle" in reason:
            reason = "it is no npz file, or holds pickled arrays, which are never loaded"
        raise ValueError(f"{file}: {reason}") from error
    return arrays


def _check(arrays: dict[str, Any], meta: dict[str, Any]) -> None:
    frames = arrays["frames"]
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3:
        raise ValueError(f"frames must be (T, H, H, 3) uint8, not {frames.shape} {frames.dtype}")
    T, H, W = frames.shape[:3]
    if T == 0:
        raise ValueError("it has no frames")
    if H != W:
        raise ValueError(f"frames must be square, not {H}x{W}")
    if not isinstance(meta["caption"], str) or not meta["caption"].strip():
        raise ValueError("it has no sentence")
    n = len(meta["kinds"])
    wanted = {"segmentation": (T, H, W), "position": (T, n, 3), "intrinsics": (3, 3), "extrinsics": (4, 4)}
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} must be {shape}, not {arrays[name].shape}")
    if len(meta["colors"]) != n:
        raise ValueError(f"{n} kinds, but {len(meta['colors'])} colors")
