"""CATER-GEN-v2 as distributed: read in place, made into an episode file; what is damaged is named and left out."""

from __future__ import annotations

import json
import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from textocvp.cli import main
from textocvp.data import open_episodes
from textocvp.data.cater import CaterEpisodes, read_scene
from textocvp.data.episodes import EpisodeObject
from textocvp.data.own_videos import describe, problems

CAPTION = "the small gold metal snitch is sliding to (-1, 2). the large red rubber cone is rotating."
T = 12


def clip(number: int, length: int = T, H: int = 48, W: int = 64) -> np.ndarray:
    """A square that moves over a light floor."""
    frames = np.full((length, H, W, 3), 200, np.uint8)
    for t in range(length):
        frames[t, 8:24, 2 * t + number : 2 * t + number + 16] = (173, 35, 35)
    return frames


def scene(frames: int = T, last: int = T - 2) -> dict[str, Any]:
    """A snitch that slides, and a cone."""
    names = (("Spl", "spl", "gold", "small", "metal"), ("Cone", "cone", "red", "large", "rubber"))
    keys = ("instance", "shape", "color", "size", "material")
    things = [dict(zip(keys, name, strict=True), rotation=12.5) for name in names]
    for i, thing in enumerate(things):
        thing["locations"] = {str(t): [i, -0.25 * t * (i == 0), 0.5] for t in range(frames)}
    return {"objects": things, "movements": {"Spl": [["_slide", None, 1, last]], "Cone": [["_rotate", None, 0, 7]]}}


