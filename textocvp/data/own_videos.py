"""Videos of your own, with a sentence each, made into an episode file: `textocvp data` (docs/own-videos.md)."""

import csv
import hashlib
import io
import json
import re
import subprocess
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from imageio_ffmpeg import get_ffmpeg_exe
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageSequence
from tqdm import tqdm

from textocvp.data.episodes import FORMAT, FORMAT_VERSIONS, Episode, Episodes, Truth, words_of
from textocvp.files import hdf5_to_write, replacing
from textocvp.pictures import bring_to_size, read_picture

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".gif")
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
CAPTIONS = ("captions.json", "captions.csv", "captions.txt")
SHOWN, MOMENTS = 12, 6  # episodes of a contact sheet, and frames of each
LEAST_SHOWN, STRIP = 96, 18  # pixels: height of its frames, and of the line with the sentence above them
WINDOW = 24  # frames that a predictor looks ahead while it learns, unless it is told otherwise
ROOM = 16  # objects of an episode, at most
SAME_RATE = 1.01  # 29.97 frames a second are called 30
HEADER_TRUST = 0.9  # fewer frames than this share of what the header says, and two: the file was cut short


class OwnVideosError(ValueError):
    """A folder of videos cannot be imported; the message names the file and what is allowed."""


@dataclass
class Imported:
    """What came of an import."""

    episodes: int = 0
    frames: int = 0
    left_out: list[str] = field(default_factory=list)  # a line for each video that was not taken
    done: dict[str, dict[str, None]] = field(default_factory=dict)  # what was changed or is doubtful: of which videos

    def say(self, name: str, what: Sequence[str]) -> None:
        """Note what was done to a video."""
        for one in what:
            self.done.setdefault(one, {})[name] = None

    @property
    def lines(self) -> list[str]:
        """A line for each thing that was done, with the first video of which it is true."""
        more = {what: f" and {len(names) - 1} more" if len(names) > 1 else "" for what, names in self.done.items()}
        return [f"{next(iter(names))}{more[what]}: {what}" for what, names in self.done.items()]


def read_captions(folder: Path) -> dict[str, str]:
    """The sentence of each video, by its name with or without ending.

    `captions.json` is an object of names and sentences, `captions.csv` has rows of a name and a sentence, and
    `captions.txt` has lines of a name, a tab or blank, and a sentence.

    Raises:
        OwnVideosError: if there is none of them, or it cannot be read so.
    """
    path = next((folder / name for name in CAPTIONS if (folder / name).is_file()), None)
    if path is None:
        raise OwnVideosError(f"{folder} has no captions: one of {', '.join(CAPTIONS)} must say what happens in each")
    found: dict[str, str] = {}
    try:
        for name, sentence in _rows(path.suffix, path.read_text(encoding="utf-8-sig")):
            name, sentence = nfc(name.strip()), " ".join(sentence.split())
            if found.setdefault(name, sentence) != sentence:
                raise ValueError(f"two sentences for {name}: {found[name]!r} and {sentence!r}")
            check_sentence(sentence, name)
    except ValueError as error:
        hint = "; save it as UTF-8" if isinstance(error, UnicodeDecodeError) else ""
        raise OwnVideosError(f"{path} cannot be read: {error}{hint}") from error
    return found


def _rows(ending: str, text: str) -> Iterator[tuple[str, str]]:
    """The names and sentences of captions, in their order. A ValueError says what is wrong, and where."""
    if ending == ".json":
        rows = json.loads(text, object_pairs_hook=tuple)  # which keeps what is there twice
        if not isinstance(rows, tuple) or not all(isinstance(sentence, str) for _, sentence in rows):
            raise ValueError("it must hold a sentence for each name")
        yield from rows
    elif ending == ".csv":
        reader = csv.reader(io.StringIO(text), strict=True)
        try:
            yield from ((row[0], ",".join(row[1:])) for row in reader if row)
        except csv.Error as error:  # a quote that never ends, for one, would swallow the lines after it
            raise ValueError(f"line {reader.line_num}: {error}") from error
    else:
        for line in filter(None, map(str.strip, text.splitlines())):
            name, *sentence = line.split("\t" if "\t" in line else None, maxsplit=1)
            yield name, "".join(sentence)


def check_sentence(sentence: str, name: str) -> None:
    """An OwnVideosError that names the video if no file can hold its sentence."""
    if any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in sentence):
        raise OwnVideosError(f"the sentence of {name} has a character that is none (NUL or half a pair): {sentence!r}")


def nfc(name: str) -> str:
    """A name as it is compared: macOS writes u and two dots, where others write one letter."""
    return unicodedata.normalize("NFC", name)


