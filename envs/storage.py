"""The episode file: packed arrays over all frames, and an index of episodes. `textocvp.episodes` reads it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from envs.camera import PRESETS, Camera
from envs.episode import EpisodeConfig, RecordedEpisode
from envs.scene import MAX_OBJECTS
from envs.splits import SPLITS

FORMAT = "textocvp-episodes"
FORMAT_VERSION = 1

FRAMES_PER_CHUNK = 4
"""A random clip of 6 frames touches two or three chunks; larger chunks unpack more that is thrown away."""


def write_episodes(path: Path, config: EpisodeConfig, episodes: Sequence[RecordedEpisode]) -> None:
    """Write a complete file; it appears under its name only when it is whole."""
    part = _part(path, path.parent)
    with h5py.File(part, "w") as file:
        _create(file, config)
        _append(file, {name: _column(name, episodes) for name in _FRAME_FIELDS}, _index(episodes))
    _publish(part, path)


def merge(path: Path, config: EpisodeConfig, pieces: Iterable[Path], workshop: Path) -> None:
    """Append the files ``pieces`` to ``path`` (created if missing).

    The longer file is made in the folder ``workshop`` (on the same disk) and then takes the name, so ``path``
    opens at any moment, also after the process is killed.
    """
    part = _part(path, workshop)
    if path.exists():
        shutil.copyfile(path, part)
    with h5py.File(part, "a") as file:
        if "frames" not in file:
            _create(file, config)
        for piece in pieces:
            with h5py.File(piece, "r") as source:
                frames = {name: source[name][:] for name in _FRAME_FIELDS}
                _append(file, frames, {name: source["episode"][name][:] for name in _EPISODE_FIELDS})
    _publish(part, path)


def episode_count(path: Path, config: EpisodeConfig) -> int:
    """Number of episodes in a file; 0 when there is none.

    Raises:
        ValueError: when the file is not an episode file or was collected with another configuration.
    """
    if not path.exists():
        return 0
    try:
        with h5py.File(path, "r") as file:
            kind, found = file.attrs.get("format"), file.attrs.get("config")
            count = int(file["episode/length"].shape[0]) if kind == FORMAT else 0
    except (OSError, KeyError) as error:
        raise ValueError(
            f"{path} is not an episode file ({error}); move it away or choose another --out"
        ) from error
    if kind != FORMAT:
        raise ValueError(f"{path} is an HDF5 file but not an episode file; choose another --out")
    if found != _config_json(config):
        raise ValueError(
            f"{path} was collected with {found}, which differs from {_config_json(config)}; "
            "choose another --out"
        )
    return count


# Name in the file -> attribute of RecordedEpisode, shape after the frame axis, type.
_FRAME_FIELDS: dict[str, str] = {
    "frames": "frames",
    "segmentation": "segmentation",
    "arm": "arm",
    "gripper": "gripper",
    "object_position": "position",
    "object_orientation": "orientation",
}
_EPISODE_FIELDS = ("length", "seed", "instruction", "objects", "target", "success")


def _create(file: h5py.File, config: EpisodeConfig) -> None:
    size = config.image_size
    # Flat colours pack so well that gzip at its fastest reads faster than lzf, at half the size (measured).
    images = {"compression": "gzip", "compression_opts": 1}
    _dataset(file, "frames", (size, size, 3), "u1", FRAMES_PER_CHUNK, images)
    _dataset(file, "segmentation", (size, size), "u1", FRAMES_PER_CHUNK, images)
    _dataset(file, "arm", (6,), "f4", 256)
    _dataset(file, "gripper", (5,), "f4", 256)
    _dataset(file, "object_position", (MAX_OBJECTS, 3), "f4", 256, {"compression": "lzf"})
    _dataset(file, "object_orientation", (MAX_OBJECTS, 4), "f4", 256, {"compression": "lzf"})
    index = file.create_group("episode")
    _dataset(index, "start", (), "i8", 1024)
    _dataset(index, "length", (), "i8", 1024)
    _dataset(index, "seed", (), "i8", 1024)
    _dataset(index, "instruction", (), h5py.string_dtype(), 1024)
    _dataset(index, "objects", (), h5py.string_dtype(), 1024)
    _dataset(index, "target", (2,), "i8", 1024)
    _dataset(index, "success", (), "?", 1024)
    camera = Camera(PRESETS[config.camera], size)
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["split"] = config.split
    file.attrs["first_seed"] = SPLITS[config.split].first_seed
    file.attrs["config"] = _config_json(config)
    file.attrs["camera_intrinsics"] = camera.intrinsics
    file.attrs["camera_extrinsics"] = camera.extrinsics
    file.attrs["versions"] = json.dumps(
        {name: version(name) for name in ("pybullet", "gymnasium", "numpy", "h5py")}
    )


def _dataset(
    group: h5py.Group,
    name: str,
    shape: tuple[int, ...],
    dtype: Any,
    chunk: int,
    more: dict[str, Any] | None = None,
) -> None:
    group.create_dataset(
        name, shape=(0, *shape), maxshape=(None, *shape), dtype=dtype, chunks=(chunk, *shape), **(more or {})
    )


def _append(file: h5py.File, frames: dict[str, NDArray[Any]], index: dict[str, NDArray[Any]]) -> None:
    first = file["frames"].shape[0]
    for name, values in frames.items():
        _extend(file[name], values)
    start = first + np.cumsum(index["length"]) - index["length"]
    for name, values in {**index, "start": start}.items():
        _extend(file["episode"][name], values)


def _extend(dataset: h5py.Dataset, values: NDArray[Any]) -> None:
    count = dataset.shape[0]
    dataset.resize(count + len(values), axis=0)
    dataset[count:] = values


def _column(name: str, episodes: Sequence[RecordedEpisode]) -> NDArray[Any]:
    parts = [getattr(episode, _FRAME_FIELDS[name]) for episode in episodes]
    if name.startswith("object_"):
        parts = [_padded(part) for part in parts]
    return np.concatenate(parts)


def _padded(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(T, n, d) -> (T, MAX_OBJECTS, d), with NaN where there is no object."""
    full = np.full((len(values), MAX_OBJECTS, values.shape[2]), np.nan, dtype=np.float32)
    full[:, : values.shape[1]] = values
    return full


def _index(episodes: Sequence[RecordedEpisode]) -> dict[str, NDArray[Any]]:
    return {
        "length": np.array([len(episode.frames) for episode in episodes]),
        "seed": np.array([episode.seed for episode in episodes]),
        "instruction": np.array([episode.instruction for episode in episodes], dtype=object),
        "objects": np.array([_objects_json(episode) for episode in episodes], dtype=object),
        "target": np.array([episode.target for episode in episodes]),
        "success": np.array([episode.success for episode in episodes]),
    }


def _objects_json(episode: RecordedEpisode) -> str:
    return json.dumps([{"kind": kind, "color": color} for kind, color in episode.objects])


def _config_json(config: EpisodeConfig) -> str:
    return json.dumps(asdict(config))


def _part(path: Path, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{path.name}.{os.getpid()}.part"


def _publish(part: Path, path: Path) -> None:
    with open(part, "rb") as file:
        os.fsync(file.fileno())
    part.replace(path)
