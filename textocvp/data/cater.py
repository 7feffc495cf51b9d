"""CATER-GEN-v2 as its makers distribute it: AVI videos, scenes and captions in one folder (docs/data.md)."""

import json
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from textocvp.data.episodes import EpisodeObject, Episodes, Truth
from textocvp.data.own_videos import read_video

LISTS = ("train_explicit", "test_explicit", "train_ambiguous", "test_ambiguous")


class CaterEpisodes(Episodes):
    """The clips of one list of captions. One whose video or scene is missing, damaged or cut short is left out.

    Warnings name those, and say how frames are resized. Videos are judged by their index: decoding all takes an hour.

    Args:
        path: FOLDER/train_explicit.json, or FOLDER/train, which means the same, or a folder with a single list.
        size: height and width that frames are brought to.
        crop: cut off what does not fit a square; otherwise it gets a border in the colour of its edge.

    Raises:
        FileNotFoundError: when there is no list.
        ValueError: when it is damaged, there are several, no clip can be used, or a number is out of range.
    """

    def __init__(
        self, path: str | os.PathLike[str], first: int | None = None, *, size: int = 64, crop: bool = False
    ) -> None:
        if size < 8 or (first is not None and first < 1):
            raise ValueError(f"size must be at least 8 and first at least 1, not {size} and {first}")
        if not (lists := _lists(Path(path))):
            raise FileNotFoundError(f"there is no {path}, or no list of captions in it ({', '.join(LISTS)})")
        if len(lists) > 1:
            raise ValueError(f"{path} has several lists of captions: say which, as {lists[0]}")
        self.path, self.image_size, self.crop = lists[0], size, crop
        self._scenes = self.path.parent / "scenes"
        try:
            found = json.loads(self.path.read_text(encoding="utf-8"))
            entries = sorted(found.items(), key=lambda entry: int(entry[0]))
        except (ValueError, AttributeError) as error:
            raise ValueError(f"{path} is no list of captions, number -> video and caption: {error}") from error
        kept, problems = [], []
        for number, entry in entries:
            try:
                kept.append(self._clip(number, entry))
            except (ValueError, OSError) as error:
                problems.append(str(error))
            if len(kept) == first:
                break
        if not kept:
            raise ValueError(f"{path} has no clip that can be used: {(*problems, 'it names none')[0]}")
        self._videos, self.instructions, lengths, sizes = zip(*kept, strict=True)
        self.lengths = np.array(lengths, np.int64)
        self.problems = tuple(problems)
        said = [f"left out: {problem}" for problem in problems]
        if others := sorted({*sizes} - {(size, size)}):
            how = "cut off to fit" if crop else "with a border where they are not square"
            said.append(f"frames of {', '.join(f'{W}x{H}' for W, H in others)} become {size}x{size}, {how}")
        for line in said:
            warnings.warn(line, UserWarning, stacklevel=2)

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether a list of captions lies there."""
        return bool(_lists(path))

    def frames(self, index: int) -> NDArray[np.uint8]:
        """All frames (T, H, H, 3) of an episode; a ValueError that names the video if it is damaged inside."""
        video, wanted = self._videos[index], self.lengths[index]
        try:
            frames = read_video(video, self.image_size, self.crop, every=1)[0]
        except Exception as error:  # decoders raise whatever they like
            raise ValueError(f"{video}: it cannot be read ({str(error).splitlines()[0][:120]})") from error
        if len(frames) != wanted:
            raise ValueError(f"{video}: damaged, {len(frames)} of {wanted} frames; an import leaves it out")
        return frames

    def truth(self, index: int) -> Truth | None:
        """Objects, and where they are in the table's units, NaN after the scene's last frame; None without scenes."""
        if not self._scenes.is_dir():
            return None
        objects, known, _ = read_scene(self._scenes / f"{self._videos[index].stem}.json")
        position = np.full((self.lengths[index], len(objects), 3), np.nan, np.float32)
        position[: len(known)] = known[: len(position)]
        return Truth(objects=objects, position=position)

    def _clip(self, number: str, entry: Any) -> tuple[Path, str, int, tuple[int, int]]:
        """Video, caption, frames, and width and height of an entry of the list, if all is there and whole."""
        name, caption = (entry.get(key) if isinstance(entry, dict) else None for key in ("video", "caption"))
        if not (isinstance(name, str) and name):
            raise ValueError(f"{self.path}: entry {number} has no video")
        video = self.path.parent / name
        if not (isinstance(caption, str) and caption.strip()):
            raise ValueError(f"{video}: {self.path.name} has no caption for it")
        count, W, H = _look(video)
        if count < 2:
            raise ValueError(f"{video}: {count} frame, and an episode needs at least 2")
        if self._scenes.is_dir():
            _, known, last = read_scene(self._scenes / f"{video.stem}.json")
            if count < (needed := max(last, len(known) - 1)):  # CATER counts from 0 to its number of frames
                raise ValueError(f"{video}: it was cut short: {count} frames, and its scene needs {needed}")
        return video, " ".join(caption.split()), count, (W, H)


def read_scene(file: Path) -> tuple[tuple[EpisodeObject, ...], NDArray[np.float32], int]:
    """The objects of a scene, where they are (T, n, 3), and the frame at which the last of them comes to rest.

    Raises:
        ValueError: if the file is missing, damaged, or lacks something; the message names it.
    """
    try:
        scene = json.loads(file.read_text(encoding="utf-8"))
        objects = []
        for id, one in enumerate(scene["objects"]):
            kind = "snitch" if one["shape"] == "spl" else one["shape"]
            objects.append(EpisodeObject(id, 1 + id, kind, one["color"], one["size"], one["material"]))
        tracks = [one["locations"] for one in scene["objects"]]
        places = [[track[str(t)] for track in tracks] for t in range(min(map(len, tracks)))]
        position = np.array(places, np.float32).reshape(-1, len(objects), 3)
        ends = [int(end) for motions in scene["movements"].values() for _, _, _, end in motions]
        return tuple(objects), position, max(ends, default=0)
    except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else f"it cannot be read ({error})"
        raise ValueError(f"{file}: {reason if file.is_file() else 'there is no such scene'}") from error


def _lists(path: Path) -> list[Path]:
    """The lists of captions that a path can mean."""
    if path.is_dir():
        return [file for name in LISTS if (file := path / f"{name}.json").is_file()]
    names = [path] if path.suffix == ".json" else [Path(f"{path}.json"), Path(f"{path}_explicit.json")]
    return [file for file in names if file.is_file()][:1]


def _look(video: Path) -> tuple[int, int, int]:
    """Frames, width and height of an AVI file by its header and index; a ValueError if it is missing or not whole."""
    if not video.is_file():
        raise ValueError(f"{video}: there is no such video")
    W = H = 0
    with open(video, "rb") as stream:
        riff = stream.read(12)
        while riff[:4] + riff[8:] == b"RIFFAVI " and len(head := stream.read(8)) == 8:
            start, name, length = stream.tell(), head[:4], int.from_bytes(head[4:], "little")
            if name == b"LIST" and stream.read(4) != b"movi":
                continue  # the chunks inside come next
            if name == b"avih":
                W, H = np.frombuffer(stream.read(56).ljust(56), "<u4")[8:10].tolist()
            if name == b"idx1" and len(index := stream.read(length)) == length:
                count = sum(index[at + 2 : at + 4] in (b"dc", b"db") for at in range(0, length, 16))
                if count and W and H:
                    return count, W, H
            stream.seek(start + length + length % 2)
    raise ValueError(f"{video}: it is no AVI file, or damaged or cut short: it has no whole index of frames")