def import_videos(
    source: Path, out: Path, *, size: int = 64, crop: bool = False, every: int = 1, fps: float | None = None
) -> Imported:
    """Write an episode file of the videos in a folder: video files, and folders of pictures in the order of names.

    Args:
        size: height and width of the frames in the file; pictures of other shapes get a border.
        crop: cut off what does not fit the square instead.
        every: take every so many frames.
        fps: take so many frames a second instead, the nearest in time. A video with fewer, or of which nobody knows how
            many it has (a folder of pictures), is left out.

    Raises:
        OwnVideosError: if a number is out of range, there is no video, no captions, or no video that can be used;
            nothing is written then.
    """
    if not source.is_dir():
        raise OwnVideosError(f"{source} is no folder of videos")
    if size < 8 or every < 1:
        raise OwnVideosError(f"size must be at least 8 and every at least 1, not {size} and {every}")
    if fps is not None and (every > 1 or not 0 < fps < np.inf):
        raise OwnVideosError(f"fps must be above 0, and without every, which takes frames too, not {fps} and {every}")
    captions, done = read_captions(source), Imported()
    videos = [one for one in _seen(source) if one.suffix.lower() in VIDEOS or one.is_dir()]
    if not videos:
        raise OwnVideosError(f"{source} has no video ({', '.join(VIDEOS)}) and no folder of pictures")
    episodes = _read_videos(source, videos, captions, size, crop, every, fps, done)
    done.episodes, done.frames = write_episodes(out, episodes)
    return done


def _read_videos(
    source: Path, videos: list[Path], captions: dict[str, str], size: int, crop: bool, every: int, fps: float | None,
    done: Imported,
) -> Iterator[Episode]:  # fmt: skip
    """The videos that can be used; of the others `done` says why."""
    used, rates, names = 0, dict[str, float](), {nfc(path.name) for path in videos}
    for path in tqdm(videos, desc="videos", unit="video"):
        own, stem = nfc(path.name), nfc(path.stem)
        sentence = captions.get(own) or captions.get(stem)
        if not sentence:
            done.left_out.append(f"{path.name}: the captions have no sentence for it")
            continue
        if stem not in names and captions.get(stem, sentence) != sentence:
            done.left_out.append(f"{path.name}: the captions have two sentences for it, one for {stem}")
            continue
        try:
            video, said, rate = read_video(path, size, crop, every, fps)
            if len(video) < 2:
                raise OwnVideosError(f"{len(video)} frames, and an episode needs at least 2")
        except Exception as error:  # decoders raise whatever they like
            why = str(error).splitlines()[0][:300]
            done.left_out.append(
                f"{path.name}: {why if isinstance(error, OwnVideosError) else f'it cannot be read ({why[:120]})'}"
            )
            continue
        if fps is None and rate:
            rates[path.name] = rate
        done.say(path.name, said + too_long(len(video)))
        used += 1
        yield Episode(frames=video, instruction=sentence)
    if rates and max(rates.values()) > SAME_RATE * min(rates.values()):
        slow, fast = min(rates, key=lambda name: rates[name]), max(rates, key=lambda name: rates[name])
        done.say("these videos", [
            f"of different rates, {rates[slow]:g} frames a second in {slow} and {rates[fast]:g} in {fast}, so the same "
            f"movement is slow in one and fast in another: --fps {rates[slow]:g} takes as many of each"
        ])  # fmt: skip
    known = {name for path in videos for name in (nfc(path.name), nfc(path.stem))}
    for path in _seen(source):
        if path in videos or path.name in CAPTIONS:
            continue
        if named := {nfc(path.name), nfc(path.stem)} & captions.keys() - known:
            done.left_out.append(f"{path.name}: its ending is none of {', '.join(VIDEOS)}")
            known |= named
        else:
            done.say(path.name, [f"passed over, for it is no video ({', '.join(VIDEOS)})"])
    done.left_out += [f"{name}: there is no such video" for name in captions if name not in known]
    if not used:
        raise OwnVideosError(f"no video of {source} can be used: {'; '.join(done.left_out)}")


def too_long(length: int) -> list[str]:
    """What to say of an episode of so many frames: nothing, if the predictor looks at all of them."""
    if length <= WINDOW + 1:
        return []
    return [
        f"longer than {WINDOW + 1} frames, after which the predictor stops looking: take --every, "
        "or train it with more --frames"
    ]


