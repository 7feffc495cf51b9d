"""Episode files of both versions come back whole, with or without truth, and other formats plug in."""

from __future__ import annotations

import json
import multiprocessing
import pickle
import re
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.data import FORMATS, open_episodes
from textocvp.data.episodes import Episode, EpisodeFile, EpisodeObject, Episodes, Question, swapped_questions

LENGTHS = (25, 7, 25, 3)


def write_file(path: Path, lengths: tuple[int, ...] = LENGTHS, size: int = 64, version: int = 1) -> Path:
    """A file of the layout that envs.collect writes. A frame's pixels tell its place: red the episode, green t."""
    total = sum(lengths)
    frames = np.zeros((total, size, size, 3), np.uint8)
    frames[..., 0] = np.repeat(np.arange(len(lengths)), lengths)[:, None, None]
    frames[..., 1] = np.concatenate([np.arange(length) for length in lengths])[:, None, None]
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=frames, chunks=(4, size, size, 3), compression="gzip", compression_opts=1)
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
        file.attrs.update({"format": "textocvp-episodes", "format_version": version, "split": "val", "config": "{}"})
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_file(tmp_path_factory.mktemp("episodes") / "val.h5")


def random_clips(file: Episodes, seed: int, count: int, length: int) -> np.ndarray:
    return file.clips(file.random_starts(np.random.default_rng(seed), count, length), length)


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
            assert episode.success == (number % 2 == 0)
            assert episode.robot == 1 and episode.questions == ()  # the sentence names no object
            assert episode.objects == (EpisodeObject(0, 2, "block", "red"), EpisodeObject(1, 3, "bowl", "blue"))
        assert file.episode(-1).seed == 103 and len(file.frames(-1)) == 3
        assert "4 episodes of split 'val', 64x64" in repr(file)
    with open_episodes(path, first=2) as file:
        assert file.lengths.tolist() == [25, 7] and len(file.instructions) == 2
        with pytest.raises(IndexError, match="has episodes 0 to 1, not 2"):
            file.frames(2)


def test_both_versions_tell_the_same(tmp_path: Path) -> None:
    one, two = (
        EpisodeFile(write_toy_episodes(tmp_path / f"{version}.h5", [4, 5], version=version)) for version in (1, 2)
    )
    for old, new in zip(one, two, strict=True):
        assert old.objects == new.objects and old.robot == new.robot and old.questions == new.questions
        assert np.array_equal(old.segmentation, new.segmentation)
    (played, *_) = two.truth(1).questions
    assert (played.moves, played.ends_at) == (0, 2)
    assert two.truth(1).question(two.instructions[1]) == played and two.truth(1).question("no such") is None
    assert two.vocabulary == ("put", "the", "block", "in", "bowl", "red", "blue", "green", "yellow")
    assert set(one.vocabulary) <= set(two.vocabulary) and "block" in one.vocabulary


def test_questions_swap_each_object_for_another_of_its_kind() -> None:
    objects = tuple(
        EpisodeObject(id, 2 + id, kind, color)
        for id, (kind, color) in enumerate([("cup", "tan"), ("box", "red"), ("cup", "gray"), ("box", "dark red")])
    )
    found = swapped_questions("move the red box to the gray cup", objects, 1, 2)
    assert found == (
        Question("move the red box to the tan cup", 1, 0),
        Question("move the red box to the gray cup", 1, 2),
        Question("move the dark red box to the tan cup", 3, 0),
        Question("move the dark red box to the gray cup", 3, 2),
    )
    (stacked, back) = swapped_questions("the tan cup on the gray cup", objects, 0, 2)
    assert stacked.text == "the tan cup on the gray cup"  # never onto itself
    assert back == Question("the gray cup on the tan cup", 2, 0)
    assert swapped_questions("move it there", objects, 1, 2) == ()


@pytest.mark.parametrize("version", [1, 2])
def test_frames_and_sentences_are_enough(tmp_path: Path, version: int) -> None:
    with EpisodeFile(write_toy_episodes(tmp_path / "a.h5", [4, 5], version=version, truth=False)) as file:
        assert file.truth(0) is None and file.seeds is None and file.success is None
        episode = file.episode(1)
        assert episode.frames.shape == (5, 32, 32, 3) and episode.segmentation is None and episode.seed is None
        assert set(file.vocabulary) <= set(" ".join(file.instructions).split())
        with EpisodeFile(write_toy_episodes(tmp_path / "b.h5", [4, 5], seed=1, truth=False)) as other:
            assert other.fingerprint != file.fingerprint


