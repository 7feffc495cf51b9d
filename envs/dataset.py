"""The data set: episodes, the HDF5 file that holds them (docs/data.md), and many processes that fill it."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from joblib import Parallel, delayed, parallel_config
from numpy.typing import NDArray
from tqdm import tqdm

from textocvp.files import hdf5_to_write, replacing

from .expert import Expert
from .factors import Factors
from .physics.camera import Camera
from .physics.simulation import LABELS
from .physics.ur5 import PACKAGE, find_package
from .scene import MAX_OBJECTS
from .scenes import Setup, make_setup
from .splits import SPLITS
from .tabletop import Observation, TabletopEnv
from .tasks import TASKS, Question
from .tasks.rearrange import Rearrange, Supports, with_supports

FORMAT = "textocvp-episodes"
FORMAT_VERSION = 2
NO_OBJECT = -3  # the support of an object that is not there
EPISODES_PER_PIECE = 50  # a kill costs each worker at most the piece it is at: a few seconds
EPISODES_PER_MERGE = 500

FRAMES_PER_CHUNK = 4  # a clip of 6 frames touches two or three; larger ones unpack more that is thrown away


Columns = dict[str, tuple[Any, Callable[[Any], Any]]]  # name -> type, and value of what `World.record` yields
Arrays = dict[str, tuple[tuple[int, ...], str, int, dict[str, Any]]]


class World:
    """What decides, beside the number, the content of an episode: `EpisodeConfig`, or another world's.

    A new world is a picklable frozen dataclass with these fields and methods, and adds itself to `envs.collect`.
    """

    split: str  # a name of `SPLITS`
    image_size: int  # height and width of frames, in pixels
    sentences: int = 1  # how many episodes in a row are made together

    @property
    def arrays(self) -> Arrays:
        """The data sets over frames: all of `ARRAYS`, or others like them."""
        return ARRAYS

    @property
    def columns(self) -> Columns:
        """The data sets over episodes."""
        raise NotImplementedError

    @property
    def attributes(self) -> dict[str, Any]:
        """Of the file, beside format, split and configuration."""
        raise NotImplementedError

    def to_json(self) -> str:
        """By which files are compared."""
        return json.dumps(asdict(self))  # type: ignore[call-overload]

    def make(self) -> Any:
        """What `record` needs, made once in every process."""
        raise NotImplementedError

    def record(self, env: Any, numbers: range) -> Iterator[Any]:
        """Episodes of the split, each with `arrays`; a function of the configuration and the numbers alone."""
        raise NotImplementedError


# -- One episode -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EpisodeConfig(World):
    """What, beside the seed, decides the content of an episode of the tabletop."""

    split: str
    scene: str = "simple"
    image_size: int = 64
    camera: str | None = None  # None, as for the next two and the factors: the scene's own
    sizes: str | None = None
    physics_hz: int | None = None
    factors: Factors | None = None
    object_scale: float = 1.0
    render_stride: int = 16
    policy: str = "expert"  # or "any-sentence"
    sentences: int = 1  # of each scene, with "any-sentence"; each is an episode

    @property
    def task(self) -> str:
        """The name of the task that is played."""
        return SPLITS[self.split].task if self.policy == "expert" else "rearrange_blocks"

    def make(self) -> TabletopEnv:
        """The environment that plays such episodes."""
        arguments = {field.name: getattr(self, field.name) for field in fields(self)}
        for name in ("split", "policy", "sentences"):
            del arguments[name]
        return TabletopEnv(self.task, record_frames=True, **arguments)

    def options(self, seed: int) -> dict[str, Any]:
        """The `reset` options of the scene with this seed."""
        split = SPLITS[self.split]
        if self.policy == "expert":
            return split.options(seed)
        arm = "random" if np.random.default_rng([seed, 2]).random() < split.moved_arm else "home"
        return {"n_objects": split.n_objects, "color_split": split.color_split, "arm_start": arm}

    @property
    def setup(self) -> Setup:
        """What is alike in all scenes."""
        return make_setup(self.scene, self.camera, self.sizes, self.factors, self.object_scale)

    def record(self, env: TabletopEnv, numbers: range) -> Iterator[RecordedEpisode]:
        """Play episodes in an environment of `make`, whatever it did before."""
        if self.policy == "expert":
            yield from (record_episode(env, self, number) for number in numbers)
            return
        many = self.sentences
        for scene in range(numbers.start // many, -(-numbers.stop // many)):
            for episode in record_sentences(env, self, scene):
                if scene * many + episode.sentence in numbers:
                    yield episode

    @property
    def columns(self) -> Columns:
        return _COLUMNS if self.policy == "expert" else _COLUMNS | _SENTENCE_COLUMNS

    @property
    def attributes(self) -> dict[str, Any]:
        setup, ur5 = self.setup, find_package()
        camera = Camera(setup.camera, self.image_size, setup.oversampling)
        return {
            "versions": json.dumps(
                versions("pybullet", "gymnasium", "numpy", "h5py") | {PACKAGE: ur5.version if ur5 else None}
            ),
            "vocabulary": json.dumps(TASKS[self.task].vocabulary),
            "labels": json.dumps(LABELS),
            "camera_intrinsics": camera.intrinsics,
            "camera_extrinsics": camera.extrinsics,
        }

    def to_json(self) -> str:
        values = asdict(self) | {"factors": asdict(self.setup.factors)}
        if self.policy == "expert":  # as in files that are older than other policies
            del values["policy"], values["sentences"]
        return json.dumps(values)


@dataclass(frozen=True)
class RecordedEpisode:
    """An episode of T frames; frame 0 is what `reset`, or the sentence before, left to see."""

    seed: int
    instruction: str
    objects: tuple[dict[str, Any], ...]  # by id; each with `id`, `label`, `kind` and `color`
    questions: tuple[Question, ...]
    success: bool
    factors: dict[str, Any]  # values of this scene's factors
    options: dict[str, Any]  # of `reset`
    arrays: dict[str, NDArray[Any]]  # over frames (T, ...), named as in the file, not padded for objects
    sentence: int = 0  # its number in its scene
    primitives: tuple[dict[str, Any], ...] = ()  # `frame` at which each begins, and `action`, as in the file
    supports: tuple[Supports, Supports] = ((), ())  # before and after it, by object, with "any-sentence"


def record_sentences(env: TabletopEnv, config: EpisodeConfig, scene: int) -> Iterator[RecordedEpisode]:
    """Play random sentences, sensible or not, one after the other in one scene of the split."""
    split, task, expert = SPLITS[config.split], env.task, Expert(env)
    assert isinstance(task, Rearrange)
    seed = split.seed(scene)
    rng, options = np.random.default_rng([seed, 2]), config.options(seed)
    rng.random()  # has decided where the arm starts
    _, info = env.reset(seed=seed, options=options)
    allowed, objects = task.sentences(env.scene.objects, split.color_split), env.scene.objects
    for sentence in range(config.sentences):
        pair = allowed[int(rng.integers(len(allowed)))]
        first, before = _last_frame(info), info["supports"]
        relation, action = task.relation(pair), expert.primitive(pair)
        was = relation.fulfilled(env.world, env.robot, pair)
        info = env.step(action)[4]
        success = relation.fulfilled(env.world, env.robot, pair)
        yield RecordedEpisode(
            seed=seed,
            instruction=task.scene(objects, (pair,)).instruction,
            objects=_named(info),
            questions=task.questions(with_supports(objects, before)),
            success=success,
            factors=info["factors"],
            options=options,
            arrays=_arrays([first, info], [float(success) - float(was)]),
            primitives=_primitives([first, info], [action]),
            sentence=sentence,
            supports=(before, info["supports"]),
        )


def record_episode(env: TabletopEnv, config: EpisodeConfig, episode: int) -> RecordedEpisode:
    """Let the expert play episode number ``episode`` of the split."""
    seed = SPLITS[config.split].seed(episode)
    options = config.options(seed)
    _, info = env.reset(seed=seed, options=options)
    infos, actions, rewards = [info], [], []
    for action in Expert(env).actions():
        _, reward, _, _, info = env.step(action)
        infos.append(info)
        actions.append(action)
        rewards.append(float(reward))
    return RecordedEpisode(
        seed=seed,
        instruction=info["instruction"],
        objects=_named(info),
        questions=env.task.questions(env.scene.objects),
        success=bool(infos[-1]["is_success"]),
        factors=info["factors"],
        options=options,
        arrays=_arrays(infos, rewards),
        primitives=_primitives(infos, actions),
    )


def scene_of(path: str | os.PathLike[str], index: int) -> tuple[TabletopEnv, Observation, dict[str, Any]]:
    """An environment in the state in which an episode of a collected file begins, and what `reset` gives there.

    Its first frame is the episode's, bit for bit. Where other sentences came before in the scene, they are played.

    Raises:
        IndexError: when the file has no such episode.
        ValueError: when `envs.collect` did not write it, or wrote another format version.
    """
    try:
        with h5py.File(path, "r") as file:
            if (file.attrs.get("format"), file.attrs.get("format_version")) != (FORMAT, FORMAT_VERSION):
                raise ValueError(f"{path} is no episode file of format version {FORMAT_VERSION}")
            rows, values = file["episode"], json.loads(file.attrs["config"])
            config = EpisodeConfig(**values | {"factors": Factors(**values["factors"])})
            count = len(rows["length"])
            if not -count <= index < count:
                raise IndexError(f"{path} has episodes 0 to {count - 1}, not {index}")
            seed = int(rows["seed"][index % count])
            sentence = int(rows["sentence"][index % count]) if "sentence" in rows else 0
            # Files of the first days have no options, but the same code drew them.
            stored = json.loads(rows["options"].asstr()[index % count]) if "options" in rows else config.options(seed)
    except (OSError, KeyError, TypeError) as error:
        raise ValueError(f"{path} was not written by envs.collect, or is damaged: {error}") from error
    env = config.make()
    observation, info = env.reset(seed=seed, options=stored)
    if sentence:
        scene = seed - SPLITS[config.split].first_seed
        list(islice(record_sentences(env, config, scene), sentence))
        observation, info = env._observe(), env._info()
    return env, observation, info


def _named(info: dict[str, Any]) -> tuple[dict[str, Any], ...]:
    """What does not change about the objects."""
    return tuple({key: item[key] for key in ("id", "label", "kind", "color")} for item in info["objects"])


def _arrays(infos: list[dict[str, Any]], rewards: list[float]) -> dict[str, NDArray[Any]]:
    """All frames of some steps, what they show, and what was done; `rewards` are of all steps but the first."""
    states = [each["frame_states"] for each in infos]
    arrays = {name: np.concatenate([state[name] for state in states]) for name in states[0]}
    # A frame has the motion that follows it, where the recorder has the one that led to it.
    arrays["action"] = np.concatenate([arrays.pop("motion")[1:], np.zeros((1, 5), np.float32)])
    arrays["reward"] = np.zeros(len(arrays["action"]), np.float32)
    arrays["reward"][_ends(infos)[1:] - 1] = rewards
    return {
        "frames": np.concatenate([each["frames"] for each in infos]),
        "segmentation": np.concatenate([each["frame_segmentations"] for each in infos]),
        **arrays,
    }


def _ends(infos: list[dict[str, Any]]) -> NDArray[np.int64]:
    """The number of the last frame of each step."""
    return np.cumsum([len(each["frames"]) for each in infos]) - 1


def _primitives(infos: list[dict[str, Any]], actions: list[NDArray[np.float32]]) -> tuple[dict[str, Any], ...]:
    """The primitives of an episode, each with the number of the frame before it moves."""
    pairs = zip(_ends(infos)[:-1].tolist(), actions, strict=True)
    return tuple({"frame": frame, "action": action.tolist()} for frame, action in pairs)


def _last_frame(info: dict[str, Any]) -> dict[str, Any]:
    """A step's last frame, as a step of its own."""
    return {
        "frames": info["frames"][-1:],
        "frame_segmentations": info["frame_segmentations"][-1:],
        "frame_states": {name: values[-1:] for name, values in info["frame_states"].items()},
    }