def write_episodes(out: Path, episodes: Iterable[Episode]) -> tuple[int, int]:
    """Write an episode file; what the first episode has, all have. Gives the numbers of episodes and frames.

    Raises:
        OwnVideosError: if there is none, or one lacks what the first has or has it in another shape; nothing is
            written then.
    """
    rows: dict[str, list[Any]] = {}
    content = hashlib.sha256()
    total, robot, names = 0, None, ("frames", "segmentation", "action", "reward", "state")
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out, out.parent) as new, hdf5_to_write(new) as file:
        for number, episode in enumerate(episodes):
            check_sentence(episode.instruction, f"episode {number}")
            arrays = {name: v for name in names if (v := getattr(episode, name)) is not None}
            if episode.position is not None:
                room = ((0, 0), (0, ROOM - episode.position.shape[1]), (0, 0))
                arrays["object_position"] = np.pad(episode.position, room, constant_values=np.nan)
            columns: dict[str, Any] = {"length": len(episode.frames), "instruction": episode.instruction}
            columns |= {name: v for name in ("seed", "success") if (v := getattr(episode, name)) is not None}
            lists = {"primitives": episode.primitives} if episode.action is not None else {}
            lists |= {name: v for name in ("objects", "questions") if (v := getattr(episode, name))}
            columns |= {n: json.dumps([getattr(i, "_asdict", lambda i=i: i)() for i in v]) for n, v in lists.items()}
            if number == 0:
                robot, rows = episode.robot, {name: [] for name in columns}
                for name, values in arrays.items():
                    shape, image = values.shape[1:], values.dtype == np.uint8
                    file.create_dataset(
                        name, (0, *shape), values.dtype, maxshape=(None, *shape),
                        chunks=(4 if image else 256, *shape), compression="gzip" if image else None,
                    )  # fmt: skip
            if lacking := {*rows, *file} - {*columns, *arrays}:
                raise OwnVideosError(f"episode {number} has no {min(lacking)}, and the first has: all must be alike")
            for name in file:
                if arrays[name].shape[1:] != file[name].shape[1:]:
                    raise OwnVideosError(
                        f"episode {number}: {name} of shape {arrays[name].shape[1:]}, and {file[name].shape[1:]} before"
                    )
                file[name].resize(total + len(arrays[name]), axis=0)
                file[name][total:] = arrays[name]
            for name, of_all in rows.items():
                of_all.append(columns[name])
            total += columns["length"]
            content.update(episode.frames.tobytes())
        if not rows:
            raise OwnVideosError("there is no episode")
        config = json.dumps({"frames": content.hexdigest()})  # by which caches know that a frame was corrected
        file.attrs.update({"format": FORMAT, "format_version": FORMAT_VERSIONS[-1], "config": config})
        if robot is not None and "segmentation" in file:
            file.attrs["labels"] = json.dumps({"background": 0, "robot": robot})
        for name, of_all in rows.items():
            file[f"episode/{name}"] = of_all
        file["episode/start"] = np.cumsum(rows["length"]) - rows["length"]
    return len(rows["length"]), total


def _seen(folder: Path) -> list[Path]:
    """What is in a folder, without what systems leave in it (.DS_Store, ._x, __MACOSX)."""
    return [one for one in sorted(folder.iterdir()) if not one.name.startswith((".", "__MACOSX"))]


def read_video(
    path: Path, size: int, crop: bool, every: int, fps: float | None = None
) -> tuple[NDArray[np.uint8], list[str], float]:
    """Frames (T, size, size, 3), every so many or `fps` a second, what was done to them, and frames a second it has.

    The rate is 0 where nobody knows it: of folders of pictures, for one.
    """
    said: list[str] = []
    rate, seconds = (0.0, 0.0) if path.is_dir() else _header(path)
    if fps is not None and fps > SAME_RATE * rate:
        has = f"has {rate:g} frames a second" if rate else "does not say how many frames a second it has"
        raise OwnVideosError(f"it {has}, and --fps {fps:g} was asked for" + ("" if rate else "; take --every"))
    step = every if fps is None else max(1.0, rate / fps)
    if path.is_dir():
        seen = _seen(path)
        files = sorted((one for one in seen if one.suffix.lower() in PICTURES), key=_by_number)
        kinds, others = ({one.suffix.lower() for one in some} for some in (files, {*seen} - {*files}))
        if len(kinds) > 1:
            raise OwnVideosError(f"its pictures are of several kinds ({', '.join(sorted(kinds))}): keep one of them")
        if others:
            endings = ", ".join(sorted(ending or "names without an ending" for ending in others))
            said.append(f"passed over what is no picture ({', '.join(PICTURES)}) in it: {endings}")
        if not files:
            raise OwnVideosError(f"no pictures ({', '.join(PICTURES)}) in it" + (f", only {endings}" if others else ""))
        read = [read_picture(one, None) for one in files[::every]]
        said += dict.fromkeys(what for _, of_one in read for what in of_one)
        frames = [frame for frame, _ in read]
        if len({frame.shape for frame in frames}) > 1:
            sizes = sorted({f"{frame.shape[1]}x{frame.shape[0]}" for frame in frames})
            raise ValueError(f"its pictures differ in size: {', '.join(sizes)}")
    else:
        frames, count = [], 0
        for frame in video_frames(path, None if fps is None else rate):
            if count == int(len(frames) * step + 0.5):  # the nearest in time to the next that is wanted
                frames.append(frame)
            count += 1
        if (promised := round(rate * seconds)) and count < min(HEADER_TRUST * promised, promised - 1):
            said.append(f"cut short: {count} of the {promised} frames that its header promises can be read")
        elif complaint := _complaint(path):
            said.append(f"damaged or cut short: {count} frames can be read, and the decoder says: {complaint}")
    if not frames:
        return np.zeros((0, size, size, 3), np.uint8), said, rate
    whole, how = bring_to_size(np.stack(frames), (size, size), crop)
    return whole, said + how, rate


