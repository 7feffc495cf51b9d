"""CLIPort's episodes: what is damaged is named and left out, the rest is read as it is."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from textocvp.data import cliport, open_episodes
from textocvp.data.cliport import CliportEpisodes, read_episode

CAPTION = "put the red blocks in a blue bowl"


def write_episode(path: Path, T: int = 5, H: int = 16, caption: Any = CAPTION, **others: Any) -> Path:
    """A small file of the layout: a red block, a blue and a gray bowl."""
    rng = np.random.default_rng(len(path.name))
    meta = {
        "caption": caption, "kinds": ["bowl", "block", "bowl"], "colors": ["blue", "red", "gray"],
        "named_blocks": [1], "named_bowls": [0], "task": "made-up",
    }  # fmt: skip
    arrays = {
        "frames": rng.integers(0, 255, (T, H, H, 3), dtype=np.uint8),
        "segmentation": rng.integers(0, 5, (T, H, H)).astype(np.uint8),
        "position": np.zeros((T, 3, 3), np.float32),
        "intrinsics": np.eye(3),
        "extrinsics": np.eye(4),
        "meta": json.dumps(meta),
    }
    np.savez_compressed(path, **{k: v for k, v in (arrays | others).items() if v is not None})
    return path


def test_an_episode_is_read_as_it_is(tmp_path: Path) -> None:
    file = write_episode(tmp_path / "a.npz")
    episodes = open_episodes(tmp_path)
    assert isinstance(episodes, CliportEpisodes) and len(open_episodes(file)) == 1
    assert episodes.instructions == (CAPTION,) and episodes.lengths.tolist() == [5] and episodes.image_size == 16
    with np.load(file) as stored:
        assert np.array_equal(episodes.frames(0), stored["frames"])
        truth = episodes.truth(0)
        assert truth is not None and np.array_equal(truth.segmentation, stored["segmentation"])
        whole = episodes.episode(0)
        assert np.array_equal(whole.frames, stored["frames"]) and np.array_equal(whole.position, stored["position"])
    assert (whole.instruction, whole.objects, whole.questions) == (CAPTION, truth.objects, truth.questions)
    assert [(o.label, o.kind, o.color) for o in truth.objects][1] == (3, "block", "red")
    asked = {question.text: (question.moves, question.ends_at) for question in truth.questions}
    assert asked == {CAPTION: (1, 0), "put the red blocks in a gray bowl": (1, 2)}


def test_what_is_damaged_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    write_episode(tmp_path / "good1.npz"), write_episode(tmp_path / "good2.npz")
    write_episode(tmp_path / "none.npz", T=0)
    write_episode(tmp_path / "size.npz", H=12)
    write_episode(tmp_path / "silent.npz", caption=None)
    write_episode(tmp_path / "pickled.npz", position=np.array([None, 1], object))
    write_episode(tmp_path / "lacks.npz", segmentation=None)
    write_episode(tmp_path / "json.npz", meta="{")
    whole = (tmp_path / "good1.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    flipped = bytearray(whole)
    flipped[len(whole) // 4] ^= 0xFF
    (tmp_path / "flipped.npz").write_bytes(flipped)
    (tmp_path / "text.npz").write_text("hello")
    with pytest.warns(UserWarning, match="left out"):
        episodes = CliportEpisodes(tmp_path)
    assert [file.name for file in episodes.files] == ["good1.npz", "good2.npz"]
    reasons = {
        "none": "it has no frames", "size": "frames of 12x12, the others have 16x16", "silent": "no sentence",
        "pickled": "pickled arrays, which are never loaded", "lacks": "it has no 'segmentation'", "json": "",
        "cut": "", "flipped": "", "text": "",
    }  # fmt: skip
    assert len(episodes.problems) == len(reasons)
    for name, reason in reasons.items():
        (line,) = [p for p in episodes.problems if f"{name}.npz: " in p]
        assert reason in line and "\n" not in line


def test_without_a_usable_episode_there_is_an_error(tmp_path: Path) -> None:
    write_episode(tmp_path / "none.npz", T=0)
    with pytest.raises(ValueError, match=re.escape("none.npz: it has no frames")):
        CliportEpisodes(tmp_path)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        CliportEpisodes(tmp_path / "nowhere")


def test_a_whole_episode_is_read_from_its_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    episodes, read = CliportEpisodes(write_episode(tmp_path / "a.npz")), []
    monkeypatch.setattr(cliport, "read_episode", lambda file: read.append(file) or read_episode(file))
    episodes.episode(0)
    assert read == [tmp_path / "a.npz"]