def write(folder: Path, count: int = 4, name: str = "train_explicit", codec: str = "mjpeg", **shape: int) -> Path:
    """A folder of the layout, with one list of the numbers 2, 10, 18, ...; returns the list."""
    for part in ("videos", "scenes"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    entries = {}
    for i in reversed(range(count)):  # the order of the numbers counts, not that of the file
        entries[str(2 + 8 * i)] = {"video": f"videos/CLEVR_new_{i:06}.avi", "caption": f" {CAPTION}"}
        iio.imwrite(folder / f"videos/CLEVR_new_{i:06}.avi", clip(i, **shape), plugin="FFMPEG", codec=codec, fps=24)
        (folder / f"scenes/CLEVR_new_{i:06}.json").write_text(json.dumps(scene(), indent=2))
    (folder / f"{name}.json").write_text(json.dumps(entries))
    return folder / f"{name}.json"


def quietly(path: Path, **options: Any) -> CaterEpisodes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return CaterEpisodes(path, **options)


@pytest.mark.parametrize("codec", ["mjpeg", "mpeg4", "libx264"])
def test_clips_are_read_as_they_are(tmp_path: Path, codec: str) -> None:
    source = write(tmp_path, 3, codec=codec, H=64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is left out, nothing is resized
        episodes = open_episodes(source)
    assert isinstance(episodes, CaterEpisodes) and episodes.image_size == 64
    assert episodes.lengths.tolist() == [T] * 3 and episodes.instructions == (CAPTION,) * 3
    assert {"snitch", "-1", "2"} < set(episodes.vocabulary) and "1" not in episodes.vocabulary
    for i in range(3):
        assert np.abs(episodes.frames(i).astype(int) - clip(i, H=64)).mean() < 4, "lossy"
    whole = pickle.loads(pickle.dumps(episodes)).episode(2)
    assert whole.frames.shape == (T, 64, 64, 3) and whole.segmentation is None and whole.robot is None
    assert whole.objects == (
        EpisodeObject(0, 1, "snitch", "gold", "small", "metal"),
        EpisodeObject(1, 2, "cone", "red", "large", "rubber"),
    )
    assert whole.position is not None and whole.position[4].tolist() == [[0, -1, 0.5], [1, 0, 0.5]]
    assert np.array_equal(episodes.clips(np.array([T + 3]), 2)[0], episodes.frames(1)[3:5])


def test_frames_become_square_with_a_border_or_cut_off_and_that_is_said(tmp_path: Path) -> None:
    source = write(tmp_path, 1)
    with pytest.warns(UserWarning, match="frames of 64x48 become 32x32, with a border"):
        frames = CaterEpisodes(source, size=32).frames(0)
    assert frames.shape == (T, 32, 32, 3) and frames[:, 6, 31].min() > 150
    assert np.ptp(frames[:, [0, 1, 30, 31]].astype(int)) < 12  # of one colour
    with pytest.warns(UserWarning, match="frames of 64x48 become 32x32, cut off to fit"):
        assert CaterEpisodes(source, size=32, crop=True).frames(0)[:, [0, 31], 31].min() > 150


def test_where_the_list_lies(tmp_path: Path) -> None:
    source = write(tmp_path, 2)
    for path in (tmp_path, tmp_path / "train", tmp_path / "train_explicit", source):
        assert len(quietly(path)) == 2 and len(quietly(path, first=1)) == 1
        assert CaterEpisodes.detect(path)
    write(tmp_path, 1, "test_explicit"), write(tmp_path, 1, "test_ambiguous")
    assert len(quietly(tmp_path / "test")) == len(quietly(tmp_path / "test_ambiguous.json")) == 1
    with pytest.raises(ValueError, match=r"has several lists of captions: say which, as .*/train_explicit\.json"):
        open_episodes(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"there is no .*/val"):
        CaterEpisodes(tmp_path / "val")
    for text in ("[]", "{", '{"a": {}}'):
        source.write_text(text)
        with pytest.raises(ValueError, match=r"train_explicit\.json is no list of captions"):
            open_episodes(source)
    source.write_text("{}")
    with pytest.raises(ValueError, match="no clip that can be used: it names none"):
        open_episodes(source)
    with pytest.raises(ValueError, match="at least 8"):
        CaterEpisodes(tmp_path / "test", size=4)


def damage(folder: Path) -> dict[str, str]:
    """Spoil some of 16 clips; the reason that is to be given for each file."""
    source = folder / "train_explicit.json"
    entries = json.loads(source.read_text())
    videos = [folder / entries[str(2 + 8 * i)]["video"] for i in range(16)]
    scenes = [folder / "scenes" / f"{video.stem}.json" for video in videos]
    whole = videos[1].read_bytes()
    videos[1].write_bytes(whole[: len(whole) // 2])
    videos[2].write_bytes(whole[: whole.rfind(b"idx1") + 20])
    videos[3].write_bytes(b"")
    videos[4].write_text("hello")
    videos[5].unlink()
    iio.imwrite(videos[6], clip(6, T - 3), plugin="FFMPEG", codec="mjpeg")
    iio.imwrite(videos[7], clip(7, 1), plugin="FFMPEG", codec="mjpeg")
    scenes[8].unlink()
    scenes[9].write_text(json.dumps(scene())[:-40])
    lacking = scene()
    del lacking["objects"][1]["material"]
    scenes[10].write_text(json.dumps(lacking))
    scenes[11].write_text(json.dumps({"objects": [], "movements": {}}))
    entries["98"]["caption"] = " "
    del entries["106"]["video"]
    entries["114"] = None
    source.write_text(json.dumps(entries))
    return {
        videos[1].name: "no whole index of frames", videos[2].name: "no whole index", videos[3].name: "no AVI file",
        videos[4].name: "no AVI file", videos[5].name: "there is no such video",
        videos[6].name: "cut short: 9 frames, and its scene needs 11", videos[7].name: "1 frame, and an episode",
        scenes[8].name: "there is no such scene", scenes[9].name: "cannot be read", scenes[10].name: "no 'material'",
        scenes[11].name: "cannot be read", videos[12].name: "train_explicit.json has no caption for it",
        "entry 106": "has no video", "entry 114": "has no video",
    }  # fmt: skip


def test_what_is_damaged_is_named_and_the_others_are_read(tmp_path: Path, capsys) -> None:
    source = write(tmp_path, 16)
    reasons = damage(tmp_path)
    with pytest.warns(UserWarning) as given:
        episodes = open_episodes(source)
    assert len(episodes) == 2 and len(episodes.problems) == len(reasons)
    warned = [str(one.message) for one in given]
    for name, reason in reasons.items():
        (line,) = [one for one in warned if name in one]
        assert line.startswith("left out: ") and reason in line and "\n" not in line
    for i, number in enumerate((0, 15)):
        assert np.abs(episodes.frames(i)[:, 8:-8].astype(int) - clip(number)).mean() < 6
    assert problems(episodes)[0] == "14 of 16 episodes cannot be used:"
    assert main(["data", "check", str(source)]) == 1
    said = capsys.readouterr()
    assert "14 of 16 episodes cannot be used:" in said.out
    for name, reason in reasons.items():
        for text, before in ((said.out, ""), (said.err, "textocvp: warning: left out: ")):
            assert re.search(rf"^{before}/.*{re.escape(name)}.*{re.escape(reason)}", text, re.MULTILINE)


def test_damage_inside_a_video_is_found_when_it_is_read(tmp_path: Path) -> None:
    source = write(tmp_path, 2)
    video = tmp_path / "videos/CLEVR_new_000001.avi"
    data = bytearray(video.read_bytes())
    start, end = data.find(b"movi"), data.rfind(b"idx1")
    data[(2 * start + end) // 3 : (start + end) // 2] = bytes((start + end) // 2 - (2 * start + end) // 3)
    video.write_bytes(data)
    episodes = quietly(source)
    assert len(episodes) == 2 and episodes.frames(0).shape == (T, 64, 64, 3)
    with pytest.raises(ValueError, match=r"CLEVR_new_000001\.avi: (damaged|it cannot be read)"):
        episodes.frames(1)
    assert "1 of 2 episodes cannot be used:" in problems(episodes)


def test_without_scenes_there_are_still_videos(tmp_path: Path) -> None:
    source = write(tmp_path, 2)
    for file in (tmp_path / "scenes").iterdir():
        file.unlink()
    with pytest.raises(ValueError, match=r"no clip that can be used: .*there is no such scene"):
        quietly(source)
    (tmp_path / "scenes").rmdir()
    episodes = quietly(source)
    assert episodes.truth(0) is None and len(episodes) == 2
    assert "segmentation, objects, questions" in describe(episodes)[2]
    assert main(["data", "import", str(source), "--out", str(tmp_path / "own.h5")]) == 0
    assert open_episodes(tmp_path / "own.h5").truth(0) is None


def test_a_scene_that_ends_before_the_video(tmp_path: Path) -> None:
    """CATER counts frames from 0 to their number: a video may have one more than the scene, or one less."""
    source = write(tmp_path, 2)
    for i, frames in enumerate((T - 1, T + 1)):
        (tmp_path / f"scenes/CLEVR_new_00000{i}.json").write_text(json.dumps(scene(frames)))
    positions = [quietly(source).episode(i).position for i in range(2)]
    assert [one.shape for one in positions] == [(T, 2, 3)] * 2
    assert np.isnan(positions[0][-1]).all() and np.isfinite(positions[0][:-1]).all() and np.isfinite(positions[1]).all()
    objects, position, last = read_scene(tmp_path / "scenes/CLEVR_new_000001.json")
    assert (len(objects), position.shape, last) == (2, (T + 1, 2, 3), T - 2)


def test_an_episode_file_is_made_of_it_and_trains(tmp_path: Path, capsys) -> None:
    source, out = write(tmp_path, 4), tmp_path / "out/train.h5"
    (tmp_path / "videos/CLEVR_new_000001.avi").write_bytes(b"hello")
    assert main(["data", "import", str(source), "--out", str(out), "--size", "32", "--crop", "--every", "2"]) == 0
    said = capsys.readouterr()
    assert "frames of 64x48 become 32x32, cut off to fit" in said.err and "3 episodes, 18 frames" in said.out
    assert re.findall(r"left out: .*CLEVR_new_000001\.avi: it is no AVI file", said.err)
    there, made = quietly(source, size=32, crop=True), open_episodes(out)
    for i in range(3):
        read, stored = there.episode(i), made.episode(i)
        assert np.array_equal(stored.frames, read.frames[::2]) and stored.instruction == CAPTION
        assert stored.objects == read.objects and np.array_equal(stored.position, read.position[::2])
    (tmp_path / "videos/CLEVR_new_000002.avi").unlink(), (tmp_path / "videos/CLEVR_new_000000.avi").unlink()
    (tmp_path / "videos/CLEVR_new_000003.avi").write_bytes(b"")
    before = out.read_bytes()
    assert main(["data", "import", str(source), "--out", str(out)]) == 1
    assert "no clip that can be used" in capsys.readouterr().err and out.read_bytes() == before