def _header(path: Path) -> tuple[float, float]:
    """Frames a second and seconds that a video file tells; 0 for what it does not tell."""
    if path.suffix.lower() == ".gif":
        with Image.open(path) as film:
            lasts = {frame.info.get("duration", 0) for frame in ImageSequence.Iterator(film)}
        return (1000 / lasts.pop() if len(lasts) == 1 and all(lasts) else 0.0), 0.0  # milliseconds of each frame
    header = iio.immeta(path, plugin="FFMPEG")
    rate, seconds = (float(value) if np.isfinite(value := header.get(name, 0)) else 0.0 for name in ("fps", "duration"))
    return rate, seconds


def _complaint(path: Path) -> str:
    """The first error of decoding a video file that yields frames all the same; empty if there is none."""
    if path.suffix.lower() == ".gif":
        return ""
    command = [get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-map", "0:v:0", "-f", "null", "-"]
    told = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace")
    return re.sub(r"^\[.*?\] ", "", next(iter(told.stderr.splitlines()), ""))


def _by_number(path: Path) -> list[tuple[bool, int, str]]:
    """Sorts 2 before 10, whatever stands around the numbers."""
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r"(\d+)", path.name)]


def video_frames(path: Path, rate: float | None = None) -> Iterator[NDArray[np.uint8]]:
    """The frames (H, W, 3) of a video file, RGB; with `rate` so many a second, even where they last unequally."""
    if path.suffix.lower() == ".gif":
        yield from iio.imiter(path, mode="RGB")
    else:
        options: dict[str, Any] = {} if rate is None else {"fps": rate}
        yield from iio.imiter(path, plugin="FFMPEG", **options)


def describe(episodes: Episodes) -> list[str]:
    """What a file holds, a line each."""
    lengths, size = episodes.lengths, episodes.image_size
    words = sorted(words_of(episodes.instructions))
    known = vars(episodes.truth(0) or Truth())
    lacking = [name for name in ("segmentation", "objects", "questions") if known[name] is None or not len(known[name])]
    return [
        f"{len(episodes)} episodes of {lengths.min()} to {lengths.max()} frames (median {np.median(lengths):g}), "
        f"{int(lengths.sum())} in all, {size}x{size}",
        f"{len(set(episodes.instructions))} different sentences of {len(words)} words: {', '.join(words)}",
        f"not in the file, and so not measured in training: {', '.join(lacking) or 'nothing'}",
    ]


def problems(episodes: Episodes, window: int | None = None) -> list[str]:
    """What is wrong or doubtful in a file, a line each; empty if nothing is.

    Args:
        window: frames that the predictor to be trained can look ahead.
    """
    found: list[str] = []
    damaged = list(episodes.problems)
    for index, text in enumerate(episodes.instructions):
        try:
            frames = episodes.frames(index)
        except ValueError as error:
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
    """Moments of the first episodes, a row each under its sentence: (rows, columns, 3) uint8."""
    rows = []
    for index in range(min(SHOWN, len(episodes))):
        frames = episodes.frames(index)
        factor = max(1, -(-LEAST_SHOWN // frames.shape[1]))
        moments: Sequence[int] = np.linspace(0, len(frames) - 1, MOMENTS).round().astype(int).tolist()
        row = np.concatenate([frames[t] for t in moments], axis=1).repeat(factor, 0).repeat(factor, 1)
        line = Image.new("RGB", (row.shape[1], STRIP), "white")
        text = f"{index}: {episodes.instructions[index]}"
        ImageDraw.Draw(line).text((3, 1), text, "black", ImageFont.load_default(STRIP - 6))
        rows += [np.asarray(line), row]
    return np.concatenate(rows)