# -- The file ----------------------------------------------------------------------------------------------

SIDE = -1  # stands for the image size in the shapes below

# Flat colours pack so well that gzip at its fastest reads faster than lzf, at half the size (measured).
_IMAGE = {"compression": "gzip", "compression_opts": 1}
_POSE = {"compression": "lzf"}
# Name -> shape of a frame's value, type, frames in a chunk, compression.
ARRAYS: Arrays = {
    "frames": ((SIDE, SIDE, 3), "u1", FRAMES_PER_CHUNK, _IMAGE),
    "segmentation": ((SIDE, SIDE), "u1", FRAMES_PER_CHUNK, _IMAGE),
    "arm": ((6,), "f4", 256, {}),
    "gripper": ((5,), "f4", 256, {}),
    "action": ((5,), "f4", 256, {}),
    "reward": ((), "f4", 1024, {}),
    "object_position": ((MAX_OBJECTS, 3), "f4", 256, _POSE),
    "object_orientation": ((MAX_OBJECTS, 4), "f4", 256, _POSE),
}
TEXT = h5py.string_dtype()
# Name -> type and value of an episode; where it starts is known when it is written.
_COLUMNS: Columns = {
    "length": ("i8", lambda episode: len(episode.arrays["frames"])),
    "seed": ("i8", lambda episode: episode.seed),
    "instruction": (TEXT, lambda episode: episode.instruction),
    "objects": (TEXT, lambda episode: json.dumps(episode.objects)),
    "questions": (TEXT, lambda episode: json.dumps([each._asdict() for each in episode.questions])),
    "factors": (TEXT, lambda episode: json.dumps(episode.factors)),
    "options": (TEXT, lambda episode: json.dumps(episode.options)),
    "success": ("?", lambda episode: episode.success),
    "primitives": (TEXT, lambda episode: json.dumps(episode.primitives)),
}
_SUPPORTS = np.dtype(("i1", (MAX_OBJECTS,)))
# Those that files of "any-sentence" have besides.
_SENTENCE_COLUMNS: Columns = {
    "sentence": ("i8", lambda episode: episode.sentence),
    "supports_before": (_SUPPORTS, lambda episode: _padded_supports(episode.supports[0])),
    "supports_after": (_SUPPORTS, lambda episode: _padded_supports(episode.supports[1])),
}


