"""The data set: expert episodes, the HDF5 file that holds them (docs/data.md), and many processes that fill it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from tqdm import tqdm

from envs.expert import Expert
from envs.factors import Factors
from envs.physics.camera import Camera
from envs.physics.simulation import LABELS
from envs.physics.ur5 import PACKAGE, find_package
from envs.scene import MAX_OBJECTS
from envs.scenes import Setup, make_setup
from envs.splits import SPLITS
from envs.tabletop import TabletopEnv
from envs.tasks import TASKS, Question

FORMAT = "textocvp-episodes"
FORMAT_VERSION = 2

EPISODES_PER_PIECE = 50
"""A kill costs each worker at most the piece it is at: a few seconds."""

EPISODES_PER_MERGE = 500

FRAMES_PER_CHUNK = 4
"""A random clip of 6 frames touches two or three chunks; larger chunks unpack more that is thrown away."""


# -- One episode -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EpisodeConfig:
    """What, beside the seed, decides the content of an episode."""

    split: str
    scene: str = "simple"
    image_size: int = 64
    camera: str | None = None
    """None, as for the next two and the factors: the scene's own."""
    sizes: str | None = None
    physics_hz: int | None = None
    factors: Factors | None = None
    object_scale: float = 1.0
    render_stride: int = 16

    def make(self) -> TabletopEnv:
        """The environment that plays such episodes."""
        arguments = {field.name: getattr(self, field.name) for field in fields(self)}
        return TabletopEnv(SPLITS[arguments.pop("split")].task, record_frames=True, **arguments)

    @property
    def setup(self) -> Setup:
        """What is alike in all scenes."""
        return make_setup(self.scene, self.camera, self.sizes, self.factors, self.object_scale)


@dataclass(frozen=True)
class RecordedEpisode:
    """An expert's episode of T frames; frame 0 is what `reset` showed."""

    seed: int
    instruction: str
    objects: tuple[dict[str, Any], ...]
    """By id; each with `id`, `label`, `kind` and `color`."""
    questions: tuple[Question, ...]
    success: bool
    factors: dict[str, Any]
    """Values of this scene's factors."""
    arrays: dict[str, NDArray[Any]]
    """The arrays over frames (T, ...), named as in the file, without padding for objects."""


def record_episode(env: TabletopEnv, config: EpisodeConfig, episode: int) -> RecordedEpisode:
    """Let the expert play episode number ``episode`` of the split in an environment of `EpisodeConfig.make`.

    A function of the configuration and the number alone, whatever the environment did before.
    """
    split = SPLITS[config.split]
    seed = split.seed(episode)
    _, info = env.reset(seed=seed, options=split.options(seed))
    infos = [info]
    for action in Expert(env).actions():
        infos.append(env.step(action)[4])
    states = [each["frame_states"] for each in infos]
    return RecordedEpisode(
        seed=seed,
        instruction=info["instruction"],
        objects=tuple(
            {name: item[name] for name in ("id", "label", "kind", "color")} for item in info["objects"]
        ),
        questions=env.task.questions(env.scene.objects),
        success=bool(infos[-1]["is_success"]),
        factors=info["factors"],
        arrays={
            "frames": np.concatenate([each["frames"] for each in infos]),
            "segmentation": np.concatenate([each["frame_segmentations"] for each in infos]),
            **{name: np.concatenate([state[name] for state in states]) for name in states[0]},
        },
    )


# -- The file ----------------------------------------------------------------------------------------------

SIDE = -1
"""Stands for the image size in the shapes below."""

# Name -> shape of a frame's value, type, frames in a chunk, compression. Flat colours pack so well that gzip at
# its fastest reads faster than lzf, at half the size (measured).
_IMAGE = {"compression": "gzip", "compression_opts": 1}
_POSE = {"compression": "lzf"}
_ARRAYS: dict[str, tuple[tuple[int, ...], str, int, dict[str, Any]]] = {
    "frames": ((SIDE, SIDE, 3), "u1", FRAMES_PER_CHUNK, _IMAGE),
    "segmentation": ((SIDE, SIDE), "u1", FRAMES_PER_CHUNK, _IMAGE),
    "arm": ((6,), "f4", 256, {}),
    "gripper": ((5,), "f4", 256, {}),
    "object_position": ((MAX_OBJECTS, 3), "f4", 256, _POSE),
    "object_orientation": ((MAX_OBJECTS, 4), "f4", 256, _POSE),
}
_INDEX: dict[str, Any] = {
    "start": "i8",
    "length": "i8",
    "seed": "i8",
    "instruction": h5py.string_dtype(),
    "objects": h5py.string_dtype(),
    "questions": h5py.string_dtype(),
    "factors": h5py.string_dtype(),
    "success": "?",
}


