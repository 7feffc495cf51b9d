"""The slot cache: found once, resumed where it was killed, refused where it does not belong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import textocvp.data.slot_cache as module
from tests.textocvp.conftest import PLACED, PUBLISHED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.data.episodes import EpisodeFile
from textocvp.data.slot_cache import SlotCache, SlotCacheError, cached_slots, parse_share, parser_fingerprint


@pytest.fixture
def episodes(tmp_path: Path):
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", [6, 4, 6, 5, 6])) as file:
        yield file


def test_slots_are_those_of_the_parser(episodes, tmp_path):
    model = build(PLACED)
    cache = cached_slots(model, episodes, tmp_path / "slots.h5", batch=2)
    assert cache.lengths.tolist() == [6, 4, 6, 5, 6]
    assert cache.instructions == list(episodes.instructions)
    for index in (1, 4):
        frames = (
            torch.from_numpy(episodes.episode(index).frames).permute(0, 3, 1, 2)[None].float() / 127.5 - 1
        )
        with torch.no_grad():
            slots = model.parser(frames).slots_BTKD[0]
        torch.testing.assert_close(cache.episode(index), slots, atol=2e-3, rtol=2e-3)  # float16
    padded = cache.padded(5)
    assert padded.shape[:2] == (5, 5)
    assert torch.equal(padded[1, 4], padded[1, 3])  # the last frame of a short episode stays
    assert torch.equal(padded[0], cache.padded(6)[0, :5])  # a long one is cut


def test_second_time_nothing_is_parsed(episodes, tmp_path, monkeypatch):
    model = build(PLACED)
    first = cached_slots(model, episodes, tmp_path / "slots.h5")
    monkeypatch.setattr(module, "_parse", lambda *_: pytest.fail("parsed again"))
    second = cached_slots(model, episodes, tmp_path / "slots.h5")
    assert np.array_equal(first.slots_NKD, second.slots_NKD)
    assert first.instructions == second.instructions


def test_processes_share_the_parsing(episodes, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "PART", 2)
    model, parse, parsed = build(PLACED), module._parse, []

    def counted(model, episodes, chosen, *rest):
        parsed.append((chosen.start, chosen.stop))
        return parse(model, episodes, chosen, *rest)

    alone = cached_slots(model, episodes, tmp_path / "alone.h5")
    monkeypatch.setattr(module, "_parse", counted)
    shared = tmp_path / "shared.h5"
    parse_share(model, episodes, shared, 1, 2)
    assert parsed == [(2, 4)]
    parse_share(model, episodes, shared, 0, 2)
    assert parsed == [(2, 4), (0, 2), (4, 5)]
    joined = cached_slots(model, episodes, shared)
    assert len(parsed) == 3 and shared.exists() and not module._folder(shared).exists()
    assert np.array_equal(joined.slots_NKD, alone.slots_NKD) and np.array_equal(joined.starts, alone.starts)
    assert joined.instructions == alone.instructions
    parse_share(model, episodes, shared, 1, 2)  # all there
    assert len(parsed) == 3


def test_killed_parsing_goes_on_and_gives_the_same(episodes, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "PART", 2)
    model, parse, calls = build(PLACED), module._parse, []

    def killed_at_the_third_part(model, episodes, chosen, *rest):
        calls.append(chosen)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return parse(model, episodes, chosen, *rest)

    monkeypatch.setattr(module, "_parse", killed_at_the_third_part)
    with pytest.raises(KeyboardInterrupt):
        cached_slots(model, episodes, tmp_path / "slots.h5")
    assert not (tmp_path / "slots.h5").exists()
    resumed = cached_slots(model, episodes, tmp_path / "slots.h5")
    assert calls[3:] == [range(4, 5)]  # only what was missing
    whole = cached_slots(model, episodes, tmp_path / "other.h5")
    assert np.array_equal(resumed.slots_NKD, whole.slots_NKD)
    assert resumed.instructions == whole.instructions == list(episodes.instructions)
    assert [path.name for path in tmp_path.glob("*.parts")] == []


def test_a_cache_of_another_parser_or_other_episodes_is_refused(episodes, tmp_path):
    model, path = build(PLACED), tmp_path / "slots.h5"
    cached_slots(model, episodes, path)
    with torch.no_grad():
        next(model.predictor.parameters()).add_(1.0)  # not the parser
    cached_slots(model, episodes, path)
    with torch.no_grad():
        next(model.parser.parameters()).add_(1e-3)
    with pytest.raises(SlotCacheError, match="another parser"):
        cached_slots(model, episodes, path)
    others = EpisodeFile(write_toy_episodes(tmp_path / "other.h5", [6, 4, 6, 5, 6], seed=1))
    with others, pytest.raises(SlotCacheError, match="another episodes"):
        cached_slots(build(PLACED), others, path)
    (tmp_path / "broken.h5").write_bytes(b"no HDF5")
    with pytest.raises(SlotCacheError, match="damaged"):
        SlotCache.load(tmp_path / "broken.h5")


def test_fingerprint_covers_configuration(episodes):
    wider = replace(PLACED, parser=replace(PLACED.parser, num_slots=9))
    assert parser_fingerprint(build(PLACED)) == parser_fingerprint(build(PLACED))
    assert parser_fingerprint(build(PLACED)) != parser_fingerprint(build(wider))


def test_slots_of_the_published_parser(episodes, tmp_path):
    cache = cached_slots(build(PUBLISHED), episodes, tmp_path / "a.h5")
    again = cached_slots(
        build(PUBLISHED), episodes, tmp_path / "b.h5"
    )  # its first slots are drawn, with a seed
    assert cache.slots_NKD.shape == (27, 4, 12)
    assert np.array_equal(cache.slots_NKD, again.slots_NKD)