def versions(*packages: str) -> dict[str, str | None]:
    """The versions of what made a file."""
    return {name: version(name) for name in packages}


def merge(path: Path, config: World, pieces: Iterable[Path], workshop: Path) -> None:
    """Append the files ``pieces`` to ``path`` (created if missing), which opens at any moment."""
    with replacing(path, workshop) as part:
        if exists := path.exists():
            shutil.copyfile(path, part)
        with hdf5_to_write(part, "r+" if exists else "w") as file:
            if not exists:
                _create(file, config)
            for piece in pieces:
                with h5py.File(piece, "r") as source:
                    names = [*config.arrays, *(f"episode/{name}" for name in config.columns)]
                    # A file that was begun before there were `options` or actions goes on without.
                    _append(file, {name: source[name][:] for name in names if name in file})


def episode_count(path: Path, config: World) -> int:
    """Number of episodes in a file; 0 when there is none.

    Raises:
        ValueError: when the file is no episode file, or is of another format version or configuration.
    """
    if not path.exists():
        return 0
    try:
        with h5py.File(path, "r") as file:
            kind, found = file.attrs.get("format"), file.attrs.get("config")
            number = file.attrs.get("format_version")
            count = int(file["episode/length"].shape[0]) if kind == FORMAT else 0
    except (OSError, KeyError) as error:
        hint = "move it away or choose another --out"
        raise ValueError(f"{path} is not an episode file ({error}); {hint}") from error
    if kind != FORMAT:
        problem = "is an HDF5 file but not an episode file"
    elif number != FORMAT_VERSION:
        problem = f"has format version {number}, and version {FORMAT_VERSION} cannot be appended to it"
    elif found != config.to_json():
        problem = f"was collected with {found}, which differs from {config.to_json()}"
    else:
        return count
    raise ValueError(f"{path} {problem}; choose another --out")