def test_other_frames_are_other_episodes(tmp_path: Path) -> None:
    paths = [write_toy_episodes(tmp_path / f"{name}.h5", [4, 5]) for name in "ab"]
    with EpisodeFile(paths[0]) as one, EpisodeFile(paths[1]) as same:
        assert one.fingerprint == same.fingerprint
    with h5py.File(paths[1], "a") as file:
        file["frames"][4, 0, 0] += 1
    with EpisodeFile(paths[0]) as one, EpisodeFile(paths[1]) as corrected:
        assert one.fingerprint != corrected.fingerprint


class _Squares(Episodes):
    """A format of one's own: as little as there must be."""

    def __init__(self, path, first=None) -> None:
        self.path, self.image_size = Path(path), 8
        lines = self.path.read_text().splitlines()[:first]
        self.instructions, self.lengths = tuple(lines), np.array([len(line) for line in lines])

    @classmethod
    def detect(cls, path: Path) -> bool:
        return path.suffix == ".squares"

    def frames(self, index: int) -> np.ndarray:
        frames = np.zeros((self.lengths[index], 8, 8, 3), np.uint8)
        frames[:, 0, 0, 0], frames[:, 0, 0, 1] = index, range(self.lengths[index])
        return frames


def test_another_format_is_a_class_and_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "my.squares"
    source.write_text("one two\nthree four five\nsix")
    with pytest.raises(ValueError, match=r"not an episode file, nor of another format \(hdf5, cliport, cater\)"):
        open_episodes(source)
    monkeypatch.setitem(FORMATS, "squares", _Squares)
    with open_episodes(source, first=2) as file:
        assert len(file) == 2 and file.vocabulary == ("five", "four", "one", "three", "two")
        assert file.truth(0) is None
        clips = random_clips(file, 0, 200, 6)
    assert set(clips[:, 0, 0, 0, 0]) == {0, 1} and (np.diff(clips[:, :, 0, 0, 1].astype(int)) == 1).all()


