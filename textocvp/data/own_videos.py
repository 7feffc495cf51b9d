"""Videos of your own, with a sentence each, made into an episode file: `textocvp data` (docs/own-videos.md)."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from tqdm import tqdm

from textocvp.data.episodes import Episode, Episodes, words_of
from textocvp.files import replacing
from textocvp.pictures import read_picture

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".gif")
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
CAPTIONS = ("captions.json", "captions.csv", "captions.txt")
SHOWN, MOMENTS = 12, 6  # episodes of a contact sheet, and frames of each


class OwnVideosError(ValueError):
    """A folder of videos cannot be imported; the message names the file and what is allowed."""


@dataclass
class Imported:
    """What came of an import."""

    episodes: int = 0
    frames: int = 0
    left_out: list[str] = field(default_factory=list)  # a line for each video that was not taken


def read_captions(folder: Path) -> dict[str, str]:
    """The sentence of each video, by its name with or without ending.

    `captions.json` is an object of names and sentences, `captions.csv` has rows of a name and a sentence, and
    `captions.txt` has lines of a name, a tab or blank, and a sentence.

    Raises:
        OwnVideosError: if there is none of them, or it cannot be read so.
    """
    path = next((folder / name for name in CAPTIONS if (folder / name).is_file()), None)
    if path is None:
        raise OwnVideosError(
            f"{folder} has no captions: one of {', '.join(CAPTIONS)} must say what happens in each"
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix == ".json":
            found = json.loads(text)
        elif path.suffix == ".csv":
            found = {row[0]: ",".join(row[1:]) for row in csv.reader(text.splitlines()) if row}
        else:
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            found = dict(line.split("\t" if "\t" in line else None, maxsplit=1) for line in lines)
        if not isinstance(found, dict) or not all(isinstance(one, str) for one in found.values()):
            raise ValueError("it must hold a sentence for each name")
    except (ValueError, IndexError) as error:
        raise OwnVideosError(f"{path} cannot be read: {error}") from error
    return {name.strip(): " ".join(sentence.split()) for name, sentence in found.items()}


def import_videos(
    source: Path | Episodes, out: Path, *, size: int = 64, crop: bool = False, every: int = 1
) -> Imported:
    """Write an episode file of the videos in a folder: video files, and folders of pictures in the order of names.

    Args:
        source: the folder; or episodes of another format, whose frames have their size, with objects and positions.
        size: height and width of the frames in the file; pictures of other shapes get a border.
        crop: cut off what does not fit the square instead.
        every: take every so many frames.

    Raises:
        OwnVideosError: if there is no video, no captions, or no video that can be used; nothing is written then.
    """
    if isinstance(source, Path) and not source.is_dir():
        raise OwnVideosError(f"{source} is no folder of videos")
    if size < 8 or every < 1:
        raise OwnVideosError(f"size must be at least 8 and every at least 1, not {size} and {every}")
    done = Imported()
    videos: dict[str, Callable[[], Episode]]
    if isinstance(source, Episodes):
        size = source.image_size
        videos = {f"episode {i}": partial(source.episode, i) for i in range(len(source))}
        captions = dict(zip(videos, source.instructions, strict=True))
    else:
        captions = read_captions(source)
        found = [one for one in sorted(source.iterdir()) if one.suffix.lower() in VIDEOS or one.is_dir()]
        videos = {one.name: partial(_own_episode, one, size, crop, every) for one in found}
        every = 1  # they take it themselves
    if not videos:
        raise OwnVideosError(f"{source} has no video ({', '.join(VIDEOS)}) and no folder of pictures")
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as new, h5py.File(new, "w") as file:
        shape = (0, size, size, 3)
        frames = file.create_dataset(
            "frames", shape, "u1", maxshape=(None, *shape[1:]), chunks=(4, *shape[1:]), compression="gzip"
        )
        lengths: list[int] = []
        sentences: list[str] = []
        objects: list[str] = []
        positions: list[NDArray[np.float32]] = []
        for name, read in tqdm(videos.items(), desc="videos", unit="video"):
            sentence = captions.get(name) or captions.get(Path(name).stem)
            if not sentence:
                done.left_out.append(f"{name}: the captions have no sentence for it")
                continue
            try:
                clip = read()
            except Exception as error:  # decoders raise whatever they like
                done.left_out.append(f"{name}: it cannot be read ({str(error).splitlines()[0][:300]})")
                continue
            video = clip.frames[::every]
            if len(video) < 2:
                done.left_out.append(f"{name}: {len(video)} frames, and an episode needs at least 2")
                continue
            frames.resize(len(frames) + len(video), axis=0)
            frames[-len(video) :] = video
            lengths.append(len(video))
            sentences.append(sentence)
            if clip.position is not None:
                objects.append(json.dumps([one._asdict() for one in clip.objects]))
                positions.append(clip.position[::every])
        known = {*videos, *(Path(name).stem for name in videos)}
        done.left_out += [f"{name}: there is no such video" for name in captions if name not in known]
        if not lengths:
            raise OwnVideosError(f"no video of {source} can be used: {'; '.join(done.left_out)}")
        file.attrs.update({"format": "textocvp-episodes", "format_version": 2})
        file["episode/start"] = np.cumsum(lengths) - lengths
        file["episode/length"] = np.array(lengths)
        file["episode/instruction"] = sentences
        if positions:
            file["episode/objects"] = objects
            room = max(8, *(one.shape[1] for one in positions))
            placed = file.create_dataset("object_position", (sum(lengths), room, 3), "f4", fillvalue=np.nan)
            for start, one in zip(file["episode/start"], positions, strict=True):
                placed[start : start + len(one), : one.shape[1]] = one
    done.episodes, done.frames = len(lengths), sum(lengths)
    return done


def _own_episode(path: Path, size: int, crop: bool, every: int) -> Episode:
    return Episode(frames=read_video(path, size, crop, every), instruction="")


def read_video(path: Path, size: int, crop: bool, every: int) -> NDArray[np.uint8]:
    """Square frames (T, size, size, 3) as `import_videos` takes them; raises whatever the decoder does."""
    if path.is_dir():
        files = sorted((one for one in path.iterdir() if one.suffix.lower() in PICTURES), key=_by_number)[
            ::every
        ]
        shots = [read_picture(one, (size, size), resize=not crop, crop=crop)[0] for one in files]
        return np.stack(shots) if shots else np.zeros((0, size, size, 3), np.uint8)
    fit = ImageOps.fit if crop else ImageOps.pad
    frames = (frame for i, frame in enumerate(_frames(path)) if i % every == 0)
    pictures = [np.asarray(fit(Image.fromarray(frame).convert("RGB"), (size, size))) for frame in frames]
    return np.stack(pictures) if pictures else np.zeros((0, size, size, 3), np.uint8)


def _by_number(path: Path) -> list[tuple[bool, int, str]]:
    """Sorts 2 before 10, whatever stands around the numbers."""
    return [
        (part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r"(\d+)", path.name)
    ]


def _frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    if path.suffix.lower() == ".gif":
        yield from iio.imiter(path, mode="RGB")
    else:
        yield from iio.imiter(path, plugin="FFMPEG")


def describe(episodes: Episodes) -> list[str]:
    """What a file holds, a line each."""
    lengths, size = episodes.lengths, episodes.image_size
    words = sorted(words_of(episodes.instructions))
    known = episodes.truth(0)
    lacking = [name for name in ("segmentation", "objects", "questions") if not _has(known, name)]
    return [
        f"{len(episodes)} episodes of {lengths.min()} to {lengths.max()} frames (median {np.median(lengths):g}), "
        f"{int(lengths.sum())} in all, {size}x{size}",
        f"{len(set(episodes.instructions))} different sentences of {len(words)} words: {', '.join(words)}",
        f"not in the file, and so not measured in training: {', '.join(lacking) or 'nothing'}",
    ]


def _has(known: object, name: str) -> bool:
    value = getattr(known, name, None)
    return value is not None and len(value) > 0


def problems(episodes: Episodes, window: int | None = None) -> list[str]:
    """What is wrong or doubtful in a file, a line each; empty if nothing is.

    Args:
        window: frames that the predictor to be trained can look ahead.
    """
    found, damaged = [], list(episodes.problems)
    if len(episodes) < 4:
        found.append(f"{len(episodes)} episodes: figures over fewer than 4 say little")
    for index, text in enumerate(episodes.instructions):
        try:
            frames = episodes.frames(index)
        except (OSError, ValueError) as error:
            damaged.append(str(error))
            continue
        here = f"episode {index} ({text!r})"
        if not any(letter.isalpha() for letter in text):
            found.append(f"{here}: the sentence has no words")
        if frames.max() <= 1:
            found.append(f"{here}: no value above 1: it is black, or held 0..1 and was cut to whole numbers")
        elif (frames == frames[:1]).all():
            found.append(f"{here}: nothing ever changes")
        if (frames[..., 0] == frames[..., 2]).all() and (frames[..., 0] == frames[..., 1]).all():
            found.append(f"{here}: it is gray, and objects are told apart by colour")
        if window is not None and len(frames) > window + 1:
            found.append(
                f"{here}: {len(frames)} frames; the predictor looks {window} ahead: take --every, or a wider window"
            )
    if damaged:
        total = len(episodes) + len(episodes.problems)
        found = [f"{len(damaged)} of {total} episodes cannot be used:", *damaged, *found]
    return found


def contact_sheet(episodes: Episodes) -> NDArray[np.uint8]:
    """Moments of the first episodes, a row each: (rows, columns, 3) uint8."""
    rows = []
    for index in range(min(SHOWN, len(episodes))):
        frames = episodes.frames(index)
        moments: Sequence[int] = np.linspace(0, len(frames) - 1, MOMENTS).round().astype(int).tolist()
        rows.append(np.concatenate([frames[t] for t in moments], axis=1))
    return np.concatenate(rows)