def write_episodes(path: Path, config: EpisodeConfig, episodes: Sequence[RecordedEpisode]) -> None:
    """Write a complete file; it appears under its name only when it is whole."""
    with _atomically(path, path.parent) as part, h5py.File(part, "w") as file:
        _create(file, config)
        arrays = {
            name: np.concatenate([_padded(name, episode.arrays[name]) for episode in episodes])
            for name in _ARRAYS
        }
        _append(file, arrays, _index(episodes))


def merge(path: Path, config: EpisodeConfig, pieces: Iterable[Path], workshop: Path) -> None:
    """Append the files ``pieces`` to ``path`` (created if missing).

    The longer file is made in the folder ``workshop`` (on the same disk) and then takes the name, so ``path``
    opens at any moment, also after the process is killed.
    """
    with _atomically(path, workshop) as part:
        if path.exists():
            shutil.copyfile(path, part)
        with h5py.File(part, "a") as file:
            if "frames" not in file:
                _create(file, config)
            for piece in pieces:
                with h5py.File(piece, "r") as source:
                    arrays = {name: source[name][:] for name in _ARRAYS}
                    _append(file, arrays, {name: source["episode"][name][:] for name in _INDEX})


@contextmanager
def _atomically(path: Path, folder: Path) -> Iterator[Path]:
    """A file to write in ``folder``; it takes the name ``path`` when it is whole and on the disk."""
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f"{path.name}.{os.getpid()}.part"
    yield part
    with open(part, "rb") as file:
        os.fsync(file.fileno())
    part.replace(path)


def episode_count(path: Path, config: EpisodeConfig) -> int:
    """Number of episodes in a file; 0 when there is none.

    Raises:
        ValueError: when the file is not an episode file, is of another format version, or was collected with
            another configuration.
    """
    if not path.exists():
        return 0
    try:
        with h5py.File(path, "r") as file:
            kind, found = file.attrs.get("format"), file.attrs.get("config")
            number = file.attrs.get("format_version")
            count = int(file["episode/length"].shape[0]) if kind == FORMAT else 0
    except (OSError, KeyError) as error:
        raise ValueError(
            f"{path} is not an episode file ({error}); move it away or choose another --out"
        ) from error
    if kind != FORMAT:
        raise ValueError(f"{path} is an HDF5 file but not an episode file; choose another --out")
    if number != FORMAT_VERSION:
        raise ValueError(
            f"{path} has format version {number}, and version {FORMAT_VERSION} cannot be appended to it; "
            "choose another --out"
        )
    if found != _config_json(config):
        raise ValueError(
            f"{path} was collected with {found}, which differs from {_config_json(config)}; "
            "choose another --out"
        )
    return count


def _create(file: h5py.File, config: EpisodeConfig) -> None:
    """Make all datasets, empty, and all attributes."""
    split, setup = SPLITS[config.split], config.setup
    camera = Camera(setup.camera, config.image_size, setup.oversampling)
    for name, (shape, dtype, chunk, compression) in _ARRAYS.items():
        shape = tuple(config.image_size if n == SIDE else n for n in shape)
        file.create_dataset(
            name, (0, *shape), dtype, maxshape=(None, *shape), chunks=(chunk, *shape), **compression
        )
    for name, dtype in _INDEX.items():
        file.create_dataset(f"episode/{name}", (0,), dtype, maxshape=(None,), chunks=(1024,))
    versions = {name: version(name) for name in ("pybullet", "gymnasium", "numpy", "h5py")}
    ur5 = find_package()
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["split"] = split.name
    file.attrs["first_seed"] = split.first_seed
    file.attrs["config"] = _config_json(config)
    file.attrs["versions"] = json.dumps(versions | {PACKAGE: ur5.version if ur5 else None})
    file.attrs["vocabulary"] = json.dumps(TASKS[split.task].vocabulary)
    file.attrs["labels"] = json.dumps(LABELS)
    file.attrs["camera_intrinsics"] = camera.intrinsics
    file.attrs["camera_extrinsics"] = camera.extrinsics