def _has_all_columns(path: Path, config: World) -> bool:
    """Whether a piece has what is written today; an older version may have left one."""
    with h5py.File(path, "r") as file:
        names = [*config.arrays, *(f"episode/{name}" for name in config.columns)]
        return all(name in file for name in names)


def _create(file: h5py.File, config: World) -> None:
    """Make all datasets, empty, and all attributes."""
    split = SPLITS[config.split]
    for name, (shape, dtype, chunk, compression) in config.arrays.items():
        shape = tuple(config.image_size if n == SIDE else n for n in shape)
        sizes = {"shape": (0, *shape), "maxshape": (None, *shape), "chunks": (chunk, *shape)}
        file.create_dataset(name, dtype=dtype, **sizes, **compression)
    for name, (dtype, _) in {"start": ("i8", None), **config.columns}.items():
        base, shape = (dtype.base, dtype.shape) if isinstance(dtype, np.dtype) else (dtype, ())
        file.create_dataset(f"episode/{name}", (0, *shape), base, maxshape=(None, *shape), chunks=(1024, *shape))
    file.attrs.update(
        format=FORMAT,
        format_version=FORMAT_VERSION,
        split=split.name,
        first_seed=split.first_seed,
        config=config.to_json(),
        **config.attributes,
    )


def _append(file: h5py.File, values: dict[str, NDArray[Any]]) -> None:
    lengths = values["episode/length"]
    start = len(file["frames"]) + np.cumsum(lengths) - lengths
    for name, rows in {**values, "episode/start": start}.items():
        count = len(file[name])
        file[name].resize(count + len(rows), axis=0)
        file[name][count:] = rows


