"""A relation is one entry: sentences, planner, scores and controller take it from `RELATIONS`."""

import numpy as np
import pytest

from planning import (
    RELATIONS,
    AppearanceGrounder,
    BeamPlanner,
    Controller,
    Goal,
    Instruction,
    PinholeCamera,
    RandomPlanner,
    Relation,
    Thing,
    measure_rollout,
    succeeds,
    unmet,
)
from tests.planning.conftest import put_in, thing
from tests.planning.oracle import OracleWorldModel

RGB = np.zeros((64, 64, 3), np.uint8)
RED, GREEN, BLUE = Thing("red", "block"), Thing("green", "block"), Thing("blue", "bowl")
OFFSET = (0.0, 0.07)  # metres: two blocks side by side
OFFSET_PX = (9.5, 0.0)  # the same in the picture


def touching(thing_HW: np.ndarray, target_HW: np.ndarray) -> bool:
    (y, x), (v, u) = np.argwhere(thing_HW).mean(0), np.argwhere(target_HW).mean(0)
    return bool(np.hypot(y - v, x - u) < 12)


@pytest.fixture
def beside(monkeypatch: pytest.MonkeyPatch) -> Instruction:
    relation = Relation(
        template="the {thing} beside the {target}",
        kinds=("block", "block"),
        offset_px=OFFSET_PX,
        within_px=3.0,
        holds=touching,
        place_height=0.029,
    )
    monkeypatch.setitem(RELATIONS, "beside", relation)
    return Instruction("beside", RED, GREEN)


def test_a_new_relation_is_parsed(beside: Instruction) -> None:
    assert beside.text == "put the red block beside the green block"
    assert Instruction.parse(beside.text) == beside
    goal = Goal.parse("Put the red block beside the green block and the green block in the blue bowl")
    assert goal.instructions == (beside, put_in("green", "blue"))
    assert goal.things == (RED, GREEN, BLUE)


def test_instructions_are_checked(beside: Instruction) -> None:
    with pytest.raises(ValueError, match="no relation 'under'; there are: in, on, beside"):
        Instruction("under", RED, BLUE)
    with pytest.raises(ValueError, match="'beside' joins block and block, not red block and blue bowl"):
        Instruction("beside", RED, BLUE)


def test_a_new_relation_is_planned_scored_and_carried_out(
    beside: Instruction, objects, camera: PinholeCamera, grounder: AppearanceGrounder
) -> None:
    objects.append(thing("block", "orange", 0.40, -0.20))
    oracle = OracleWorldModel(lambda: objects, camera, offsets={"beside": OFFSET})
    goal = Goal((beside,))
    plan = BeamPlanner(oracle).plan(RGB, goal, grounder)
    assert plan.instruction == beside
    assert [candidate.reaches_goal for candidate in plan.ranking] == [True, False], "beside green, beside orange"
    scene = BeamPlanner(oracle, candidates="scene").plan(RGB, goal, grounder)
    firsts = {candidate.instructions[0] for candidate in scene.ranking}
    blocks = plan.grounding.of_kind("block")
    assert firsts == {Instruction("beside", a, b) for a in blocks for b in blocks if a != b}, "and none of `in`"

    trace = measure_rollout(plan.rollout, plan.grounding, beside)
    assert trace.within_B.tolist() == [3.0] and succeeds(trace).all()
    slots = [list(plan.grounding.slots_of(thing)) for thing in (RED, GREEN)]
    winner_HW = plan.rollout.masks[0, -1].argmax(0)
    red, green = (sum(winner_HW == slot for slot in its).bool() for its in slots)
    assert trace.distance_Bt[0, -1] == RELATIONS["beside"].distance(red, green)

    action = Controller(camera).act(plan.rollout, plan.grounding, beside)
    np.testing.assert_allclose(action.place, (0.62, 0.10 + OFFSET[1]), atol=0.01)
    random = RandomPlanner(oracle, np.random.default_rng(0)).plan(RGB, goal, grounder)
    assert random.instruction.relation == "beside"

    def seen_unmet() -> tuple[Instruction, ...]:
        parsed = oracle.parse(RGB[None])
        return unmet(parsed, grounder(parsed), goal)

    assert seen_unmet() == (beside,)
    objects[0]["position"] = (0.62, 0.10 + OFFSET[1], 0.029)
    assert seen_unmet() == ()


def test_one_trace_may_hold_several_relations(
    beside: Instruction, objects, camera: PinholeCamera, grounder: AppearanceGrounder
) -> None:
    oracle = OracleWorldModel(lambda: objects, camera, offsets={"beside": OFFSET})
    parsed = oracle.parse(RGB[None])
    asked = [put_in("red", "blue"), beside, put_in("green", "gray")]
    rollout = oracle.rollout(parsed, [one.text for one in asked])
    grounding = grounder(parsed)
    assert {one.relation for one in grounding.instructions()} == {"in", "on", "beside"}
    assert {one.relation for one in grounding.instructions("in")} == {"in"}
    together = measure_rollout(rollout, grounding, asked)
    assert together.within_B.tolist() == [4.0, 3.0, 4.0] and succeeds(together).all()
    for row, one in enumerate(asked):
        alone = measure_rollout(rollout.select(row), grounding, one)
        assert alone.distance_Bt.equal(together.distance_Bt[[row]])
    swapped = measure_rollout(rollout, grounding, asked[::-1])
    assert succeeds(swapped).tolist() == [False, True, False]


def test_goals_of_several_relations_are_planned(
    beside: Instruction, objects, camera: PinholeCamera, grounder: AppearanceGrounder
) -> None:
    """Red is to stand beside green, which moves: only one order works, and it is found by imagining."""
    oracle = OracleWorldModel(lambda: objects, camera, offsets={"beside": OFFSET})
    goal = Goal((beside, put_in("green", "blue")))
    plan = BeamPlanner(oracle, beam=0).plan(RGB, goal, grounder)
    assert plan.best.instructions == (put_in("green", "blue"), beside)
    assert [one.instructions for one in plan.ranking if one.reaches_goal] == [plan.best.instructions]
    assert goal.instructions in {one.instructions for one in plan.ranking}
