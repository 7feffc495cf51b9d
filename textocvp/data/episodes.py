"""Episodes: frames with a sentence each, and what is known of the scenes. The HDF5 file that holds them."""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from textocvp.text.wording import split

FORMAT = "textocvp-episodes"
FORMAT_VERSIONS = (1, 2)

FRAME_ARRAYS = ("arm", "gripper", "action", "reward", "state", "object_position")  # a row for each frame

ROBOT, FIRST_OBJECT = 1, 2  # labels in segmentations of version 1

E = TypeVar("E", bound="Episodes")


class EpisodeObject(NamedTuple):
    """One object of a scene; `label` is its value in the segmentation."""

    id: int
    label: int
    kind: str
    color: str
    size: str = ""
    material: str = ""


class Question(NamedTuple):
    """A sentence that a scene allows, the id of the object that should move, and of that at which it should end."""

    text: str
    moves: int
    ends_at: int


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What is known of an episode besides its frames. Used to measure, never to train."""

    segmentation: NDArray[np.uint8] | None = None  # (T, H, W) labels, 0 the background; None where there are no masks
    robot: int | None = None  # the robot's label, if there is a robot
    objects: tuple[EpisodeObject, ...] = ()
    questions: tuple[Question, ...] = ()
    supports: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    """What carries each object before and after the episode: an id, -1 the table, -2 nothing that has an id."""
    position: NDArray[np.float32] | None = None  # (T, n, 3) where the n objects are, metres, in the world frame
    intrinsics: NDArray[np.float64] | None = None
    """(3, 3) of the camera, in pixels; the centre of the top-left pixel is (0.5, 0.5)."""
    extrinsics: NDArray[np.float64] | None = None  # (4, 4) of the camera, world to camera, metres

    def question(self, text: str) -> Question | None:
        """The question with this sentence, if there is one."""
        return next((question for question in self.questions if question.text == text), None)


@dataclass(frozen=True, kw_only=True)
class Episode(Truth):
    """Everything of one episode of T frames."""

    frames: NDArray[np.uint8]  # (T, H, W, 3), 0..255; frame 0 is seen before anything moves
    instruction: str
    seed: int | None = None  # the scene's seed in the simulator, if it has one
    success: bool | None = None  # whether the instruction was carried out, if that was judged
    reset_options: dict[str, Any] | None = None
    """What the simulator's `reset` was given beside the seed, if it is known."""
    action: NDArray[np.float32] | None = None
    """(T, A) what was done from each frame on; the last leads to no frame. Collected files: tool motions, A = 5."""
    reward: NDArray[np.float32] | None = None  # (T,) for what was done from each frame on
    state: NDArray[np.float32] | None = None  # (T, S) of the robot; in collected files S = 11: `arm` and `gripper`
    primitives: tuple[dict[str, Any], ...] = ()
    """Whole pick-and-places: the `frame` from which on, and the `action` [pick_x, pick_y, place_x, place_y], metres."""


