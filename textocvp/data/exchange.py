"""Episode files from and to the data sets of other projects: LeRobot, Minari, CLIPort's npz files (docs/data.md).

LeRobot's layout is written and read with pyarrow, so that frames stay what they are (PNG inside parquet) and none of
its dependencies is needed. Minari's own library writes and reads its sets, without its JPEG encoding.
"""

import errno
import io
import json
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from textocvp.data.cater import CaterEpisodes
from textocvp.data.cliport import CliportEpisodes
from textocvp.data.episodes import Episode, EpisodeFile, Episodes
from textocvp.data.own_videos import Imported, OwnVideosError, import_videos, too_long, video_frames, write_episodes
from textocvp.pictures import bring_to_size

Target = Literal["lerobot", "minari"]
CAMERA = "observation.images.rgb"
OURS = "textocvp/"  # columns of LeRobot's table of episodes that only this program reads
FILE_BYTES = 100 << 20  # of a data file, as LeRobot's own
MINARI_NAME = re.compile(r"[-\w.]+-v\d+")
_INDEX = {"timestamp": "float32", **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")}


def kind_of(source: Path) -> str:
    """What a source to import is: "cater", "lerobot", "minari", "npz" or "videos".

    Raises:
        OwnVideosError: if there is nothing, or it is a set that is not read; it says the way around.
    """
    if CaterEpisodes.detect(source):  # a list may be named without its ending
        return "cater"
    if not source.exists():
        raise OwnVideosError(f"there is no folder {source}")
    if (source / "meta/info.json").is_file():
        return "lerobot"
    if _minari_data(source) is not None:
        return "minari"
    if CliportEpisodes.detect(source):
        return "npz"
    if next(source.rglob("*.tfrecord*"), None) is not None:
        raise OwnVideosError(
            f"{source} holds TFRecords (RLDS, TFDS), which are not read, for that needs TensorFlow: open it with "
            "tensorflow_datasets.builder_from_directory(...), save each episode's frames as a folder of PNG files and "
            "its language_instruction in captions.csv, and import that; or take its LeRobot version"
        )
    return "videos"


def import_set(
    source: Path, out: Path, *, size: int | None = None, crop: bool = False, every: int = 1, fps: float | None = None,
    camera: str | None = None,
) -> Imported:  # fmt: skip
    """Write an episode file of videos, npz files, or a set of LeRobot, Minari or CATER.

    The frames of sets stay as they are, bit for bit; `import_videos` says what becomes of videos.

    Args:
        size: height and width of the frames; by default 64 for videos and CATER, and else their own.
        crop: where they are brought to `size`, cut off what does not fit the square.
        every: take every so many frames. Actions are left out then.
        fps: take so many frames a second, of videos.
        camera: key of the pictures, of LeRobot; by default its first.

    Raises:
        OwnVideosError: if it is damaged or cannot be used, with what and why; nothing is written then.
    """
    if every < 1 or (size is not None and size < 8):
        raise OwnVideosError(f"size must be at least 8 and every at least 1, not {size} and {every}")
    done, kind = Imported(), kind_of(source)
    if camera is not None and kind != "lerobot":
        raise OwnVideosError(f"{source} is of the kind {kind}, and only LeRobot sets have a choice of --camera")
    if kind == "videos":
        return import_videos(source, out, size=64 if size is None else size, crop=crop, every=every, fps=fps)
    if fps is not None:
        raise OwnVideosError(f"{source} is of the kind {kind}, whose episodes have one rate: take --every, not --fps")
    try:
        if kind == "lerobot":
            found = _from_lerobot(source, camera, done)
        elif kind == "minari":
            found = _from_minari(source, done)
        else:
            read: Episodes
            if kind == "cater":
                read, size, crop = CaterEpisodes(source, size=size or 64, crop=crop), None, False
            else:
                read = CliportEpisodes(source)
            found = _whole_ones(read, done)
        changed = (_changed(episode, number, size, crop, every, done) for number, episode in enumerate(found))
        done.episodes, done.frames = write_episodes(out, changed)
    except OwnVideosError as error:
        raise OwnVideosError(f"{source}: {error}") from error
    except (KeyError, IndexError, TypeError, ValueError, AssertionError, OSError) as error:
        if isinstance(error, OSError) and error.filename == str(out):
            raise
        lacks = f"it lacks {error}" if isinstance(error, KeyError) else str(error).splitlines()[0]
        raise OwnVideosError(f"{source} is damaged, or no whole {kind} set: {lacks}") from error
    return done


def _whole_ones(episodes: Episodes, done: Imported) -> Iterator[Episode]:
    """The episodes that can be read; the others, and those that were not opened, are named in `done`."""
    done.left_out += episodes.problems
    for index in range(len(episodes)):
        try:
            yield episodes.episode(index)
        except ValueError as error:
            done.left_out.append(str(error))


def _changed(episode: Episode, number: int, size: int | None, crop: bool, every: int, done: Imported) -> Episode:
    _, H, W, _ = episode.frames.shape
    if not episode.instruction.strip():
        raise OwnVideosError("an episode has no sentence")
    if size is None and H != W:
        raise OwnVideosError(f"its frames are {W}x{H} pixels, and must be square: say --size (and perhaps --crop)")
    if size not in (None, H) or H != W:
        frames, said = bring_to_size(episode.frames, (size or H, size or H), crop)
        if episode.segmentation is not None or episode.objects:
            said.append("left out its masks, objects, positions and questions, which are of the frames as they were")
        episode = replace(episode, frames=frames, segmentation=None, position=None, objects=(), questions=())
        done.say("this set", said)
    done.say(f"episode {number}", too_long(-(-len(episode.frames) // every)))
    if every == 1:
        return episode
    done.say("this set", [f"left out its actions and rewards, for --every {every} takes frames away"])
    kept = {
        name: v[::every]
        for name in ("frames", "segmentation", "state", "position")
        if (v := getattr(episode, name)) is not None
    }
    return replace(episode, **kept, action=None, reward=None, primitives=())


def export(file: Path, to: Target, out: Path, fps: int = 15) -> list[str]:
    """Write the episodes of a file as a new folder: frames, sentences, actions, rewards, states, success, seeds.

    Args:
        out: for Minari its name is the set's, such as tabletop-v0, and $MINARI_DATASETS_PATH the folder around it.
        fps: frames a second, which LeRobot needs; the simulator's are 15.

    Returns:
        what is left out, a line each.

    Raises:
        OwnVideosError: if `out` exists or its name is not allowed, a library is missing, or the file has not what the
            set needs. Nothing half-written stays.
        FileNotFoundError, ValueError: if the file cannot be read.
    """
    if fps < 1:
        raise OwnVideosError(f"--fps must be at least 1 frame a second, not {fps}")
    with EpisodeFile(file) as episodes, _new_folder(out) as new:
        return _to_lerobot(episodes, new, fps) if to == "lerobot" else _to_minari(episodes, new, out.name)


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    if out.exists():
        raise OwnVideosError(f"{out} exists already: choose another --out, or delete it")
    new = out.absolute().with_name(f".new-{uuid.uuid4().hex}-{out.name}")  # another export may write the same
    new.mkdir(parents=True)
    try:
        yield new
        if out.exists():
            raise OwnVideosError(f"{out} was written by another process meanwhile: choose another --out, or delete it")
        new.rename(out)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise


def _library(name: str, extra: Target) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise OwnVideosError(f"this needs {error.name}: pip install 'textocvp[{extra}]'") from error


# -- LeRobot -----------------------------------------------------------------------------------------------


def _to_lerobot(episodes: EpisodeFile, out: Path, fps: int) -> list[str]:
    pa, parquet = _library("pyarrow", "lerobot"), _library("pyarrow.parquet", "lerobot")
    tasks = list(dict.fromkeys(episodes.instructions))
    first, side = episodes.episode(0), episodes.image_size
    vectors = {"observation.state": first.state, "action": first.action}
    features: dict[str, Any] = {CAMERA: _feature("image", [side, side, 3], ["height", "width", "channels"])}
    features |= {name: _feature("float32", [v.shape[1]]) for name, v in vectors.items() if v is not None}
    if first.reward is not None:
        features |= {"next.reward": _feature("float32"), "next.done": _feature("bool")}
    features |= {name: _feature(kind) for name, kind in _INDEX.items()}
    schema = pa.schema([(name, _arrow_type(pa, feature)) for name, feature in features.items()])
    stats = {name: _Stats() for name, feature in features.items() if feature["dtype"] != "bool"}
    listed: list[dict[str, Any]] = []
    start, number, written, writer = 0, 0, 0, None
    try:
        for index, episode in enumerate(episodes):
            length = len(episode.frames)
            pngs = [_png(frame) for frame in episode.frames]
            if writer is not None and written > FILE_BYTES:
                writer.close()
                number, written, writer = number + 1, 0, None
            if writer is None:
                path = out / f"data/chunk-{number // 1000:03d}/file-{number % 1000:03d}.parquet"
                path.parent.mkdir(parents=True, exist_ok=True)
                writer = parquet.ParquetWriter(path, schema)
            values: dict[str, Any] = {
                "observation.state": episode.state, "action": episode.action, "next.reward": episode.reward,
                "next.done": np.arange(length) == length - 1,
                "timestamp": (np.arange(length) / fps).astype(np.float32), "frame_index": np.arange(length),
                "episode_index": np.full(length, index), "index": np.arange(start, start + length),
                "task_index": np.full(length, tasks.index(episode.instruction)),
            }  # fmt: skip
            for name, of in stats.items():
                of.add(episode.frames / 255 if name == CAMERA else values[name])
            values[CAMERA] = [{"bytes": png, "path": f"frame-{t:06d}.png"} for t, png in enumerate(pngs)]
            columns = [
                pa.array(list(values[field.name]), field.type) if field.name != "next.reward"
                else pa.array(values[field.name], field.type) for field in schema
            ]  # fmt: skip
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))
            written += sum(map(len, pngs))
            listed.append({
                "episode_index": index, "tasks": [episode.instruction], "length": length,
                "data/chunk_index": number // 1000, "data/file_index": number % 1000,
                "dataset_from_index": start, "dataset_to_index": start + length,
                "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
                f"{OURS}seed": episode.seed, f"{OURS}success": episode.success,
                f"{OURS}primitives": json.dumps(episode.primitives),
            })  # fmt: skip
            start += length
    finally:
        if writer is not None:
            writer.close()
    info = {
        "codebase_version": "v3.0", "robot_type": None, "total_episodes": len(listed), "total_frames": start,
        "total_tasks": len(tasks), "chunks_size": 1000, "data_files_size_in_mb": FILE_BYTES >> 20,
        "video_files_size_in_mb": 200, "fps": fps, "splits": {"train": f"0:{len(listed)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None,
        "features": features,
    }  # fmt: skip
    (out / "meta/episodes/chunk-000").mkdir(parents=True)
    (out / "meta/info.json").write_text(json.dumps(info, indent=4))
    (out / "meta/stats.json").write_text(json.dumps({name: of.values() for name, of in stats.items()}, indent=4))
    kept = [{name: v for name, v in row.items() if not name.startswith(OURS) or v is not None} for row in listed]
    parquet.write_table(pa.Table.from_pylist(kept), out / "meta/episodes/chunk-000/file-000.parquet")
    table = pa.table({"task_index": range(len(tasks)), "task": tasks})
    # LeRobot reads it with pandas, and the sentences as the table's index.
    column = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    as_pandas = {"index_columns": ["task"], "column_indexes": [], "columns": [column], "pandas_version": "2.0.0"}
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(as_pandas)}), out / "meta/tasks.parquet")
    return []


