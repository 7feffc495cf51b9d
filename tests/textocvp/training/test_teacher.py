"""Masks that videos give of themselves, and the changes of light under which they teach."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.textocvp.conftest import VOTES, build
from tests.textocvp.toy_episodes import write_toy_episodes
from tests.textocvp.training.runs import losses, parser_run, same_weights, train, train_killed_after, weights
from textocvp.checkpoint import read_config
from textocvp.data.episodes import EpisodeFile, Episodes, Truth
from textocvp.presets import PRESETS
from textocvp.training.light import relight
from textocvp.training.parser import ParserTraining
from textocvp.training.run import SettingsError
from textocvp.training.teacher import Teacher, backdrop, video_masks

FLOOR, TABLE, DARK, LIGHT = (200, 204, 198), (60, 58, 62), (30, 30, 34), (110, 110, 112)


def painted() -> tuple[np.ndarray, np.ndarray]:
    """A clip (6, 48, 48, 3) and its labels: an arm of two grays sweeps over two blocks in bowls and a gray block."""
    labels = np.zeros((6, 48, 48), np.uint8)
    frames = np.empty((6, 48, 48, 3), np.uint8)
    frames[:, :24], frames[:, 24:] = FLOOR, TABLE
    things = [(2, 28, 4, 12, (200, 60, 60)), (3, 32, 8, 4, (60, 90, 200)), (4, 28, 34, 6, (186, 176, 172))]
    for label, top, left, side, color in things:
        labels[:, top : top + side, left : left + side] = label
        frames[:, top : top + side, left : left + side] = color
    for t in range(6):
        arm = np.s_[t, :30, 14 + 2 * t : 18 + 2 * t]
        labels[arm], frames[arm] = 1, LIGHT
        frames[t, 15:30, 14 + 2 * t : 18 + 2 * t] = DARK
    return frames, labels


def test_a_clean_video_gives_its_own_masks() -> None:
    frames, labels = painted()
    behind = backdrop(frames)
    assert sorted(behind.tones_N3.tolist()) == sorted([list(map(float, FLOOR)), list(map(float, TABLE))])
    found = video_masks(frames, behind)
    for mine, truth in zip(found, labels, strict=True):
        assert np.array_equal(mine == 0, truth == 0) and np.array_equal(mine == 1, truth == 1)
        for label in (2, 3, 4):
            number = np.unique(mine[truth == label])
            assert len(number) == 1 and np.array_equal(mine == number, truth == label)


def test_mixed_colours_at_a_border_belong_to_what_they_are_mostly() -> None:
    frames, labels = painted()
    behind = backdrop(frames)
    # A row of pixels above the upper block in a bowl shows a fifth of it, the row below it nine tenths.
    block = np.array((200, 60, 60), float)
    for row, share in ((27, 0.2), (40, 0.9)):
        frames[0, row, 4:13] = share * block + (1 - share) * np.array(TABLE, float)
    found = video_masks(frames[:1], behind)[0]
    assert np.array_equal(found[27, 4:13] > 0, np.zeros(9, bool))
    assert np.array_equal(found[40, 5:12] == found[38, 10], np.ones(7, bool))
    assert np.array_equal(found[28:40] > 0, labels[0, 28:40] > 0)


def test_a_gray_block_that_the_arm_touches_is_no_part_of_it() -> None:
    frames, labels = painted()
    touching = np.s_[5, 12:30, 30:34]
    frames[touching], labels[touching] = DARK, 1
    found = video_masks(frames, backdrop(frames))[5]
    assert np.array_equal(found == 1, labels[5] == 1)
    assert len(np.unique(found[labels[5] == 4])) == 1


def test_a_block_of_nearly_its_bowls_hue_is_a_thing_of_its_own() -> None:
    frames, labels = painted()
    bowl, block = np.array((120, 125, 140)), np.array((125, 120, 112))
    frames[:, 30:42, 34:46], labels[:, 28:42, 34:46] = bowl, 0
    labels[:, 30:42, 34:46] = 4
    frames[:, 28:30, 34:46] = TABLE
    frames[:, 33:39, 37:43] = (bowl + block) // 2  # a ring of mixed colours
    frames[:, 34:38, 38:42], labels[:, 34:38, 38:42] = block, 5
    found = video_masks(frames[:1], backdrop(frames))[0]
    its, around = np.unique(found[labels[0] == 5]), np.unique(found[30:32, 34:46])
    assert len(its) == len(around) == 1 and its != around and its > 1 < around
    assert np.isin(found[30:42, 34:46], [its, around]).all()


def test_a_block_with_a_face_in_shade_is_one_thing() -> None:
    frames, _ = painted()
    frames[:, 28:34, 34:40], frames[:, 34, 34:40], frames[:, 35:40, 34:40] = (66, 123, 46), (52, 97, 36), (39, 71, 27)
    found = video_masks(frames[:1], backdrop(frames))[0]
    assert len(np.unique(found[28:40, 34:40])) == 1 and found[30, 36] > 1


@pytest.mark.parametrize("kind", ["video", "masks"])
def test_labels_are_those_of_the_clips_frames(tmp_path: Path, kind: str) -> None:
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", [9, 8])) as episodes:
        frames, teacher = episodes.clips(np.array([2, 10]), 5), Teacher(kind, episodes)
        labels = teacher.labels(np.array([2, 10]), frames[:, ::2], 2)
        assert labels.shape == (2, 3, 32, 32)
        if kind == "masks":
            assert np.array_equal(labels[1], episodes.truth(1).segmentation[1:6:2])
        again = teacher.labels(np.array([14]), frames[1:, 4:], 1)
        assert np.array_equal(again[0, 0], labels[1, 2])


def test_light_changes_pictures_and_moves_labels_with_them() -> None:
    frames, labels = painted()
    flips = 0
    for seed in range(12):
        lit, seen = relight(frames, labels, np.random.default_rng(seed))
        again, _ = relight(frames, labels, np.random.default_rng(seed))
        assert lit.dtype == np.uint8 and np.array_equal(lit, again)
        mirrored = not np.array_equal(seen, labels)
        assert np.array_equal(seen, labels[:, :, ::-1] if mirrored else labels)
        flips += mirrored
        # Whatever the light, the dark table stays darker than the light floor.
        assert lit[:, :20][seen[:, :20] == 0].mean() > lit[:, 40:][seen[:, 40:] == 0].mean()
    assert 0 < flips < 12


@pytest.mark.parametrize("teacher", ["video", "masks"])
def test_a_killed_run_continues_exactly(folder: Path, monkeypatch: pytest.MonkeyPatch, teacher: str) -> None:
    monkeypatch.setitem(PRESETS, VOTES.name, VOTES)
    settings = dict(preset=VOTES.name, steps=4, batch=3, clip=1, first_redraw=2, teacher=teacher)
    straight, resumed, parts = (
        parser_run(folder, name, **settings, **more)
        for name, more in (("straight", {}), ("resumed", {}), ("parts", {"accumulate": 3}))
    )
    train(straight)
    train_killed_after(resumed, 2)
    train(resumed)
    assert same_weights(straight.out, resumed.out)
    train(parts)
    assert losses(parts.out) == pytest.approx(losses(straight.out), rel=1e-3)


def test_a_renderer_waits_only_for_a_parser_that_is_taught(folder: Path) -> None:
    """And what cannot be done is known before `fresh` throws a run away."""
    done = parser_run(folder, "done", steps=1)
    train(done)
    before = weights(done.out)
    for changes, said in (
        ({"first_redraw": 2}, "first_redraw is for parsers that are taught"),
        ({"only": "sight"}, "only sight is for parsers that are taught"),
        ({"only": "renderer"}, "only renderer goes on from a whole checkpoint"),
        ({"clip": 50}, "need episodes of"),
        ({"cache_features": True}, "needs a frozen image encoder"),
    ):
        with pytest.raises(SettingsError, match=said):
            train(replace(done, fresh=True, **changes))
    assert all(torch.equal(tensor, before[name]) for name, tensor in weights(done.out).items())


def test_a_teacher_without_masks_says_so(tmp_path: Path) -> None:
    path = write_toy_episodes(tmp_path / "toy.h5", [9], truth=False)
    with EpisodeFile(path) as episodes, pytest.raises(ValueError, match="has no masks to teach with"):
        Teacher("masks", episodes).labels(np.array([0]), episodes.clips(np.array([0]), 1), 1)
    run = ParserTraining(path, path, tmp_path / "out", preset="cater", set=("parser.image_size=32",), clip=1)
    with pytest.raises(SettingsError, match="has no masks to teach with: leave out --teacher masks"):
        train(replace(run, teacher="masks"))


def test_every_label_teaches_a_thing_of_its_own() -> None:
    class Labelled:
        truth = staticmethod(lambda index: Truth(segmentation=np.array([[[0, 1, 2], [254, 255, 255]]], np.uint8)))

    given = Teacher("masks", cast(Episodes, Labelled()))._given(0)
    assert given[0, 0, 0] == 0 and len(np.unique(given)) == 5 and not (given == 1).any()


def test_a_taught_parser_is_taken_as_it_is(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, VOTES.name, VOTES)
    settings = dict(preset=VOTES.name, steps=2, batch=3, clip=1)
    lesson = parser_run(folder, "lesson", first_redraw=2, **settings)
    train(lesson)
    taken = parser_run(folder, "taken", taught=lesson.out / "checkpoint", seed=1, **settings)
    train(taken)
    before, after = weights(lesson.out), weights(taken.out)
    network = [name for name in before if name.startswith("parser.network.")]
    assert network and all(torch.equal(before[name], after[name]) for name in network)
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed >= {"parser", "renderer"}  # what its slots hold, and how they are drawn
    with pytest.raises(SettingsError, match=r"parser\.kind=votes"):
        train(parser_run(folder, "other", preset="tabletop-small", taught=lesson.out / "checkpoint"))
    with pytest.raises(SettingsError, match="has another network"):
        train(replace(taken, out=folder / "wide", set=("parser.channels=8",)))


def test_what_alone_goes_on_learning_leaves_all_else_of_a_whole_model(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PRESETS, VOTES.name, VOTES)
    whole = folder / "whole"
    build(VOTES).save_pretrained(whole)
    settings = dict(preset=VOTES.name, steps=2, batch=3, clip=1, start=whole)
    runs = {only: parser_run(folder, f"only {only}", only=only, **settings) for only in ("all", "sight", "renderer")}
    for run in runs.values():
        train(run)
    train(replace(runs["sight"], steps=3))
    with pytest.raises(SettingsError, match="holds a run with only 'sight', not 'all'"):
        train(replace(runs["sight"], only="all", steps=4))
    before = load_file(whole / "model.safetensors")
    for only, prefix in (("sight", "parser.network."), ("renderer", "renderer.")):
        after = weights(runs[only].out)
        assert before.keys() == after.keys()
        changed = [name for name in before if not torch.equal(before[name], after[name])]
        assert changed and all(name.startswith(prefix) for name in changed)
    stages = [read_config(run.out / "checkpoint").stage for run in runs.values()]
    assert stages == ["parser", "predictor", "predictor"]  # where slots hold other things no predictor knows them


def test_on_a_floor_in_uneven_light_shadows_are_floor_and_gray_things_are_not() -> None:
    y, x = np.mgrid[-1:1:48j, -1:1:48j]
    floor = 165 * (1 - 0.1 * (x**2 + y**2))
    frames = np.repeat(floor[None, ..., None], 3, 3).repeat(6, 0)
    labels = np.zeros((6, 48, 48), int)
    for t in range(6):
        frames[t, 30:36, 4 + 3 * t : 14 + 3 * t] *= 0.75  # the shadow of what moves
        for label, top, left, color in ((1, 20, 6 + 3 * t, (190, 40, 40)), (2, 8, 34, (60, 60, 60))):
            labels[t, top : top + 8, left : left + 8] = label
            frames[t, top : top + 8, left : left + 8] = color
    frames = frames.round().astype(np.uint8)
    behind = backdrop(frames)
    assert behind.floor_HW is not None and np.abs(behind.floor_HW - floor).max() < 2
    found = video_masks(frames, behind)
    assert np.array_equal(found > 0, labels > 0)
    for mine, truth in zip(found, labels, strict=True):
        assert [len(np.unique(mine[truth == label])) for label in (1, 2)] == [1, 1]
        assert len(np.unique(mine)) == 3 and not (mine == 1).any()  # no robot


@pytest.mark.parametrize(("share", "is_thing"), [(0.4, False), (0.6, True)])
def test_an_edge_on_an_uneven_floor_is_the_thing_where_it_is_mostly_the_thing(share: float, is_thing: bool) -> None:
    y, x = np.mgrid[-1:1:48j, -1:1:48j]
    frames = np.repeat((165 * (1 - 0.1 * (x**2 + y**2)))[None, ..., None], 3, 3).repeat(3, 0)
    edge, inside = np.zeros((48, 48), bool), np.zeros((48, 48), bool)
    edge[19:29, 19:29], inside[20:28, 20:28] = True, True
    frames[:, inside] = (190, 40, 40)
    edge &= ~inside
    frames[:, edge] += share * (np.array((190, 40, 40)) - frames[:, edge])
    frames = frames.round().astype(np.uint8)
    found = video_masks(frames, backdrop(frames))
    assert np.array_equal(found[0] > 0, inside | edge if is_thing else inside)