def _padded(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Values of objects (T, n, d) become (T, MAX_OBJECTS, d), with NaN where there is no object."""
    if not name.startswith("object_"):
        return values
    return np.pad(values, ((0, 0), (0, MAX_OBJECTS - values.shape[1]), (0, 0)), constant_values=np.nan)


def _padded_supports(supports: Supports) -> tuple[int, ...]:
    return (*supports, *(NO_OBJECT,) * (MAX_OBJECTS - len(supports)))


# -- Many processes, one file ------------------------------------------------------------------------------


Backend = Literal["processes", "dask", "ray"]


def collect(
    config: World, episodes: int, out: Path, workers: int = 1, backend: Backend = "processes", *, fresh: bool = False
) -> None:
    """Bring the file ``out`` to at least ``episodes`` episodes of the split.

    Finished pieces wait in ``out``.parts until they are merged into ``out``, in order. Both steps are atomic,
    so a kill loses no finished piece and doubles none. With "dask" or "ray" a cluster makes the pieces (docs/scale.md);
    all its machines see the folder of ``out`` under the same path. With ``fresh`` the episodes that are there are
    thrown away first, whatever they were collected with.

    Raises:
        ValueError: when ``out`` exists and is something else, or was collected with another configuration; or when
            the backend is not installed.
    """
    with _only_collector(out), _joblib_backend(backend, workers):
        if fresh:
            _throw_away(out)
        _collect(config, episodes, out.absolute(), workers, backend)


def _throw_away(out: Path) -> None:
    """Delete an episode file and its pieces; a ValueError if it is something else."""
    if out.exists():
        try:
            with h5py.File(out, "r") as file:
                kind = file.attrs.get("format")
        except OSError:
            kind = None
        if kind != FORMAT:
            raise ValueError(f"{out} is no episode file, and is not thrown away: choose another --out")
    out.unlink(missing_ok=True)
    shutil.rmtree(out.with_name(out.name + ".parts"), ignore_errors=True)


@contextmanager
def _joblib_backend(backend: Backend, workers: int) -> Iterator[None]:
    """Let joblib use the cluster that the environment names (or a new one of ``workers`` processes here)."""
    try:
        if backend == "processes":
            cluster: Any = nullcontext()
        elif backend == "dask":
            from distributed import Client

            address = os.environ.get("DASK_SCHEDULER_ADDRESS")
            cluster = Client(address) if address else Client(n_workers=workers, threads_per_worker=1)
        else:
            import ray
            from ray.util.joblib import register_ray

            register_ray()
            cluster = ray.init(num_cpus=None if "RAY_ADDRESS" in os.environ else workers)
    except ModuleNotFoundError as error:
        raise ValueError(f"the backend {backend} is not installed: pip install 'textocvp[{backend}]'") from error
    with cluster, nullcontext() if backend == "processes" else parallel_config(backend):
        yield


@contextmanager
def _only_collector(out: Path) -> Iterator[None]:
    """Refuse a second collector of the same file, as a job queued twice starts; the lock ends with the process."""
    out.parent.mkdir(parents=True, exist_ok=True)
    path = out.with_name(f".{out.name}.lock")
    with open(path, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = os.path.samestat(os.fstat(lock.fileno()), path.stat())
        except (BlockingIOError, FileNotFoundError):
            mine = False
        if not mine:  # or it was unlinked by the collector that has just finished
            raise ValueError(f"{out} is being collected by another process: wait, or choose another --out")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _collect(config: World, episodes: int, out: Path, workers: int, backend: Backend) -> None:
    done = episode_count(out, config)
    parts = out.with_name(out.name + ".parts")
    step = max(1, EPISODES_PER_PIECE // config.sentences) * config.sentences  # whole scenes
    ranges = [(start, min(start + step, episodes)) for start in range(done, episodes, step)]
    pieces = [parts / f"{start:07d}-{stop:07d}.h5" for start, stop in ranges]
    waiting: list[Path] = []
    with tqdm(total=episodes, initial=min(done, episodes), unit="episode", desc=config.split) as progress:
        # Joblib gets results from Ray at the end only; the pieces are on the disk before.
        run = Parallel(n_jobs=workers, return_as="list" if backend == "ray" else "generator")
        spans = zip(ranges, pieces, strict=True)
        collector = os.getpid() if backend == "processes" else None
        jobs = (delayed(_collect_piece)(config, *span, piece, collector) for span, piece in spans)
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
def _environment(config: World, thread: int) -> Any:
    """What plays, one for each thread of a worker, whose PyBullet client is used again for each episode."""
    return config.make()


@cache
def _end_with(parent: int) -> None:
    """Let this worker process end soon after its collector has ended, however that did."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    if os.getpid() != parent:
        threading.Thread(target=watch, daemon=True).start()


def _collect_piece(config: World, start: int, stop: int, piece: Path, collector: int | None) -> None:
    if collector is not None:
        _end_with(collector)
    if episode_count(piece, config) == stop - start and _has_all_columns(piece, config):
        return
    env = _environment(config, threading.get_ident())
    episodes = list(config.record(env, range(start, stop)))
    values = {name: np.concatenate([_padded(name, e.arrays[name]) for e in episodes]) for name in config.arrays}
    for name, (dtype, value) in config.columns.items():
        values[f"episode/{name}"] = np.array([value(episode) for episode in episodes], dtype)
    with replacing(piece, piece.parent) as part, hdf5_to_write(part) as file:
        _create(file, config)
        _append(file, values)