def _feature(dtype: str, shape: list[int] | None = None, names: list[str] | None = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape or [1], "names": names}


def _arrow_type(pa: Any, feature: dict[str, Any]) -> Any:
    if feature["dtype"] == "image":
        return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    value = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}[feature["dtype"]]
    # Its readers take a vector of one number for a number.
    return value if feature["shape"] == [1] else pa.list_(value, feature["shape"][0])


def _png(frame: NDArray[np.uint8]) -> bytes:
    Image.fromarray(frame).save(content := io.BytesIO(), format="PNG")
    return content.getvalue()


class _Stats:
    """Mean, deviation, least and most of a feature, by channel for pictures."""

    def __init__(self) -> None:
        self.parts: list[tuple[Any, ...]] = []

    def add(self, values: NDArray[Any]) -> None:
        self.shape = (3, 1, 1) if values.ndim == 4 else values.shape[1:] or (1,)
        rows = np.asarray(values, np.float64).reshape(-1, *(values.shape[-1:] if values.ndim > 1 else (1,)))
        self.parts.append((len(values), len(rows), rows.sum(0), (rows**2).sum(0), rows.min(0), rows.max(0)))

    def values(self) -> dict[str, Any]:
        """As in `meta/stats.json`."""
        frames, counts, sums, squares, least, most = (np.stack(part) for part in zip(*self.parts, strict=True))
        mean = sums.sum(0) / counts.sum()
        std = np.sqrt(np.maximum(squares.sum(0) / counts.sum() - mean**2, 0))
        found = {"min": least.min(0), "max": most.max(0), "mean": mean, "std": std}
        return {n: v.reshape(self.shape).tolist() for n, v in found.items()} | {"count": [int(frames.sum())]}


