"""A folder of videos and captions becomes an episode file, from which both stages learn: the page's own commands."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
import pytest

from textocvp.cli import main
from textocvp.data import open_episodes
from textocvp.data.episodes import Episode
from textocvp.data.own_videos import (
    OwnVideosError,
    contact_sheet,
    import_videos,
    problems,
    read_captions,
    write_episodes,
)

PAGE = Path(__file__).parents[3] / "docs/own-videos.md"
SENTENCES = ("put the red block in the blue bowl", "put the green block in the blue bowl")


def video(number: int, side: int = 64, length: int = 12) -> np.ndarray:
    """A coloured square that moves over a gray table."""
    frames = np.full((length, side, side, 3), 150, np.uint8)
    for t in range(length):
        at = 4 + (3 * t + 5 * number) % (side - 24)
        frames[t, at : at + 12, 20:32] = ((200, 30, 30), (30, 160, 30))[number % 2]
        frames[t, 40:56, 44:60] = (30, 60, 200)
    return frames


def fill(folder: Path, count: int = 4) -> Path:
    """A folder of PNG folders and one lossy video, and captions."""
    folder.mkdir(parents=True)
    rows = []
    for i in range(count):
        name = f"{i:04}.mp4" if i == count - 1 else f"{i:04}"
        if name.endswith(".mp4"):
            iio.imwrite(folder / name, video(i), plugin="FFMPEG", fps=6)
        else:
            (folder / name).mkdir()
            for t, frame in enumerate(video(i)):
                iio.imwrite(folder / name / f"frame_{t}.png", frame)  # of 12: by number, not by letter
        rows.append((name, SENTENCES[i % 2]))
    with open(folder / "captions.csv", "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)
    return folder


FULL_DISK = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 12, 1 << 12))  # files may have 4 KiB, as on a full disk
from textocvp.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("what", ["import videos", "import lerobot", "export", "preview"])
def test_a_full_disk_is_one_sentence_and_leaves_what_was_there(tmp_path: Path, what: str) -> None:
    if what in ("import lerobot", "export"):
        pytest.importorskip("pyarrow")
    videos = fill(tmp_path / "videos")
    for name in ("0000", "0001", "0002"):  # pixels that do not pack
        for path in (videos / name).iterdir():
            iio.imwrite(path, np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    import_videos(videos, tmp_path / "made.h5")
    out = tmp_path / {"export": "set", "preview": "old.png"}.get(what, "old.h5")
    command = {
        "import videos": ["import", "videos", "--out", out.name],
        "import lerobot": ["import", "lerobot", "--out", out.name],
        "export": ["export", "made.h5", "--to", "lerobot", "--out", out.name],
        "preview": ["preview", "made.h5", "--out", out.name],
    }[what]
    if what == "import lerobot":
        assert (
            main(["data", "export", str(tmp_path / "made.h5"), "--to", "lerobot", "--out", str(tmp_path / "lerobot")])
            == 0
        )
    if what != "export":
        out.write_text("old")
    before = sorted(one.name for one in tmp_path.iterdir())
    run = subprocess.run(
        [sys.executable, "-c", FULL_DISK, "data", *command], cwd=tmp_path, capture_output=True, text=True
    )
    assert run.returncode == 1 and "File too large" in run.stderr and "Traceback" not in run.stderr, run.stderr
    assert sorted(one.name for one in tmp_path.iterdir()) == before
    assert not out.is_file() or out.read_text() == "old"


def test_only_files_are_replaced_and_that_is_known_at_once(tmp_path: Path, capsys) -> None:
    videos = fill(tmp_path / "videos")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name, what in (("folder", "a folder"), ("pipe", "no ordinary file")):
        assert main(["data", "import", str(videos), "--out", str(tmp_path / name)]) == 1
        assert f"this is {what} and is not replaced: '{tmp_path / name}'" in capsys.readouterr().err
    assert (tmp_path / "folder").is_dir() and (tmp_path / "pipe").is_fifo()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["folder", "pipe", "videos"]


def test_other_encodings_and_endings_are_named(tmp_path: Path, capsys) -> None:
    videos = fill(tmp_path / "videos")
    import_videos(videos, tmp_path / "made.h5")
    assert main(["data", "preview", str(tmp_path / "made.h5"), "--out", str(tmp_path / "a.xyz")]) == 1
    assert "a.xyz: the name must end in .png, .jpg, .jpeg" in capsys.readouterr().err
    (videos / "captions.csv").write_text("0000,put it there\n", encoding="utf-16")
    with pytest.raises(OwnVideosError, match=r"captions\.csv cannot be read: .*; save it as UTF-8"):
        import_videos(videos, tmp_path / "other.h5")


def test_the_commands_of_the_page(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    fill(tmp_path / "videos/train")
    fill(tmp_path / "videos/val")
    iio.imwrite("first-frame.png", video(0, side=96)[0])
    (block,) = re.findall(r"```bash\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    commands = [shlex.split(line)[1:] for line in block.strip().splitlines()]
    assert [one[:2] for one in commands[4:6]] == [["train", "parser"], ["train", "predictor"]]
    for command in commands:
        small = ["--steps", "2", "--batch", "2"] if command[0] == "train" else []
        assert main([*command, *small]) == 0, capsys.readouterr().err
    assert Path("imagined.gif").stat().st_size > 1000 and iio.imread("own/preview.png").shape == (
        4 * (18 + 128),
        768,
        3,
    )
    with open_episodes("own/train.h5") as episodes:
        for i in range(3):
            np.testing.assert_array_equal(episodes.frames(i), video(i))
        assert np.abs(episodes.frames(3).astype(int) - video(3)).mean() < 6, "lossy"
        assert episodes.instructions == tuple(SENTENCES[i % 2] for i in range(4))


def test_captions_of_every_kind(tmp_path: Path) -> None:
    wanted = {"a.mp4": "put it there", "b": "and back"}
    (tmp_path / "captions.txt").write_text("a.mp4\tput it  there\nb and back\n")
    assert read_captions(tmp_path) == wanted
    (tmp_path / "captions.txt").write_text("b c.mp4\tput it there\n")
    assert read_captions(tmp_path) == {"b c.mp4": "put it there"}
    (tmp_path / "captions.csv").write_text("a,put the red block, then the green one, there\n")
    assert read_captions(tmp_path) == {"a": "put the red block, then the green one, there"}
    (tmp_path / "captions.json").write_text(json.dumps(wanted))
    assert read_captions(tmp_path) == wanted
    (tmp_path / "captions.json").write_text('{"a": 3}')
    with pytest.raises(OwnVideosError, match=r"captions\.json cannot be read: it must hold a sentence"):
        read_captions(tmp_path)


def test_line_breaks_and_names_without_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "captions.csv").write_text('a,"put the red block\n in the bowl"\nb\n')
    assert read_captions(tmp_path) == {"a": "put the red block in the bowl", "b": ""}
    (tmp_path / "captions.csv").unlink()
    (tmp_path / "captions.txt").write_text("a put it there\nb\n")
    assert read_captions(tmp_path) == {"a": "put it there", "b": ""}


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("captions.csv", "a,put it there\na,and back\n", "two sentences for a: 'put it there' and 'and back'"),
        ("captions.txt", "a put it there\na and back\n", "two sentences for a: 'put it there' and 'and back'"),
        ("captions.json", '{"a": "put it there", "a": "and back"}', "two sentences for a:"),
        ("captions.csv", "B\u00fc,put it there\nBu\u0308,and back\n", "two sentences for B\u00fc:"),
        ("captions.csv", 'a,put it there\nb,"and back\nc,put it there\n', "line 3: unexpected end of data"),
        (
            "captions.json",
            '{"a": "put \\u0000 it"}',
            r"the sentence of a has a character that is none .*: 'put \\x00 it",
        ),
        ("captions.json", '{"a": "put \\ud800 it"}', "the sentence of a has a character that is none"),
        ("captions.json", '[["a", "put it there"]]', "it must hold a sentence for each name"),
        ("captions.json", '{"a": {"b": "put it there"}}', "it must hold a sentence for each name"),
    ],
)
def test_captions_that_cannot_be_meant_are_refused(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(OwnVideosError, match=rf"{re.escape(name)} cannot be read: {said}"):
        read_captions(tmp_path)


def test_the_same_line_twice_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "captions.csv").write_text("a,put it  there\na,put it there\n")
    assert read_captions(tmp_path) == {"a": "put it there"}


def test_no_file_takes_half_a_character(tmp_path: Path) -> None:
    with pytest.raises(OwnVideosError, match="the sentence of episode 0 has a character that is none"):
        write_episodes(tmp_path / "own.h5", [Episode(frames=video(0), instruction="put \0 it")])
    assert not list(tmp_path.iterdir())


def test_names_are_matched_however_they_are_composed(tmp_path: Path) -> None:
    folder = fill(tmp_path / "videos", 3)
    (folder / "0000").rename(folder / "bu\u0308cher")  # as macOS writes it
    (folder / "0001").rename(folder / "k\u00fcche")
    rows = f"b\u00fccher,{SENTENCES[0]}\nku\u0308che,{SENTENCES[1]}\n0002,{SENTENCES[0]}\n"
    (folder / "captions.csv").write_text(rows, encoding="utf-8")
    done = import_videos(folder, tmp_path / "own.h5")
    assert done.episodes == 3 and not done.left_out


def test_a_sentence_with_the_ending_and_another_without(tmp_path: Path) -> None:
    folder = fill(tmp_path / "videos", 2)
    rows = f"0000,{SENTENCES[0]}\n0001.mp4,{SENTENCES[0]}\n0001,{SENTENCES[1]}\n"
    (folder / "captions.csv").write_text(rows)
    assert import_videos(folder, tmp_path / "own.h5").left_out == [
        "0001.mp4: the captions have two sentences for it, one for 0001"
    ]
    (folder / "0001").mkdir()
    iio.imwrite(folder / "0001/0.png", video(1)[0]), iio.imwrite(folder / "0001/1.png", video(1)[1])
    done = import_videos(folder, tmp_path / "own.h5")
    assert done.episodes == 3 and not done.left_out, "each sentence has a video of its own"


def test_frames_a_second(tmp_path: Path, capsys) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    shades = np.arange(10, 250, 10, dtype=np.uint8)
    frames = np.broadcast_to(shades[:, None, None, None], (24, 64, 64, 3))
    for name, rate in {"fast.mp4": 30, "film.mp4": 24, "slow.mp4": 6}.items():
        iio.imwrite(folder / name, frames, plugin="FFMPEG", fps=rate, quality=10)
    iio.imwrite(folder / "even.gif", frames, duration=100)
    (folder / "pictures").mkdir()
    iio.imwrite(folder / "pictures/0.png", frames[0]), iio.imwrite(folder / "pictures/1.png", frames[1])
    (folder / "captions.json").write_text(
        json.dumps(dict.fromkeys(["fast", "film", "slow", "even", "pictures"], "put it"))
    )
    command = ["data", "import", str(folder), "--out", str(tmp_path / "own.h5")]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "these videos: of different rates, 6 frames a second in slow.mp4 and 30 in fast.mp4" in said
    assert main([*command, "--fps", "9"]) == 0
    out, error = capsys.readouterr()
    assert "of different rates" not in out
    assert "left out: slow.mp4: it has 6 frames a second, and --fps 9 was asked for" in error
    assert "left out: pictures: it does not say how many frames a second it has" in error
    with open_episodes(tmp_path / "own.h5") as episodes:
        for index, rate in enumerate((10, 30, 24)):  # even, fast, film
            seen = (episodes.frames(index).mean((1, 2, 3)) / 10 - 1).round().astype(int)
            times = np.arange(len(seen)) / 9
            assert np.abs(seen / rate - times).max() <= 0.5 / rate + 1e-9, "the nearest frame"
            assert (23 - seen[-1]) / rate < 1 / 9 + 1 / rate, "to the end"
    for wrong in (["--fps", "0"], ["--fps", "nan"], ["--fps", "5", "--every", "2"]):
        assert main([*command, *wrong]) == 1
        assert "fps must be above 0, and without every" in capsys.readouterr().err


def test_options_that_mean_nothing_are_refused(tmp_path: Path, capsys) -> None:
    command = ["data", "import", str(fill(tmp_path / "videos", 2)), "--out", str(tmp_path / "own.h5")]
    assert main([*command, "--size", "0"]) == 1 and "size must be at least 8" in capsys.readouterr().err
    assert main([*command, "--camera", "wrist"]) == 1
    assert "of the kind videos, and only LeRobot sets have a choice of --camera" in capsys.readouterr().err
    assert not (tmp_path / "own.h5").exists()


def test_pictures_of_two_kinds_and_unknown_endings(tmp_path: Path) -> None:
    folder = fill(tmp_path / "videos", 4)
    for frame in range(12):
        iio.imwrite(folder / f"0000/frame_{frame}.jpg", video(0)[frame])
        (folder / f"0001/frame_{frame}.png").rename(folder / f"0001/frame_{frame}.tif")
    (folder / "0002/notes.txt").write_text("of the camera")
    (folder / "0004.mpg").write_bytes(b"")
    with open(folder / "captions.csv", "a") as file:
        file.write("0004.mpg,put it there\n")
    done = import_videos(folder, tmp_path / "own.h5")
    pictures, videos = ".png, .jpg, .jpeg, .bmp, .webp", ".mp4, .avi, .mov, .mkv, .webm, .gif"
    assert done.left_out == [
        "0000: its pictures are of several kinds (.jpg, .png): keep one of them",
        f"0001: no pictures ({pictures}) in it, only .tif",
        f"0004.mpg: its ending is none of {videos}",
    ]
    assert f"0002: passed over what is no picture ({pictures}) in it: .txt" in done.lines and done.episodes == 2


def test_two_imports_at_once_each_write_a_file_of_their_own(tmp_path: Path) -> None:
    episodes = [Episode(frames=video(number), instruction=SENTENCES[number]) for number in range(2)]

    def slowly():
        yield episodes[0]
        write_episodes(tmp_path / "own.h5", [episodes[1]])  # another begins and ends meanwhile
        yield episodes[0]

    assert write_episodes(tmp_path / "own.h5", slowly()) == (2, 24)
    with open_episodes(tmp_path / "own.h5") as found:
        assert found.instructions == (SENTENCES[0],) * 2
        np.testing.assert_array_equal(found.clips(found.starts, 12), np.stack([video(0)] * 2))
    assert [one.name for one in tmp_path.iterdir()] == ["own.h5"]


def test_what_cannot_be_used_is_named_and_nothing_half_written_stays(tmp_path: Path) -> None:
    folder, out = fill(tmp_path / "videos"), tmp_path / "own.h5"
    (folder / "broken.mp4").write_bytes(b"no video")
    (folder / "silent").mkdir()
    captions = folder / "captions.csv"
    captions.write_text(captions.read_text() + "broken.mp4,put it there\nnone,put it there\n")
    done = import_videos(folder, out, size=32, every=2)
    assert done.episodes == 4 and done.frames == 24
    assert [line.split(":")[0] for line in done.left_out] == ["broken.mp4", "silent", "none"]
    assert "6 frames; the predictor looks 3 ahead" in problems(open_episodes(out), window=3)[0]
    before = out.read_bytes()
    captions.write_text("broken.mp4,put it there\n")
    with pytest.raises(OwnVideosError, match=r"no video of .* can be used: 0000: the captions have no sentence"):
        import_videos(folder, out)
    assert out.read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == ["own.h5", "videos"]
    captions.unlink()
    with pytest.raises(OwnVideosError, match=r"has no captions: one of captions\.json"):
        import_videos(folder, out)


def test_check_finds_what_would_be_learned_in_vain(tmp_path: Path, capsys) -> None:
    import_videos(fill(tmp_path / "videos", 5), tmp_path / "own.h5")
    assert main(["data", "check", str(tmp_path / "own.h5")]) == 0
    with h5py.File(tmp_path / "own.h5", "r+") as file:
        file["frames"][:12] = 1
        file["frames"][12:24] = file["frames"][12]
        file["frames"][24:36] = file["frames"][24:36].mean(-1, keepdims=True).astype("u1")
    assert main(["data", "check", str(tmp_path / "own.h5")]) == 1
    said = capsys.readouterr().out
    assert "episode 0" in said and "it is black" in said
    assert "nothing ever changes" in said and "it is gray" in said
    assert main(["data", "info", str(tmp_path / "missing.h5")]) == 1
    assert f"there is no file or folder {tmp_path / 'missing.h5'}" in capsys.readouterr().err


def test_few_videos_are_noted_and_not_wrong(tmp_path: Path, capsys) -> None:
    import_videos(fill(tmp_path / "videos", 2), tmp_path / "own.h5")
    assert main(["data", "check", str(tmp_path / "own.h5")]) == 0
    assert capsys.readouterr().out.endswith("note: only 2 episodes; figures measured on so few say little\n")


def test_what_was_done_to_videos_is_said(tmp_path: Path, capsys) -> None:
    folder = tmp_path / "videos"
    for name in ("a", "b"):
        (folder / name).mkdir(parents=True)
        for t, frame in enumerate(video(0, length=30)):
            iio.imwrite(folder / name / f"{t}.png", frame[:48, ..., 0])
    (folder / ".hidden").mkdir()
    (folder / "._a.mp4").write_bytes(b"left by a system")
    (folder / "a/._0.png").write_bytes(b"left by a system")
    (folder / "captions.txt").write_text("a put it there\nb put it back\n")
    assert main(["data", "import", str(folder), "--out", str(tmp_path / "own.h5")]) == 0
    out, error = capsys.readouterr()
    assert "left out" not in error and "wrote" in out
    assert "a and 1 more: took its gray for all three colours" in out
    assert "a and 1 more: added a border and brought it from 64x48 to 64x64 pixels" in out
    assert "a and 1 more: longer than 25 frames" in out and "take --every" in out
    iio.imwrite(folder / "b/7.png", video(0)[0])
    done = import_videos(folder, tmp_path / "own.h5")
    assert done.left_out == ["b: it cannot be read (its pictures differ in size: 64x48, 64x64)"]


def test_borders_of_videos_and_of_pictures_are_alike(tmp_path: Path) -> None:
    folder = tmp_path / "videos"
    (folder / "a").mkdir(parents=True)
    frames = video(0)[:, :48]
    frames[6:, :, :8] = 250  # something comes in at the edge: the border stays
    for t, frame in enumerate(frames):
        iio.imwrite(folder / f"a/{t}.png", frame)
    iio.imwrite(folder / "b.mp4", frames, plugin="FFMPEG", fps=6, quality=10)
    (folder / "captions.txt").write_text("a put it there\nb put it back\n")
    import_videos(folder, tmp_path / "own.h5")
    with open_episodes(tmp_path / "own.h5") as episodes:
        pictures, film = episodes.frames(0), episodes.frames(1)
        assert (pictures[:, :8] == 150).all() and (pictures[:, -8:] == 150).all()
        assert np.abs(film[:, :8].astype(int) - 150).max() <= 4


@pytest.mark.parametrize("ending", [".avi", ".mkv"])
def test_a_video_that_was_cut_short_is_named(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"videos/a{ending}"
    path.parent.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (40, 64, 64, 3), np.uint8)
    iio.imwrite(path, noise, plugin="FFMPEG", fps=10)
    (path.parent / "captions.txt").write_text("a put it there\n")
    assert not any("cut short" in line for line in import_videos(path.parent, tmp_path / "own.h5").lines)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    done = import_videos(path.parent, tmp_path / "own.h5")
    assert done.episodes == 1 and done.frames < 36
    (said,) = (line for line in done.lines if "cut short" in line)
    if ending == ".mkv":  # its header says how long it is
        assert said == f"a.mkv: cut short: {done.frames} of the 40 frames that its header promises can be read"
    else:
        assert said.startswith(f"a.avi: damaged or cut short: {done.frames} frames can be read, and the decoder")


def test_a_contact_sheet_has_the_sentences(tmp_path: Path) -> None:
    import_videos(fill(tmp_path / "videos", 2), tmp_path / "own.h5")
    with open_episodes(tmp_path / "own.h5") as episodes:
        sheet = contact_sheet(episodes)
        captions = [sheet[at : at + 18] for at in (0, 18 + 128)]
        assert all((line < 100).sum() > 300 and line[0, 0].tolist() == [255] * 3 for line in captions)
        assert (captions[0] != captions[1]).any(), "red and green"
        np.testing.assert_array_equal(sheet[18 : 18 + 128 : 2, :128:2], video(0)[0])


def test_caches_know_that_a_later_frame_was_corrected(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 255, (3, 32, 32, 3), np.uint8)
    prints = []
    for number in range(2):
        folder = tmp_path / f"videos{number}" / "a"
        folder.mkdir(parents=True)
        frames[2, 5, 5] += number
        for t, frame in enumerate(frames):
            iio.imwrite(folder / f"{t}.png", frame)
        (folder.parent / "captions.txt").write_text("a put the red block in the blue bowl\n")
        import_videos(folder.parent, tmp_path / f"{number}.h5", size=32)
        prints.append(open_episodes(tmp_path / f"{number}.h5").fingerprint)
    assert prints[0] != prints[1]
