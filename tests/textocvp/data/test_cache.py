"""Caches: computed once, resumed where computing was killed, shared, and refused where they do not belong."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import textocvp.data.cache as module
from tests.textocvp.conftest import PLACED, PUBLISHED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.data.cache import CacheError, FrameCache, cached_slots, parser_fingerprint
from textocvp.data.episodes import EpisodeFile
from textocvp.data.slot_batches import padded
from textocvp.parsers.base import to_frames

LENGTHS = [6, 4, 6, 5, 6]


@pytest.fixture
def episodes(tmp_path: Path):
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", LENGTHS)) as file:
        yield file


class Numbers:
    """Stands for a frozen network: every frame's value is its number, and it knows what it was asked for."""

    def __init__(self, episodes: EpisodeFile, fail_at: int | None = None) -> None:
        self.episodes, self.fail_at, self.asked = episodes, fail_at, []

    def __call__(self, chosen: range) -> np.ndarray:
        self.asked.append(chosen)
        if len(self.asked) == self.fail_at:
            raise KeyboardInterrupt
        starts = self.episodes.starts
        return np.concatenate([starts[i] + np.arange(self.episodes.lengths[i]) for i in chosen])[:, None]


@pytest.fixture
def numbers(episodes: EpisodeFile, monkeypatch: pytest.MonkeyPatch) -> Numbers:
    monkeypatch.setattr(module, "PART", 2)
    return Numbers(episodes)


def open_cache(episodes: EpisodeFile, folder: Path, network: str = "network") -> FrameCache:
    return FrameCache(folder, episodes, network)


def test_values_are_found_by_episode_by_time_and_by_clip(episodes, numbers, tmp_path) -> None:
    cache = open_cache(episodes, tmp_path / "c").fill(numbers)
    assert cache.values[:, 0].tolist() == list(range(sum(LENGTHS))) and len(cache) == 5
    assert cache.episode(2)[:, 0].tolist() == [10, 11, 12, 13, 14, 15]
    at = cache.at(np.array([3, 1]), np.array([0, 3, 5]))[..., 0]
    assert at.tolist() == [[16, 19, 20], [6, 9, 9]]  # the last frame of a short episode stays
    for source in (cache, pickle.loads(pickle.dumps(cache))):
        clips = source.clips(np.array([21, 10, 0]), 5, 2)[..., 0]
        assert clips.tolist() == [[21, 23, 25], [10, 12, 14], [0, 2, 4]]


def test_second_time_nothing_is_computed(episodes, numbers, tmp_path) -> None:
    open_cache(episodes, tmp_path / "c").fill(numbers)
    assert numbers.asked == [range(0, 2), range(2, 4), range(4, 5)]
    open_cache(episodes, tmp_path / "c").fill(lambda chosen: pytest.fail("computed again"))


def test_processes_share_the_work(episodes, numbers, tmp_path) -> None:
    alone = open_cache(episodes, tmp_path / "alone").fill(numbers)
    numbers.asked.clear()
    first, second = (open_cache(episodes, tmp_path / "shared") for _ in range(2))
    second.fill(numbers, 1, 2)
    assert numbers.asked == [range(2, 4)]
    with pytest.raises(CacheError, match=r"000000\.h5 is missing: the cache is not complete"):
        _ = second.values
    first.fill(numbers, 0, 2)
    assert numbers.asked == [range(2, 4), range(0, 2), range(4, 5)]
    for cache in (first, second):
        assert np.array_equal(cache.values, alone.values)


def test_killed_work_goes_on_and_gives_the_same(episodes, numbers, tmp_path) -> None:
    with pytest.raises(KeyboardInterrupt):
        open_cache(episodes, tmp_path / "c").fill(Numbers(episodes, fail_at=3))
    resumed = open_cache(episodes, tmp_path / "c").fill(numbers)
    assert numbers.asked == [range(4, 5)]  # only what was missing
    whole = open_cache(episodes, tmp_path / "other").fill(Numbers(episodes))
    assert np.array_equal(resumed.values, whole.values)
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["000000.h5", "000002.h5", "000004.h5"]