def test_clips_are_consecutive_frames_of_one_episode_and_all_equally_likely(path: Path) -> None:
    with EpisodeFile(path) as file:
        clips = random_clips(file, 0, 2000, 6)
        some = file.random_starts(np.random.default_rng(1), 50, 6)
        assert np.array_equal(file.clips(some, 6), Episodes.clips(file, some, 6))  # as any format reads them
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
        first, again, other = (random_clips(file, seed, 8, 4) for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_clips_come_at_2000_frames_a_second_or_more(tmp_path: Path) -> None:
    with EpisodeFile(write_file(tmp_path / "many.h5", (25,) * 100)) as file:
        random_clips(file, 0, 8, 6)
        start = time.process_time()  # of this process: other work on the machine does not count
        random_clips(file, 0, 200, 6)
        assert 200 * 6 / (time.process_time() - start) > 2000


def test_it_travels_to_other_processes(path: Path) -> None:
    file = EpisodeFile(path)
    clips = random_clips(file, 3, 4, 5)
    copy = pickle.loads(pickle.dumps(file))
    assert np.array_equal(random_clips(copy, 3, 4, 5), clips)
    copy.close()
    if "fork" in multiprocessing.get_all_start_methods():
        starts = file.random_starts(np.random.default_rng(3), 4, 5)
        with multiprocessing.get_context("fork").Pool(2) as pool:
            children = pool.starmap(file.clips, [(starts, 5)] * 4)
        assert all(np.array_equal(child, clips) for child in children)
    file.close()
    assert len(file.frames(0)) == 25  # opens again by itself
    file.close()


def test_wrong_requests_are_refused(path: Path) -> None:
    with EpisodeFile(path) as file:
        for ask in (file.episode, file.frames, file.truth):
            with pytest.raises(IndexError, match="has episodes 0 to 3, not 4"):
                ask(4)
        with pytest.raises(ValueError, match=r"no episode has 26 frames; the longest .* has 25"):
            file.random_starts(np.random.default_rng(0), 1, 26)
        with pytest.raises(ValueError, match="at least 1, not 0 and 6"):
            file.random_starts(np.random.default_rng(0), 0, 6)
        with pytest.raises(KeyError, match="no attribute 'camera'; it has: config, format"):
            file.attribute("camera")


@pytest.mark.parametrize("opened", [EpisodeFile, open_episodes])
def test_wrong_files_are_refused(path: Path, tmp_path: Path, opened) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no episode file .*nothing\.h5; collect one with"):
        opened(tmp_path / "nothing.h5")
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(ValueError, match="not an episode file, or is damaged"):
        opened(tmp_path / "text.h5")
    whole = path.read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="is damaged"):
        opened(tmp_path / "cut.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ValueError, match="is an HDF5 file, but not an episode file"):
        opened(tmp_path / "other.h5")
    with pytest.raises(ValueError, match="format version 0, and this program reads versions 1 and 2; collect"):
        opened(write_file(tmp_path / "old.h5", version=0))
    lost = write_file(tmp_path / "lost.h5")
    with h5py.File(lost, "a") as file:
        del file["episode/instruction"]
    with pytest.raises(ValueError, match=r"is damaged: .*instruction"):
        opened(lost)
    short = write_file(tmp_path / "short.h5")
    with h5py.File(short, "a") as file:
        file["episode/length"][3] = 2
    with pytest.raises(ValueError, match="is damaged: 60 frames, but its index tells 59"):
        opened(short)
    with pytest.raises(ValueError, match="first must be at least 1 episode, not 0"):
        opened(path, 0)


FRAMES = np.random.default_rng(0).integers(0, 256, (12, 16, 16, 3), np.uint8)
DAMAGES = {
    "0 to 1": ({"frames": FRAMES / np.float32(255)}, "frames must be uint8 (N, H, H, 3), square and RGB, not float32"),
    "gray": ({"frames": FRAMES[..., 0]}, "not uint8 (12, 16, 16)"),
    "one channel": ({"frames": FRAMES[..., :1]}, "not uint8 (12, 16, 16, 1)"),
    "alpha": ({"frames": FRAMES[..., [0, 1, 2, 0]]}, "not uint8 (12, 16, 16, 4)"),
    "channels first": ({"frames": FRAMES.transpose(0, 3, 1, 2)}, "not uint8 (12, 3, 16, 16)"),
    "not square": ({"frames": FRAMES[:, :12]}, "not uint8 (12, 12, 16, 3)"),
    "no array": ({"frames": 3}, "frames must be uint8"),
    "negative": ({"episode/length": [9, -1, 4]}, "lengths of its episodes must be whole numbers (E,), each at least 1"),
    "empty episode": ({"episode/length": [5, 7, 0], "episode/start": [0, 5, 12]}, "each at least 1"),
    "fractions": ({"episode/length": [4.0, 4.0, 4.0]}, "must be whole numbers"),
    "none": ({"frames": FRAMES[:0], "episode/length": np.zeros(0, int), "episode/start": []}, "it has no episode"),
    "gaps": ({"episode/start": [0, 5, 8]}, "12 frames, but its index tells 12, which must stand one after another"),
    "numbers": ({"episode/instruction": [1, 2, 3]}, "its instructions must be sentences, not int64"),
    "too few": ({"episode/instruction": ["a", "b"]}, "episode/instruction has shape (2,), for 3 episodes"),
    "no text": ({"episode/instruction": [b"a", b"b", b"\xff"]}, "codec can't decode"),
    "other seeds": ({"episode/seed": [1, 2]}, "episode/seed has shape (2,)"),
    "other masks": ({"segmentation": FRAMES[:, :8, :, 0]}, "segmentation has shape (12, 8, 16)"),
    "other actions": ({"action": np.zeros((11, 5))}, "action has shape (11, 5), for 3 episodes, 12 frames"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_arrays_that_do_not_fit_are_named_on_opening(tmp_path: Path, kind: str) -> None:
    damage, said = DAMAGES[kind]
    whole = {
        "frames": FRAMES,
        "episode/length": [4, 4, 4],
        "episode/start": [0, 4, 8],
        "episode/instruction": ["x"] * 3,
    }
    for name, arrays in {"whole": whole, "damaged": whole | damage}.items():
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file.attrs.update({"format": "textocvp-episodes", "format_version": 2})
            for key, values in arrays.items():
                file[key] = values
    assert len(open_episodes(tmp_path / "whole.h5")) == 3
    with pytest.raises(ValueError, match=rf"damaged\.h5 is .*damaged: .*{re.escape(said)}"):
        open_episodes(tmp_path / "damaged.h5")


def test_a_folder_is_no_episode_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        EpisodeFile(tmp_path)
    with pytest.raises(ValueError, match="not an episode file, nor of another format"):
        open_episodes(tmp_path)
