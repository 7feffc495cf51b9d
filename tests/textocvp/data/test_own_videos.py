"""A folder of videos and captions becomes an episode file, from which both stages learn: the page's own commands."""

from __future__ import annotations

import csv
import json
import re
import shlex
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
import pytest

from textocvp.cli import main
from textocvp.data import open_episodes
from textocvp.data.own_videos import OwnVideosError, import_videos, problems, read_captions

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
    assert Path("imagined.gif").stat().st_size > 1000 and iio.imread("own/preview.png").shape == (256, 384, 3)
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
    with pytest.raises(
        OwnVideosError, match=r"no video of .* can be used: 0000: the captions have no sentence"
    ):
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