class Episodes(ABC):
    """Episodes of square frames, one after another. Subclasses set the attributes and write `detect` and `frames`.

    Must be picklable, and usable after a fork: workers read clips ahead.

    Attributes:
        path: where they are.
        image_size: height and width of the frames, in pixels.
        lengths: (E,) frames of each episode.
        instructions: the E sentences.
        problems: a line for each file that was left out.
    """

    path: Path
    image_size: int
    lengths: NDArray[np.int64]
    instructions: tuple[str, ...]
    problems: tuple[str, ...] = ()

    @abstractmethod
    def __init__(self, path: str | os.PathLike[str], first: int | None = None) -> None:
        """Open what is at `path`; with `first`, only the first so many episodes."""

    @classmethod
    @abstractmethod
    def detect(cls, path: Path) -> bool:
        """Whether what is at `path` is of this format, by a quick look."""

    @abstractmethod
    def frames(self, index: int) -> NDArray[np.uint8]:
        """All frames (T, H, W, 3) of an episode, 0..255."""

    def truth(self, index: int) -> Truth | None:
        """What is known of an episode; None where nothing is."""
        return None

    def episode(self, index: int) -> Episode:
        """Everything of an episode."""
        known = vars(self.truth(index) or Truth())
        return Episode(frames=self.frames(index), instruction=self.instructions[index], **known)

    @property
    def vocabulary(self) -> tuple[str, ...]:
        """The words that sentences about such scenes can contain; by default those of the instructions."""
        return tuple(sorted(words_of(self.instructions)))

    @property
    def fingerprint(self) -> str:
        """A hash by which caches know these episodes: of sentences, lengths and some first frames."""
        digest = hashlib.sha256("\n".join(self.instructions).encode())
        digest.update(np.ascontiguousarray(self.lengths, np.int64).tobytes())
        some = self.starts[:: max(1, len(self) // 256)]  # all would take minutes in a large file
        digest.update(self.clips(some, 1).tobytes())
        return digest.hexdigest()

    @property
    def starts(self) -> NDArray[np.int64]:
        """(E,) number of each episode's first frame, counted over all episodes."""
        return np.cumsum(self.lengths) - self.lengths

    def clips(self, starts: NDArray[np.int64], length: int) -> NDArray[np.uint8]:
        """Clips (len(starts), length, H, W, 3) that begin at these frames, counted over all episodes."""
        episodes = np.searchsorted(self.starts, starts, side="right") - 1
        offsets = starts - self.starts[episodes]
        pairs = zip(episodes, offsets, strict=True)
        return np.stack([self.frames(int(index))[at : at + length] for index, at in pairs])

    def random_starts(self, rng: np.random.Generator, count: int, length: int) -> NDArray[np.int64]:
        """Where random clips of `length` frames begin (count,); every clip of the episodes is equally likely.

        Raises:
            ValueError: when no episode is that long, or `count` or `length` is below 1.
        """
        if count < 1 or length < 1:
            raise ValueError(f"count and length must be at least 1, not {count} and {length}")
        clips = np.maximum(self.lengths - length + 1, 0)  # of each episode
        ends = np.cumsum(clips)
        if len(self) == 0 or ends[-1] == 0:
            longest = int(self.lengths.max(initial=0))
            raise ValueError(f"no episode has {length} frames; the longest of {self.path} has {longest}")
        picks = rng.integers(ends[-1], size=count)
        episodes = np.searchsorted(ends, picks, side="right")
        return self.starts[episodes] + picks - (ends - clips)[episodes]

    def close(self) -> None:
        """Give back what is held open. A later read opens it again."""
        return

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    def __enter__(self: E) -> E:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class EpisodeFile(Episodes):
    """One HDF5 file of format version 1 or 2 (docs/data.md); its first so many episodes, or all.

    Attributes:
        seeds: (E,) of the scenes; None where there are none.
        success: (E,) whether the instructions were carried out; None where that was not judged.
        split: name of the split.

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
                f"there is no episode file {self.path}; "
                f"collect one with: python -m textocvp.envs.collect --out {self.path}"
            )
        kept = slice(first)
        try:
            file = self._open()
            self._version = self._check_format(file)
            self._check_arrays(file)
            index = file["episode"]
            self.lengths: NDArray[np.int64] = index["length"][:].astype(np.int64)
            self.instructions: tuple[str, ...] = tuple(index["instruction"].asstr()[kept])
            self.seeds: NDArray[np.int64] | None = index["seed"][kept] if "seed" in index else None
            self.success: NDArray[np.bool_] | None = index["success"][kept] if "success" in index else None
            self.image_size = int(file["frames"].shape[1])
            self.split = str(file.attrs.get("split", ""))
        except (OSError, KeyError, TypeError, AttributeError, UnicodeError) as error:
            self.close()
            raise ValueError(f"{self.path} is not an episode file, or is damaged: {error}") from error
        except ValueError:
            self.close()
            raise
        self.lengths = self.lengths[kept]

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether it is a file with one of the usual endings, or one that begins as HDF5 does."""
        return path.is_file() and (path.suffix in (".h5", ".hdf5") or bool(h5py.is_hdf5(path)))

    def __repr__(self) -> str:
        size = self.image_size
        return f"EpisodeFile({str(self.path)!r}: {len(self)} episodes of split {self.split!r}, {size}x{size})"

    def __iter__(self) -> Iterator[Episode]:
        return (self.episode(index) for index in range(len(self)))

    def episode(self, index: int) -> Episode:
        """Everything of an episode; negative numbers count from the end. An IndexError when there is none."""
        number = self._number(index)
        return Episode(
            frames=self.frames(number),
            instruction=self.instructions[number],
            seed=None if self.seeds is None else int(self.seeds[number]),
            success=None if self.success is None else bool(self.success[number]),
            reset_options=self._json("options", number) or None,
            action=self._array("action", number),
            reward=self._array("reward", number),
            state=self._state(number),
            primitives=tuple(self._json("primitives", number)),
            **vars(self.truth(number) or Truth()),
        )

    def frames(self, index: int) -> NDArray[np.uint8]:
        """All frames (T, H, W, 3) of an episode; an IndexError when there is none."""
        return self._open()["frames"][self._rows(index)]

    def clips(self, starts: NDArray[np.int64], length: int) -> NDArray[np.uint8]:
        clips = np.empty((len(starts), length, self.image_size, self.image_size, 3), dtype=np.uint8)
        dataset = self._open()["frames"]
        # In the file's order, so that clips of one chunk are read while it is cached.
        for place in np.argsort(starts):
            dataset.read_direct(clips, np.s_[starts[place] : starts[place] + length], np.s_[place])
        return clips

    def truth(self, index: int) -> Truth | None:
        """Masks, objects, questions and supports, as far as the file has them; None without masks and objects."""
        number, file = self._number(index), self._open()
        masks = file["segmentation"][self._rows(number)] if "segmentation" in file else None
        items = self._json("objects", number)
        if masks is None and not items:
            return None
        robot: int | None = ROBOT
        questions: tuple[Question, ...] = ()
        if self._version == 1:
            items = [{"id": id, "label": FIRST_OBJECT + id, **item} for id, item in enumerate(items)]
        names = EpisodeObject._fields
        objects = tuple(EpisodeObject(**{name: item[name] for name in names if name in item}) for item in items)
        if self._version > 1:
            robot = json.loads(file.attrs.get("labels", "{}")).get("robot")
            questions = tuple(Question(**item) for item in self._json("questions", number))
        elif "target" in file["episode"]:
            moves, ends_at = file["episode/target"][number].tolist()
            questions = swapped_questions(self.instructions[number], objects, moves, ends_at)
        supports = None
        if "supports_before" in file["episode"]:
            before, after = (file[f"episode/supports_{when}"][number, : len(objects)] for when in ("before", "after"))
            supports = (tuple(before.tolist()), tuple(after.tolist()))
        position = intrinsics = extrinsics = None
        if "object_position" in file:
            position = file["object_position"][self._rows(number)][:, : len(objects)]
        # Where the camera itself is drawn at random, the file has only the usual one.
        factors = self._json("factors", number) or {}
        if "camera_intrinsics" in file.attrs and not factors.keys() & {"camera_shift", "camera_zoom"}:
            intrinsics, extrinsics = file.attrs["camera_intrinsics"], file.attrs["camera_extrinsics"]
        return Truth(
            segmentation=masks, robot=robot, objects=objects, questions=questions, supports=supports,
            position=position, intrinsics=intrinsics, extrinsics=extrinsics,
        )  # fmt: skip

    @property
    def vocabulary(self) -> tuple[str, ...]:
        said = self._open().attrs.get("vocabulary")
        return super().vocabulary if said is None else tuple(json.loads(said))

    @property
    def fingerprint(self) -> str:
        digest = hashlib.sha256(str(self._open().attrs.get("config", "")).encode())
        digest.update(super().fingerprint.encode())
        return digest.hexdigest()

    def attribute(self, name: str) -> Any:
        """A file attribute, such as `camera_intrinsics` (3, 3), `camera_extrinsics` (4, 4) or `config`.

        Raises:
            KeyError: if the file has no such attribute; the message lists those it has.
        """
        attributes = self._open().attrs
        if name not in attributes:
            raise KeyError(f"{self.path} has no attribute {name!r}; it has: {', '.join(sorted(attributes))}")
        return attributes[name]

    def close(self) -> None:
        if self._file is not None and self._process == os.getpid():
            self._file.close()
        self._file = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_file": None, "_process": -1}

    def _open(self) -> h5py.File:
        # HDF5 handles must not be shared across a fork: two processes would move one file position.
        if self._file is None or self._process != os.getpid():
            self._file, self._process = h5py.File(self.path, "r"), os.getpid()
        return self._file

    def _number(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path} has episodes 0 to {len(self) - 1}, not {index}")
        return index % len(self)

    def _rows(self, index: int) -> slice:
        number = self._number(index)
        return slice(int(self.starts[number]), int(self.starts[number] + self.lengths[number]))

    def _array(self, name: str, number: int) -> NDArray[Any] | None:
        file = self._open()
        return file[name][self._rows(number)] if name in file else None

    def _state(self, number: int) -> NDArray[Any] | None:
        if (state := self._array("state", number)) is not None:
            return state
        parts = [self._array(name, number) for name in ("arm", "gripper")]
        known = [part for part in parts if part is not None]
        return np.concatenate(known, axis=1) if len(known) == 2 else None

    def _json(self, name: str, number: int) -> Any:
        index = self._open()["episode"]
        return json.loads(index[name].asstr()[number]) if name in index else []

    def _check_format(self, file: h5py.File) -> int:
        kind, version = file.attrs.get("format"), file.attrs.get("format_version")
        if kind != FORMAT:
            raise ValueError(f"{self.path} is an HDF5 file, but not an episode file")
        if version not in FORMAT_VERSIONS:
            raise ValueError(
                f"{self.path} has format version {version}, and this program reads versions "
                f"{' and '.join(map(str, FORMAT_VERSIONS))}; "
                f"collect the episodes again with: python -m textocvp.envs.collect"
            )
        return int(version)

    def _check_arrays(self, file: h5py.File) -> None:
        """A ValueError where frames and index are not as docs/data.md lays them out."""
        frames, index = file["frames"], file["episode"]
        lengths, text = index["length"][()], index["instruction"]
        total, wrong = frames.shape[0] if frames.shape else 0, ""
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or frames.shape[1] != frames.shape[2]:
            wrong = f"frames must be uint8 (N, H, H, 3), square and RGB, not {frames.dtype} {frames.shape}"
        elif lengths.dtype.kind not in "iu" or lengths.ndim != 1 or (lengths < 1).any():
            wrong = "the lengths of its episodes must be whole numbers (E,), each at least 1"
        elif not len(lengths):
            wrong = "it has no episode"
        elif h5py.check_string_dtype(text.dtype) is None:
            wrong = f"its instructions must be sentences, not {text.dtype}"
        elif not np.array_equal(index["start"][:], np.cumsum(lengths) - lengths) or total != lengths.sum():
            wrong = f"{total} frames, but its index tells {lengths.sum()}, which must stand one after another"
        else:
            shapes = {f"episode/{name}": (len(lengths),) for name in index}
            shapes |= dict.fromkeys(FRAME_ARRAYS, (total,)) | {"segmentation": frames.shape[:3]}
            for name, shape in shapes.items():
                if name in file and file[name].shape[: len(shape)] != shape:
                    wrong = f"{name} has shape {file[name].shape}, for {len(lengths)} episodes, {total} frames"
        if wrong:
            raise ValueError(f"{self.path} is damaged: {wrong}")


def swapped_questions(
    instruction: str, objects: tuple[EpisodeObject, ...], moves: int, ends_at: int
) -> tuple[Question, ...]:
    """The sentences that a scene allows, from the one that was played, for files of version 1, which store none.

    Empty where the sentence does not name its two objects by colour and kind.
    """
    first, second = (next(item for item in objects if item.id == id) for id in (moves, ends_at))
    names = [f"{item.color} {item.kind}" for item in (first, second)]
    if any(instruction.count(name) != 1 for name in names):
        return ()
    template = instruction.replace(names[0], "\0").replace(names[1], "\1")
    return tuple(
        Question(template.replace("\0", f"{a.color} {a.kind}").replace("\1", f"{b.color} {b.kind}"), a.id, b.id)
        for a in objects
        for b in objects
        if a.kind == first.kind and b.kind == second.kind and a.id != b.id
    )


def words_of(sentences: Iterable[str]) -> set[str]:
    """All words of some sentences, lower case; -3 is one."""
    return {word for sentence in set(sentences) for word in split(sentence)}