def _append(file: h5py.File, arrays: dict[str, NDArray[Any]], index: dict[str, NDArray[Any]]) -> None:
    first = file["frames"].shape[0]
    start = first + np.cumsum(index["length"]) - index["length"]
    for name, values in arrays.items():
        _extend(file[name], values)
    for name, values in {**index, "start": start}.items():
        _extend(file["episode"][name], values)


def _extend(dataset: h5py.Dataset, values: NDArray[Any]) -> None:
    count = dataset.shape[0]
    dataset.resize(count + len(values), axis=0)
    dataset[count:] = values


def _padded(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Values of objects (T, n, d) become (T, MAX_OBJECTS, d), with NaN where there is no object."""
    if not name.startswith("object_"):
        return values
    full = np.full((len(values), MAX_OBJECTS, values.shape[2]), np.nan, dtype=np.float32)
    full[:, : values.shape[1]] = values
    return full


def _index(episodes: Sequence[RecordedEpisode]) -> dict[str, NDArray[Any]]:
    """The columns of `episode`, but for `start`."""

    def column(value: Callable[[RecordedEpisode], Any], dtype: Any = None) -> NDArray[Any]:
        return np.array([value(episode) for episode in episodes], dtype)

    return {
        "length": column(lambda e: len(e.arrays["frames"])),
        "seed": column(lambda e: e.seed),
        "instruction": column(lambda e: e.instruction, object),
        "objects": column(lambda e: json.dumps(e.objects), object),
        "questions": column(lambda e: json.dumps([q._asdict() for q in e.questions]), object),
        "factors": column(lambda e: json.dumps(e.factors), object),
        "success": column(lambda e: e.success),
    }


def _config_json(config: EpisodeConfig) -> str:
    return json.dumps(asdict(config) | {"factors": asdict(config.setup.factors)})


# -- Many processes, one file ------------------------------------------------------------------------------


def collect(config: EpisodeConfig, episodes: int, out: Path, workers: int = 1) -> None:
    """Bring the file ``out`` to at least ``episodes`` episodes of the split.

    Finished pieces of 50 episodes wait in ``out``.parts until they are merged into ``out``, in order; both
    steps are atomic, so a kill loses no finished piece and doubles none.

    Raises:
        ValueError: when ``out`` exists and is something else, or was collected with another configuration.
    """
    done = episode_count(out, config)
    parts = out.with_name(out.name + ".parts")
    ranges = [
        (start, min(start + EPISODES_PER_PIECE, episodes))
        for start in range(done, episodes, EPISODES_PER_PIECE)
    ]
    pieces = [parts / f"{start:07d}-{stop:07d}.h5" for start, stop in ranges]
    waiting: list[Path] = []
    with tqdm(total=episodes, initial=min(done, episodes), unit="episode", desc=config.split) as progress:
        run = Parallel(n_jobs=workers, return_as="generator", pre_dispatch=2 * workers)
        jobs = (
            delayed(_collect_piece)(config, *span, piece) for span, piece in zip(ranges, pieces, strict=True)
        )
        for (start, stop), piece, _ in zip(ranges, pieces, run(jobs), strict=True):
            progress.update(stop - start)
            waiting.append(piece)
            # At least doubling bounds the copying by the size of the final file.
            if stop == episodes or stop - done >= max(EPISODES_PER_MERGE, done):
                merge(out, config, waiting, workshop=parts)
                for merged in waiting:
                    merged.unlink()
                waiting, done = [], stop
    # Only leftovers of killed processes remain.
    shutil.rmtree(parts, ignore_errors=True)


@cache
def _environment(config: EpisodeConfig) -> TabletopEnv:
    """One environment for each worker process, whose PyBullet client is used again for each episode."""
    return config.make()


def _collect_piece(config: EpisodeConfig, start: int, stop: int, piece: Path) -> None:
    if episode_count(piece, config) == stop - start:
        return
    env = _environment(config)
    write_episodes(piece, config, [record_episode(env, config, number) for number in range(start, stop)])