def _from_lerobot(source: Path, camera: str | None, done: Imported) -> Iterator[Episode]:
    parquet = _library("pyarrow.parquet", "lerobot")
    info = json.loads((source / "meta/info.json").read_text(encoding="utf-8"))
    if not (version := str(info["codebase_version"])).startswith(("v2", "v3")):
        raise OwnVideosError(f"a LeRobot set of version {version}, and v2.0, v2.1 and v3.0 are read")
    features, fps = info["features"], info["fps"]
    cameras = [name for name, feature in features.items() if feature["dtype"] in ("image", "video")]
    if not cameras or camera not in (None, *cameras):
        raise OwnVideosError(f"it has no camera {camera or ''}; its cameras: {', '.join(cameras) or 'none'}")
    camera = camera or cameras[0]
    if len(cameras) > 1:
        done.say("this set", [f"took the pictures of {camera}, and not of the other cameras"])
    if version.startswith("v2"):
        lines = (source / "meta/episodes.jsonl").read_text(encoding="utf-8").splitlines()
        listed = [json.loads(line) for line in lines if line.strip()]
    else:
        tables = [parquet.read_table(path) for path in sorted((source / "meta/episodes").glob("*/*.parquet"))]
        listed = [row for table in tables for row in table.to_pylist()]
    if len(listed) != info["total_episodes"]:
        raise OwnVideosError(f"info.json promises {info['total_episodes']} episodes, and {len(listed)} are listed")
    film = _Film()
    for row in listed:
        index = row["episode_index"]
        where = {"episode_chunk": index // info["chunks_size"], "episode_index": index, "video_key": camera}
        where |= {"chunk_index": row.get("data/chunk_index"), "file_index": row.get("data/file_index")}
        path = source / info["data_path"].format(**where)
        table = parquet.read_table(path, filters=[("episode_index", "=", index)])
        if table.num_rows != row["length"]:
            raise OwnVideosError(f"{path}: {table.num_rows} frames of episode {index}, and {row['length']} are listed")
        if features[camera]["dtype"] == "image":
            frames = np.stack([_picture(source, cell) for cell in table[camera].to_pylist()])
        else:
            name = f"videos/{camera}/"
            where |= {"chunk_index": row.get(f"{name}chunk_index"), "file_index": row.get(f"{name}file_index")}
            begin = round(row.get(f"{name}from_timestamp", 0) * fps)
            frames = film.read(source / info["video_path"].format(**where), begin, row["length"])
        columns: dict[str, Any] = {
            ours: np.array(table[theirs].to_pylist(), np.float32)
            for ours, theirs in (("action", "action"), ("state", "observation.state"), ("reward", "next.reward"))
            if theirs in table.column_names
        }
        for name in ("action", "state"):
            if name in columns:
                columns[name] = columns[name].reshape(len(frames), -1)
        yield Episode(
            frames=frames, instruction=str(row["tasks"][0]), seed=row.get(f"{OURS}seed"),
            success=row.get(f"{OURS}success"), primitives=tuple(json.loads(row.get(f"{OURS}primitives", "[]"))),
            **columns,
        )  # fmt: skip


def _picture(source: Path, cell: dict[str, Any]) -> NDArray[np.uint8]:
    with Image.open(io.BytesIO(cell["bytes"]) if cell["bytes"] else source / cell["path"]) as picture:
        return np.asarray(picture.convert("RGB"))


class _Film:
    """Reads clips one after another from videos that hold several, each frame once."""

    def __init__(self) -> None:
        self.path, self.at = Path(), 0
        self.frames: Iterator[NDArray[np.uint8]] = iter(())

    def read(self, path: Path, begin: int, length: int) -> NDArray[np.uint8]:
        if path != self.path or begin < self.at:
            if not path.is_file():
                raise OwnVideosError(f"there is no video {path}")
            self.path, self.at, self.frames = path, 0, video_frames(path)
        clip = list(islice(self.frames, begin - self.at, begin - self.at + length))
        self.at = begin + length
        if len(clip) < length:
            raise OwnVideosError(f"{path} ends before frame {begin + length}, to which its episodes reach")
        return np.stack(clip)


# -- Minari ------------------------------------------------------------------------------------------------


def _minari_data(source: Path) -> Path | None:
    for folder in (source / "data", source):
        if (folder / "metadata.json").is_file() and "observation_space" in (folder / "metadata.json").read_text():
            return folder
    return None


def _to_minari(episodes: EpisodeFile, out: Path, name: str) -> list[str]:
    if not MINARI_NAME.fullmatch(name):
        raise OwnVideosError(f"--out must end in the set's name, such as tabletop-v0, and not in {name!r}")
    minari, storage = _library("minari", "minari"), _library("minari.dataset.minari_storage", "minari")
    first, side, text = episodes.episode(0), episodes.image_size, "".join(episodes.instructions)
    if first.action is None:
        raise OwnVideosError(
            f"{episodes.path} has no actions, and Minari's episodes are of steps; --to lerobot does without"
        )
    spaces: dict[str, Any] = {
        "rgb": gym.spaces.Box(0, 255, (side, side, 3), np.uint8),
        "instruction": gym.spaces.Text(max(map(len, episodes.instructions)), charset="".join(sorted(set(text)))),
    }
    if first.state is not None:
        spaces["proprio"] = gym.spaces.Box(-np.inf, np.inf, first.state.shape[1:], np.float32)
    action_space = gym.spaces.Box(-np.inf, np.inf, first.action.shape[1:], np.float32)
    needed = episodes.lengths.sum() * side**2 * 3 * 1.1
    if needed > (free := shutil.disk_usage(out).free):  # HDF5 would end the process
        raise OSError(
            errno.ENOSPC,
            f"Minari's files, which are not compressed, need about {needed / 1e6:.0f} MB, of "
            f"which {free / 1e6:.0f} are free",
            str(out.parent / name),
        )
    written = storage.MinariStorage.new(
        out / "data", gym.spaces.Dict(spaces), action_space, data_format="hdf5", jpeg_encoding=False
    )
    said: list[str] = []

    def buffers() -> Iterator[Any]:
        for index, episode in enumerate(episodes):
            T = len(episode.frames)
            assert episode.action is not None
            if T < 2:
                said.append(f"episode {index}: it has one frame, and so no step")
                continue
            if episode.action[-1].any() or (episode.reward is not None and episode.reward[-1]):
                said.append(f"episode {index}: the last action and its reward, which lead to no frame")
            ends = np.arange(1, T) == T - 1
            known = {} if episode.success is None else {"success": episode.success}
            observations: dict[str, Any] = {"rgb": episode.frames, "instruction": [episode.instruction] * T}
            if episode.state is not None:
                observations["proprio"] = episode.state
            yield minari.data_collector.EpisodeBuffer(
                seed=episode.seed,
                options={**known, "primitives": json.dumps(episode.primitives)},
                observations=observations,
                actions=episode.action[:-1],
                rewards=np.zeros(T - 1, np.float32) if episode.reward is None else episode.reward[:-1],
                terminations=ends & bool(episode.success),
                truncations=ends & (not episode.success),
            )

    written.update_episodes(buffers())
    written.update_metadata({"dataset_id": name, "minari_version": minari.__version__})
    return said


def _from_minari(source: Path, done: Imported) -> Iterator[Episode]:
    storage = _library("minari.dataset.minari_storage", "minari").MinariStorage.read(_minari_data(source))
    space = storage.observation_space
    parts: dict[str, Any] = dict(space.spaces) if isinstance(space, gym.spaces.Dict) else {"": space}
    pictures = [name for name, part in parts.items() if part.dtype == np.uint8 and part.shape[2:] == (3,)]
    texts = [name for name, part in parts.items() if isinstance(part, gym.spaces.Text)]
    if not pictures or not texts:
        what = "sentence (a Text space)" if pictures else "picture (a Box of (H, W, 3) uint8)"
        raise OwnVideosError(f"its observations have no {what}; they are {', '.join(parts) or space}")
    if storage.jpeg_encoding:
        done.say("this set", ["its frames were stored as JPEG, so they are not what was seen bit for bit"])
    numbers = range(storage.total_episodes)
    for found, known in zip(storage.get_episodes(numbers), storage.get_episode_metadata(numbers), strict=True):
        seen, options = found["observations"], known.get("options", {})
        seen = seen if isinstance(seen, dict) else {"": seen}
        columns: dict[str, Any] = {}
        actions = found["actions"]
        if isinstance(actions, np.ndarray) and actions.dtype.kind == "f":
            actions = actions.reshape(len(actions), -1).astype(np.float32)
            columns["action"] = np.concatenate([actions, np.zeros_like(actions[:1])])
            columns["reward"] = np.append(found["rewards"], 0).astype(np.float32)
        else:
            done.say("this set", ["left out its actions, which are no vectors of numbers"])
        if "proprio" in seen:
            columns["state"] = np.asarray(seen["proprio"], np.float32)
        success = options.get("success")
        yield Episode(
            frames=seen[pictures[0]], instruction=str(seen[texts[0]][0]), seed=known.get("seed"),
            success=None if success is None else bool(success),
            primitives=tuple(json.loads(options.get("primitives", "[]"))), **columns,
        )  # fmt: skip