def test_what_does_not_belong_is_refused(episodes, numbers, tmp_path) -> None:
    folder = tmp_path / "c"
    open_cache(episodes, folder).fill(numbers)
    with pytest.raises(CacheError, match=r"made by another network \(network, wanted other\): delete"):
        open_cache(episodes, folder, "other")
    with (
        EpisodeFile(write_toy_episodes(tmp_path / "other.h5", LENGTHS, seed=1)) as others,
        pytest.raises(CacheError, match="made from other episodes"),
    ):
        open_cache(others, folder)
    with EpisodeFile(episodes.path, first=3) as fewer, pytest.raises(CacheError, match="made from other episodes"):
        open_cache(fewer, folder)
    (folder / "000002.h5").write_bytes(b"no HDF5")
    with pytest.raises(CacheError, match=r"000002\.h5 is no cache, or damaged"):
        open_cache(episodes, folder)


def test_slots_are_those_of_the_parser(episodes, tmp_path) -> None:
    model = build(PLACED)
    cache = cached_slots(model, episodes, tmp_path / "slots")
    assert cache.instructions == episodes.instructions and cache.lengths.tolist() == LENGTHS
    for index in (1, 4):
        with torch.no_grad():
            slots = model.parser(to_frames(episodes.frames(index)[None])).slots_BTKD[0]
        found = torch.from_numpy(cache.episode(index)).float()
        torch.testing.assert_close(found, slots, atol=2e-3, rtol=2e-3)  # float16
    short = padded(cache, 5)
    assert short.shape[:2] == (5, 5)
    assert torch.equal(short[1, 4], short[1, 3])  # the last frame of a short episode stays
    assert torch.equal(short[0], padded(cache, 6)[0, :5])  # a long one is cut


def test_slots_of_some_frames_stay_until_the_next(episodes, tmp_path) -> None:
    model = build(PLACED)
    cache = cached_slots(model, episodes, tmp_path / "slots", every=3)
    assert cache.lengths.tolist() == LENGTHS
    for index, length in enumerate(LENGTHS):
        times = sorted({0, *range(length - 1, 0, -3)})
        with torch.no_grad():
            slots_SKD = model.parser(to_frames(episodes.frames(index)[times][None])).slots_BTKD[0]
        latest = [max(i for i, time in enumerate(times) if time <= t) for t in range(length)]
        found = torch.from_numpy(cache.episode(index)).float()
        torch.testing.assert_close(found, slots_SKD[latest], atol=2e-3, rtol=2e-3)
    with pytest.raises(CacheError, match="made by another network"):
        cached_slots(model, episodes, tmp_path / "slots")


def test_slots_of_another_parser_are_refused(episodes, tmp_path) -> None:
    model = build(PLACED)
    cached_slots(model, episodes, tmp_path / "slots")
    with torch.no_grad():
        next(model.predictor.parameters()).add_(1.0)  # not the parser
    cached_slots(model, episodes, tmp_path / "slots")
    with torch.no_grad():
        next(model.parser.parameters()).add_(1e-3)
    with pytest.raises(CacheError, match="made by another network"):
        cached_slots(model, episodes, tmp_path / "slots")


def test_fingerprint_covers_configuration() -> None:
    wider = replace(PLACED, parser=replace(PLACED.parser, num_slots=9))
    assert parser_fingerprint(build(PLACED)) == parser_fingerprint(build(PLACED))
    assert parser_fingerprint(build(PLACED)) != parser_fingerprint(build(wider))


def test_slots_of_the_published_parser(episodes, tmp_path) -> None:
    """Its first slots are drawn, with a seed."""
    cache, again = (cached_slots(build(PUBLISHED), episodes, tmp_path / name) for name in "ab")
    assert cache.values.shape == (27, 4, 12) and cache.values.dtype == np.float16
    assert np.array_equal(cache.values, again.values)
