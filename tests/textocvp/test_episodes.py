from __future__ import annotations

import json
import multiprocessing
import pickle
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from textocvp.data.episodes import Episode, EpisodeFile, EpisodeObject

LENGTHS = (25, 7, 25, 3)


def write_file(path: Path, lengths: tuple[int, ...] = LENGTHS, size: int = 64, version: int = 1) -> Path:
    """A file of the layout that envs.collect writes. A frame's pixels tell its place: red the episode, green t."""
    total = sum(lengths)
    frames = np.zeros((total, size, size, 3), np.uint8)
    frames[..., 0] = np.repeat(np.arange(len(lengths)), lengths)[:, None, None]
    frames[..., 1] = np.concatenate([np.arange(length) for length in lengths])[:, None, None]
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "frames", data=frames, chunks=(4, size, size, 3), compression="gzip", compression_opts=1
        )
        file.create_dataset("segmentation", data=frames[..., 1], chunks=(4, size, size))
        index = file.create_group("episode")
        index["start"] = np.cumsum(lengths) - lengths
        index["length"] = np.array(lengths)
        index["seed"] = 100 + np.arange(len(lengths))
        index["target"] = np.tile([0, 1], (len(lengths), 1))
        index["success"] = np.arange(len(lengths)) % 2 == 0
        objects = json.dumps([{"kind": "block", "color": "red"}, {"kind": "bowl", "color": "blue"}])
        for name, texts in (
            ("instruction", [f"sentence {k}" for k in range(len(lengths))]),
            ("objects", [objects] * len(lengths)),
        ):
            index.create_dataset(name, data=np.array(texts, dtype=object), dtype=h5py.string_dtype())
        file.attrs.update(
            {"format": "textocvp-episodes", "format_version": version, "split": "val", "config": "{}"}
        )
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_file(tmp_path_factory.mktemp("episodes") / "val.h5")


def test_episodes_come_back_whole(path: Path) -> None:
    with EpisodeFile(path) as file:
        assert len(file) == 4 and file.lengths.tolist() == list(LENGTHS) and file.image_size == 64
        for number, episode in enumerate(file):
            assert isinstance(episode, Episode)
            assert episode.frames.shape == (LENGTHS[number], 64, 64, 3) and episode.frames.dtype == np.uint8
            assert (episode.frames[..., 0] == number).all()
            assert episode.frames[:, 0, 0, 1].tolist() == list(range(LENGTHS[number]))
            assert np.array_equal(episode.segmentation, episode.frames[..., 1])
            assert episode.instruction == f"sentence {number}" and episode.seed == 100 + number
            assert episode.success == (number % 2 == 0) and episode.target == (0, 1)
            assert episode.objects == (EpisodeObject(0, "block", "red"), EpisodeObject(1, "bowl", "blue"))
        assert file.episode(-1).seed == 103
        assert [len(frames) for frames in file.frames([3, 0])] == [3, 25]
        assert "4 episodes of split 'val', 64x64" in repr(file)


def test_clips_are_consecutive_frames_of_one_episode_and_all_equally_likely(path: Path) -> None:
    with EpisodeFile(path) as file:
        clips = file.random_clips(np.random.default_rng(0), 2000, 6)
    assert clips.shape == (2000, 6, 64, 64, 3) and clips.dtype == np.uint8
    episode, time_ = clips[:, :, 0, 0, 0], clips[:, :, 0, 0, 1].astype(int)
    assert (episode == episode[:, :1]).all()
    assert (np.diff(time_, axis=1) == 1).all()
    # 20 + 2 + 20 clips of 6 frames; the episode of 3 frames has none.
    counts = np.bincount(episode[:, 0], minlength=4) / 2000
    assert counts == pytest.approx([20 / 42, 2 / 42, 20 / 42, 0], abs=0.04)
    assert set(time_[episode[:, 0] == 0, 0]) == set(range(20))


def test_the_generator_decides_the_clips(path: Path) -> None:
    with EpisodeFile(path) as file:
        first, again, other = (file.random_clips(np.random.default_rng(seed), 8, 4) for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_clips_come_at_2000_frames_a_second_or_more(tmp_path: Path) -> None:
    with EpisodeFile(write_file(tmp_path / "many.h5", (25,) * 100)) as file:
        rng = np.random.default_rng(0)
        file.random_clips(rng, 8, 6)
        start = time.process_time()  # of this process: other work on the machine does not count
        file.random_clips(rng, 200, 6)
        assert 200 * 6 / (time.process_time() - start) > 2000


def test_it_travels_to_other_processes(path: Path) -> None:
    file = EpisodeFile(path)
    clips = file.random_clips(np.random.default_rng(3), 4, 5)
    copy = pickle.loads(pickle.dumps(file))
    assert np.array_equal(copy.random_clips(np.random.default_rng(3), 4, 5), clips)
    copy.close()
    if "fork" in multiprocessing.get_all_start_methods():
        with multiprocessing.get_context("fork").Pool(2) as pool:
            children = pool.starmap(file.random_clips, [(np.random.default_rng(3), 4, 5)] * 4)
        assert all(np.array_equal(child, clips) for child in children)
    file.close()
    assert len(file.episode(0).frames) == 25  # opens again by itself
    file.close()


def test_wrong_requests_are_refused(path: Path) -> None:
    with EpisodeFile(path) as file:
        with pytest.raises(IndexError, match="has episodes 0 to 3, not 4"):
            file.episode(4)
        with pytest.raises(ValueError, match=r"no episode has 26 frames; the longest .* has 25"):
            file.random_clips(np.random.default_rng(0), 1, 26)
        with pytest.raises(ValueError, match="at least 1, not 0 and 6"):
            file.random_clips(np.random.default_rng(0), 0, 6)
        with pytest.raises(KeyError, match="no attribute 'camera'; it has: config, format"):
            file.attribute("camera")


def test_wrong_files_are_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no episode file .*nothing\.h5; collect one with"):
        EpisodeFile(tmp_path / "nothing.h5")
    with pytest.raises(FileNotFoundError):
        EpisodeFile(tmp_path)
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(ValueError, match="not an episode file, or is damaged"):
        EpisodeFile(tmp_path / "text.h5")
    whole = path.read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="is damaged"):
        EpisodeFile(tmp_path / "cut.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ValueError, match="is an HDF5 file, but not an episode file"):
        EpisodeFile(tmp_path / "other.h5")
    with pytest.raises(ValueError, match="format version 0, and this program reads version 1; collect"):
        EpisodeFile(write_file(tmp_path / "old.h5", version=0))
    lost = write_file(tmp_path / "lost.h5")
    with h5py.File(lost, "a") as file:
        del file["episode/seed"]
    with pytest.raises(ValueError, match=r"is damaged: .*seed"):
        EpisodeFile(lost)
    short = write_file(tmp_path / "short.h5")
    with h5py.File(short, "a") as file:
        file["episode/length"][0] = 24
    with pytest.raises(ValueError, match="is damaged: 60 frames, but its index tells 59"):
        EpisodeFile(short)
