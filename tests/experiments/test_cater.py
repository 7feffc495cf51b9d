"""The study of CATER: how an imagined clip is judged, what is measured, and the steps that train its models."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from envs.cater import Act, Clip, Thing
from experiments.cater import STUDY, Args, Sizes, shown_words
from experiments.report.results import Results
from experiments.study.cater import CaterScene, _next_to, cater_scenes, judge
from experiments.study.frame_metrics import Measures
from experiments.study.run import run
from experiments.train_cater import Args as TrainArgs
from experiments.train_cater import main, steps, wanted
from textocvp.protocols import LoadCheckpoint

CONE = Thing("cone", "large", "metal", "red", (-1.5, 1.0), 0.0)
BALL = Thing("sphere", "small", "rubber", "blue", (1.5, 1.0), 0.0)
CUBE = Thing("cube", "medium", "rubber", "green", (0.5, -1.5), 0.0)


def shown(acts: tuple[Act, ...], things=(CONE, BALL, CUBE)) -> tuple[Clip, np.ndarray]:
    """A clip, and the labels (T, H, W) that the simulator draws of it."""

    class Own(CaterScene):
        def clip(self) -> Clip:
            return Clip(things, acts)

    return Clip(things, acts), Own("val", cater_scenes(1, 0, "val")[0].seed).watch(64)[1].astype(int)


ACTS = {
    "contain": (Act(0, "contain", 0, 25, BALL.place, 1), Act(2, "slide", 0, 25, (2.0, -2.5))),
    "slide": (Act(0, "slide", 0, 25, (-1.5, -1.5)), Act(1, "pick-place", 0, 25, (2.5, -2.5))),
    "rotate": (Act(1, "pick-place", 0, 25, (-0.5, 2.5)), Act(2, "rotate", 0, 25)),
}


@pytest.mark.parametrize("name", ACTS)
def test_what_really_happens_is_right(name) -> None:
    clip, labels = shown(ACTS[name])
    for act, one in zip(clip.acts, judge(labels, clip, labels[0]), strict=True):
        assert one.action is (None if act.action == "rotate" else True)
        assert one.rests is (True if act.action == "rotate" else None)
        assert one.object is (None if act.to is None else True)
        assert one.place is (None if act.to is None else True)
        assert one.vanishes is (None if act.into is None else True)


def test_words_are_found_by_what_they_say() -> None:
    clip, _ = shown(ACTS["contain"])
    words = re.findall(r"-?\w+", clip.instruction)
    rows = [[place if place is None else words[place] for place in row] for row in shown_words(words)]
    assert rows == [
        ["large", "red", "metal", "cone", "containing", None, None],
        ["medium", "green", "rubber", "cube", "sliding", "2", "-3"],
    ]


def test_what_else_happens_is_wrong() -> None:
    asked, labels = shown(ACTS["slide"])
    _, did = shown((Act(0, "pick-place", 0, 25, (-1.5, -1.5)), Act(2, "slide", 0, 25, (-2.5, -2.5))))
    cone, ball = judge(did, asked, did[0])
    assert (cone.object, cone.action, cone.place) == (True, False, True)  # it was lifted
    assert (ball.object, ball.action, ball.place) == (False, False, False)  # it stayed
    still = np.repeat(labels[:1], len(labels), 0)
    assert all(one.object is False and not one.action for one in judge(still, asked, labels[0]))
    gone = labels.copy()
    gone[1:][gone[1:] == 1] = 0  # a slot that vanishes has not gone anywhere
    assert judge(gone, asked, labels[0])[0].object is False


def test_what_the_simulator_does_not_show_is_not_asked() -> None:
    near = (-1.5, 0.9)  # less than a pixel away
    clip, labels = shown((Act(0, "slide", 0, 25, near), Act(1, "pick-place", 0, 25, (2.5, -2.5))))
    slid, lifted = judge(labels, clip, labels[0])
    assert (slid.object, slid.action, slid.place) == (False, False, True)
    still = judge(np.repeat(labels[:1], len(labels), 0), clip, labels[0])
    assert vars(still[0].where(slid)) == {
        "object": None, "action": None, "rests": None, "place": True, "vanishes": None,
    }  # fmt: skip
    assert vars(still[1].where(lifted)) == {
        "object": False, "action": False, "rests": None, "place": False, "vanishes": None,
    }  # fmt: skip


def test_slots_may_have_any_numbers_and_of_two_alike_either_may_act() -> None:
    clip, labels = shown(ACTS["slide"])
    numbers = np.array([5, 9, 0, 3])
    assert [vars(one) for one in judge(numbers[labels], clip, labels[0])] == [
        vars(one) for one in judge(labels, clip, labels[0])
    ]
    twin = replace(CONE, place=(1.5, -2.0))
    things = (CONE, BALL, twin)
    asked = Clip(things, (Act(0, "slide", 0, 25, (-1.5, -1.5)), Act(1, "rotate", 0, 25)))
    _, other = shown((Act(2, "slide", 0, 25, (-1.5, -1.5)), Act(1, "rotate", 0, 25)), things)
    found = judge(other, asked, other[0])[0]
    assert (found.object, found.action, found.place) == (True, True, True)
    # Where both act, each may do the other's part; but not both the same.
    slide, put = Act(0, "slide", 0, 25, (-1.5, -1.5)), Act(2, "pick-place", 0, 25, (0.5, -0.5))
    both = Clip(things, (slide, put))
    _, swapped = shown((replace(slide, thing=2), replace(put, thing=0)), things)
    _, twice = shown((slide, replace(slide, thing=2, to=(0.5, -0.5))), things)
    for labels, right in ((swapped, [True, True]), (twice, [True, False])):
        assert [one.action for one in judge(labels, both, labels[0])] == right


def test_what_turns_must_stay_and_shows_nothing_else() -> None:
    asked, labels = shown((Act(1, "slide", 0, 25, (2.5, -1.5)), Act(2, "rotate", 0, 25)))
    _, moved = shown((Act(1, "slide", 0, 25, (2.5, -1.5)), Act(2, "slide", 0, 25, (-1.5, -2.5))))
    turned, slid = (judge(its, asked, its[0])[1] for its in (labels, moved))
    assert vars(turned) == {"object": None, "action": None, "rests": True, "place": None, "vanishes": None}
    assert slid.rests is False


@pytest.mark.parametrize(("off", "right"), [((2.9, 2.9), True), ((3.5, 3.5), True), ((9, 9), False), ((-9, -9), False)])
def test_a_place_off_the_table_is_next_to_its_border_alone(off, right) -> None:
    edge = (2.5, 2.5) if off[0] > 0 else (-2.5, -2.5)
    assert _next_to(np.array(off, float), edge) is right


def test_a_scene_under_other_captions_has_the_same_things() -> None:
    (scene,) = cater_scenes(1, 3)
    others = [replace(scene, variant=k) for k in range(4)]
    assert len({one.clip().instruction for one in others}) == 4
    assert all(one.clip().things == scene.clip().things for one in others)
    firsts = [one.watch(64)[0][0] for one in others]
    assert all(np.array_equal(first, firsts[0]) for first in firsts)


def test_the_study_measures_what_it_promises(tmp_path) -> None:
    load = LoadCheckpoint("cater")
    results = run(
        STUDY,
        Args(out=tmp_path, workers=1),
        load=load,
        sizes=Sizes(scenes=2, variants=1, clips=1),
        loads={},
        measures=Measures(),
    )
    assert isinstance(results, Results)
    head = results.headline
    assert {"ssim_9", "ssim_19", "ssim_9_copy", "iou_9", "control_object", "control_action", "control_place"} <= set(
        head
    )
    truth = {row.metric: row.value for row in results.rows if row.method == "true frames" and row.variant == "control"}
    assert head["control_object_copy"] == 0.0 and truth["object"] >= 0.75
    assert (tmp_path / "report.html").stat().st_size > 10_000
    assert '"variant": 0' in (tmp_path / "scenes.json").read_text()


def test_training_is_commands_in_an_order_in_which_they_can_run(tmp_path, capsys) -> None:
    args = TrainArgs(out=tmp_path, scale="toy")
    found = steps(args)
    seen: set[str] = set()
    for step in found:
        assert set(step.needs) <= seen
        seen.add(step.name)
    assert [one.name for one in wanted(found, ["predictor"])] == [
        "train",
        "val",
        "votes-masks",
        "draw",
        "slots",
        "predictor",
    ]
    assert "polish" in {step.name for step in found} > {step.name for step in steps(replace(args, scale="gpu"))}
    with pytest.raises(ValueError, match="there is no step 'nothing'"):
        wanted(found, ["nothing"])
    assert main(replace(args, list=True, only=("val",))) == 0
    listed = capsys.readouterr().out
    assert TrainArgs(scale="toy").folder != TrainArgs().folder
    assert "--world cater --split val" in listed and "train parser" not in listed
    assert not (tmp_path / "val.h5").exists()
    assert main(replace(args, only=("val",), collector="/bin/false")) == 1  # a step that fails is told
    assert "val failed" in capsys.readouterr().out
