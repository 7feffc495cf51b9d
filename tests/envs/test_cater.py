"""CATER-hard: what clips may contain, what captions say, and that pictures show it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import combinations

import h5py
import numpy as np
import pytest

from envs.cater import ACTIONS, Act, CaterConfig, Clip, Table, Thing, cell, draw_acts, draw_clip, read_caption
from envs.cater.scenes import FRAMES, LIFT, TABLE, hidden
from envs.collect import Args, main
from envs.dataset import collect

SEEDS = range(60)
EXPLICIT = re.compile(
    r"the (small|medium|large) \w+ (rubber|metal) (cone|cube|cylinder|sphere|snitch) is "
    r"(rotating|(sliding|picked up and placed) to \((-[123]|[123]), (-[123]|[123])\)"
    r"|picked up and containing the (small|medium) \w+ (rubber|metal) (cone|sphere|snitch))\."
)


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return [draw_clip(np.random.default_rng(seed)) for seed in SEEDS]


@pytest.fixture(scope="module")
def table():
    made = Table(64)
    yield made
    made.close()


def thing(shape="cube", size="medium", place=(0.0, 0.0), color="red", material="rubber") -> Thing:
    return Thing(shape, size, material, color, place, 0.0)


def test_scenes_hold_what_cater_holds(clips):
    things = [one for clip in clips for one in clip.things]
    assert {one.shape for one in things} == set(ACTIONS)
    assert {one.size for one in things} == {"small", "medium", "large"}
    assert len({one.color for one in things}) == 9  # eight and gold
    assert all(2 <= len(clip.things) <= 8 for clip in clips)
    assert all((one.shape == "snitch") == (one.color == "gold") for one in things)
    alike = sum(len({one.name for one in clip.things}) < len(clip.things) for clip in clips)
    assert alike > len(clips) // 10  # whole things repeat
    assert all(max(hidden(clip.things)) <= 0.5 for clip in clips)


def test_two_things_act_and_all_actions_occur(clips):
    for clip in clips:
        first, second = clip.acts
        assert first.thing != second.thing
        for act in clip.acts:
            assert act.action in ACTIONS[clip.things[act.thing].shape]
            assert 0 <= act.start <= 10 and act.stop - act.start >= 20 and act.stop <= FRAMES
            if act.into is not None:
                assert clip.things[act.thing].shape == "cone"
                assert clip.things[act.into].radius < clip.things[act.thing].radius
                assert act.into not in (first.thing, second.thing)
    assert {act.action for clip in clips for act in clip.acts} == {"rotate", "slide", "pick-place", "contain"}


def test_nothing_is_pushed(clips):
    for clip in clips:
        inside = {frozenset((act.thing, act.into)) for act in clip.acts if act.into is not None}
        for frame in range(FRAMES + 1):
            centers, _ = clip.poses(frame)
            for a, b in combinations(range(len(clip.things)), 2):
                if frozenset((a, b)) in inside:
                    continue
                gap = clip.things[a].radius + clip.things[b].radius
                off = np.abs(centers[a] - centers[b])
                assert np.hypot(*off[:2]) > gap or off[2] > gap


def test_others_rest_and_motions_go_where_they_must(clips):
    for clip in clips:
        (before, _), (after, _) = clip.poses(0), clip.poses(FRAMES)
        for k in range(len(clip.things)):
            act = next((act for act in clip.acts if act.thing == k), None)
            where = clip.things[k].place if act is None or act.to is None else act.to
            assert np.allclose(after[k, :2], where)
            assert after[k, 2] == pytest.approx(before[k, 2])
            highest = max(clip.poses(frame)[0][k, 2] for frame in np.linspace(0, FRAMES, 200))
            lifted = act is not None and act.action in ("pick-place", "contain")
            assert highest - before[k, 2] == pytest.approx(LIFT if lifted else 0, abs=0.02)
        assert np.abs(after[:, :2]).max() <= TABLE


def test_captions_follow_the_published_grammar(clips):
    for clip in clips:
        sentences = re.findall(r"the .*?\.", clip.instruction)
        assert len(sentences) == 2 and all(EXPLICIT.fullmatch(one) for one in sentences)
        order = sorted(act.thing for act in clip.acts)
        assert [one.startswith(f"the {clip.things[k].name} is") for one, k in zip(sentences, order, strict=True)] == [
            True, True,
        ]  # fmt: skip


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.5, 2.5), (1, 3)),
        ((-0.5, -2.5), (-1, -3)),
        ((0.0, 3.0), (-1, 3)),
        ((1.0, -1.0), (1, -2)),
        ((-3.0, 1.1), (-3, 2)),
    ],
)
def test_cells_have_no_zero(place, expected):
    assert cell(place) == expected


def test_ambiguous_captions_say_less():
    clip = Clip(
        (thing("cube", place=(-2.0, 2.0)), thing("sphere", "small", (2.0, 2.0), "blue", "metal")),
        (Act(0, "slide", 0, 20, (2.0, -2.0)), Act(1, "pick-place", 0, 20, (-2.0, -2.0))),
    )
    said = [clip.ambiguous(np.random.default_rng(seed)) for seed in range(40)]
    assert all("the fourth quadrant" in one and "the third quadrant" in one for one in said)
    assert all("cube" in one and "sphere" in one and "(" not in one for one in said)
    assert len({one for one in said}) > 10
    assert any("red" not in one for one in said) and any("red" in one for one in said)


def test_actions_can_be_asked_for():
    things = (thing("cone", "large"), thing("sphere", "small", (2.0, 2.0)), thing("cube", "small", (-2.0, -2.0)))
    for seed in range(5):
        acts = draw_acts(np.random.default_rng(seed), things, first=(0, "contain"))
        assert acts is not None
        assert (acts[0].action, acts[0].into) == ("contain", 1)
    assert draw_acts(np.random.default_rng(0), things, first=(2, "contain")) is None  # a cube contains nothing


def test_pictures_show_the_clip(table):
    clip = Clip(
        (thing("cone", "large", (-1.5, 0.5)), thing("sphere", "small", (1.5, 0.5), "yellow", "metal")),
        (Act(0, "contain", 0, 30, (1.5, 0.5), 1), Act(1, "rotate", 0, 20)),
    )
    clip = replace(clip, acts=clip.acts[:1])
    table.build(clip, np.zeros(3))
    (first, labels), (_, late) = table.render(0), table.render(FRAMES)
    assert first.shape == (64, 64, 3) and first.dtype == np.uint8
    for k, low in ((0, 3), (1, 1)):  # most of a cone is below its middle
        y, x = (labels == 1 + k).nonzero()
        u, v = table.camera.project(clip.poses(0)[0][k])
        assert abs(x.mean() + 0.5 - u) < 1 and -1 < y.mean() + 0.5 - v < low
    assert (labels == 2).sum() > 4 and (late == 2).sum() == 0  # what is contained is hidden
    red = first[labels == 1].mean(0)
    assert red[0] > 2 * red[1] and red[0] > 2 * red[2]
    alone = np.array([[not labels[y - 2 : y + 3, x - 2 : x + 3].any() for x in range(2, 62)] for y in range(2, 62)])
    floor = first[2:62, 2:62][alone].astype(int)
    assert np.ptp(floor, axis=-1).max() <= 3  # gray, and with shadows: some of it is darker than elsewhere
    assert floor.min() < 0.9 * np.median(floor)


def test_metal_shines(table):
    bright = {}
    for material in ("rubber", "metal"):
        clip = Clip((thing("sphere", "large", material=material, color="gray"),), ())
        table.build(clip, np.zeros(3))
        frame, labels = table.render(0)
        bright[material] = int(frame[labels == 1].max())
    assert bright["metal"] > bright["rubber"] + 15


def test_a_file_is_the_same_for_any_number_of_workers(tmp_path):
    config = CaterConfig("val", 32)
    collect(config, 5, tmp_path / "one.h5", workers=1)
    collect(config, 3, tmp_path / "two.h5", workers=2)
    collect(config, 5, tmp_path / "two.h5", workers=2)
    with h5py.File(tmp_path / "one.h5") as one, h5py.File(tmp_path / "two.h5") as two:
        names = [
            name for name in ("frames", "segmentation", "object_position", *(f"episode/{n}" for n in one["episode"]))
        ]
        assert all(np.array_equal(one[name][:], two[name][:], equal_nan=name == "object_position") for name in names)
        assert json.loads(one.attrs["labels"]) == {"background": 0}
        objects = json.loads(one["episode/objects"].asstr()[0])
        assert {"id", "label", "kind", "color", "size", "material"} == set(objects[0])
        acts = json.loads(one["episode/actions"].asstr()[0])
        assert len(acts) == 2 and {"thing", "action", "to"} <= set(acts[0])


def test_what_a_file_says_of_its_camera_needs_no_simulator(monkeypatch):
    """Which is 28 MB, and would be opened for every fifty clips."""
    camera = CaterConfig("val", 32).make().camera
    monkeypatch.setattr("pybullet.connect", lambda *args: pytest.fail("a simulator was opened"))
    assert np.array_equal(CaterConfig("val", 32).attributes["camera_intrinsics"], camera.intrinsics)


def test_the_command_line_names_what_does_not_go_together(tmp_path):
    with pytest.raises(ValueError, match="--scene is not for --world cater"):
        Args(world="cater", scene="cliport")
    with pytest.raises(ValueError, match="--captions is not for --world tabletop"):
        Args(captions="ambiguous")
    with pytest.raises(ValueError, match="train, val, test, not unseen_colors"):
        Args(world="cater", split="unseen_colors")
    main(Args(world="cater", split="val", episodes=2, image_size=32, out=tmp_path / "a.h5", captions="ambiguous"))
    with h5py.File(tmp_path / "a.h5") as file:
        assert all(
            "quadrant" in one or "rotating" in one or "containing" in one
            for one in file["episode/instruction"].asstr()[:]
        )


# ---- captions that are read back


def rewritten(clip: Clip, text: str, seed: int = 0) -> Clip:
    return read_caption(text, clip.things, np.random.default_rng(seed))


def test_captions_are_read_as_they_are_written(clips) -> None:
    for clip in clips:
        read = rewritten(clip, clip.instruction)
        said, again = (sorted(one.instruction.removesuffix(".").split(". ")) for one in (clip, read))
        assert again == said
        loose = clip.ambiguous(np.random.default_rng(1))
        read = rewritten(clip, loose)
        for sentence, act in zip(loose.split(". "), sorted(clip.acts, key=lambda act: act.thing), strict=True):
            # What it says is true of one of the acts: the action, the words of the name, and the quadrant.
            name = sentence.removeprefix("the ").split(" is ")[0].split()
            kept = [a for a in read.acts if a.action == act.action and {*name} <= {*clip.things[a.thing].name.split()}]
            assert kept
            if act.to is not None and act.into is None:
                assert any((a.to[0] > 0, a.to[1] > 0) == (act.to[0] > 0, act.to[1] > 0) for a in kept if a.to)


def test_a_caption_without_full_stop_or_of_one_sentence_is_read() -> None:
    clip = Clip((thing(), thing("sphere", place=(2.0, 2.0))), ())
    (act,) = rewritten(clip, "The red CUBE is sliding to -2, 2").acts
    assert act.thing == 0 and cell(act.to) == (-2, 2)
    assert rewritten(clip, "the cube is rotating", 3) == rewritten(clip, "the cube is rotating", 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "one or two sentences"),
        ("the cube is rotating. the cube is rotating. the cube is rotating.", "not 3"),
        ("put the red block in the bowl", "cannot read"),
        ("the blue cube is rotating", "no blue cube is here; here are: medium red rubber cube"),
        ("the sphere is rotating", "a sphere is never rotating"),
        ("the cube is rotating. the red cube is sliding to (1, 1)", "different things"),
        ("the cube is sliding to (0, 2)", "without 0"),
        ("the cube is sliding", "cannot read"),
        ("the cube is sliding to (2, 4)", "places are cells"),
        ("the cube is sliding to the fifth quadrant", "quadrants"),
        ("the cone is picked up and containing the cube", "contains smaller"),
        ("the cone is picked up and containing", "no name is here"),
        ("the cone is picked up and containing the sphere. the sphere is sliding to (1, 1)", "different things"),
        ("the cube is sliding to (2, 2)", "pushing"),
    ],
)  # fmt: skip
def test_what_no_caption_of_the_scene_is_gets_a_sentence(text, said) -> None:
    things = (thing(), thing("sphere", "small", (1.5, 1.5)), thing("cone", "large", (-2.0, -2.0)))
    with pytest.raises(ValueError, match=re.escape(said)):
        rewritten(Clip(things, ()), text)
