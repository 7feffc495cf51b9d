import numpy as np
import pytest

import planning
from planning import BeamPlanner, Controller, Goal, GroundingError, Instruction, RandomPlanner
from tests.planning.conftest import put_in
from tests.planning.oracle import OracleWorldModel

RGB = np.zeros((64, 64, 3), np.uint8)
ONE_STEP = {"depth": 1, "candidates": "scene"}
PAIRS = [(block, bowl) for block in ("red", "green") for bowl in ("blue", "gray", "white")]


@pytest.mark.parametrize(("block", "bowl"), PAIRS)
def test_the_best_instruction_is_the_goals(oracle: OracleWorldModel, grounder, block: str, bowl: str) -> None:
    plan = BeamPlanner(oracle, **ONE_STEP).plan(RGB, Goal((put_in(block, bowl),)), grounder)
    assert plan.instruction == put_in(block, bowl)
    assert [candidate.reaches_goal for candidate in plan.ranking] == [True] + [False] * 5
    scores = [candidate.score for candidate in plan.ranking]
    assert scores == sorted(scores, reverse=True)
    assert oracle.calls == [6], "all candidates are one batch"
    assert plan.rollout.texts == (plan.instruction.text,) and plan.seconds > 0


def test_the_score_judges_what_was_imagined_not_what_was_said(objects, camera, grounder) -> None:
    oracle = OracleWorldModel(lambda: objects, camera, hands_off=["red"])
    plan = BeamPlanner(oracle, **ONE_STEP).plan(RGB, Goal.parse("put the red block in the blue bowl"), grounder)
    assert not any(candidate.reaches_goal for candidate in plan.ranking)


def test_what_is_imagined_is_as_long_as_the_model_looks_ahead(oracle: OracleWorldModel, grounder) -> None:
    goal = Goal.parse("put the red block in the blue bowl")
    for longest, horizon, frames in ((None, None, 25), (40, None, 41), (40, 30, 31)):
        oracle.longest_horizon = longest
        planners = (
            BeamPlanner(oracle, horizon=horizon),
            RandomPlanner(oracle, np.random.default_rng(0), horizon=horizon),
        )
        for planner in planners:
            assert planner.plan(RGB, goal, grounder).rollouts[0].slots.shape[1] == frames


def test_a_thing_that_is_not_there_is_an_error(oracle: OracleWorldModel, grounder) -> None:
    goal = Goal.parse("put the pink block in the blue bowl")
    for planner in (BeamPlanner(oracle, **ONE_STEP), BeamPlanner(oracle)):
        with pytest.raises(GroundingError, match="no pink block"):
            planner.plan(RGB, goal, grounder)


def test_random_planner_repeats_with_its_generator(oracle: OracleWorldModel, grounder) -> None:
    goal = Goal.parse("put the red block in the blue bowl")

    def choices(seed: int) -> list[Instruction]:
        planner = RandomPlanner(oracle, np.random.default_rng(seed), depth=1)
        return [planner.plan(RGB, goal, grounder).instruction for _ in range(20)]

    assert choices(0) == choices(0) != choices(1)
    assert len(set(choices(0))) > 3


@pytest.mark.parametrize("beam", [0, 2, 4])
def test_sequences_reach_goals_of_two_steps(oracle: OracleWorldModel, grounder, beam: int) -> None:
    goal = Goal.parse("put the red block in the blue bowl and the green block in the gray bowl")
    plan = BeamPlanner(oracle, beam=beam).plan(RGB, goal, grounder)
    assert plan.best.reaches_goal
    assert set(plan.best.instructions) == set(goal.instructions)
    assert [rollout.texts[0] for rollout in plan.rollouts] == [i.text for i in plan.best.instructions]
    # The second step starts from where the first was imagined to end: its block lies in its bowl already.
    first, second = plan.rollouts
    np.testing.assert_allclose(second.slots[0, 0], first.slots[0, -1])
    assert sum(candidate.reaches_goal for candidate in plan.ranking) in (1, 2)
    if beam == 0:
        # Six first steps, and for the other block all three bowls.
        assert len(plan.ranking) == 6 * 3 and sum(c.reaches_goal for c in plan.ranking) == 2


def test_one_step_of_a_longer_goal_is_any_of_its_own(oracle: OracleWorldModel, grounder) -> None:
    goal = Goal.parse("put the red block in the blue bowl and the green block in the gray bowl")
    plan = BeamPlanner(oracle, **ONE_STEP).plan(RGB, goal, grounder)
    assert {candidate.instructions[0] for candidate in plan.ranking[:2]} == set(goal.instructions)
    assert [candidate.reaches_goal for candidate in plan.ranking] == [True] * 2 + [False] * 4
    assert oracle.calls == [6] and len(plan.rollouts) == 1


def test_the_planner_knows_no_rule_of_the_task(oracle: OracleWorldModel, objects, grounder) -> None:
    """The oracle imagines two blocks in one bowl without trouble, so a taken bowl is filled like any other."""
    objects[1]["position"] = (0.60, -0.10, 0.035)
    goal = Goal.parse("put the red block in the blue bowl and the green block in the gray bowl")
    planner = BeamPlanner(oracle, beam=0)
    firsts = {one.instructions[0] for one in planner.plan(RGB, goal, grounder).ranking}
    assert put_in("red", "blue") in firsts


def test_random_sequences(oracle: OracleWorldModel, grounder) -> None:
    goal = Goal.parse("put the red block in the blue bowl and the green block in the gray bowl")

    def sequences(from_goal: bool) -> list[tuple[Instruction, ...]]:
        planner = RandomPlanner(oracle, np.random.default_rng(0), from_goal=from_goal)
        plans = [planner.plan(RGB, goal, grounder) for _ in range(12)]
        for plan in plans:  # the second step is imagined from the end of the first
            assert [rollout.texts[0] for rollout in plan.rollouts] == [s.text for s in plan.best.instructions]
            np.testing.assert_allclose(plan.rollouts[1].slots[0, 0], plan.rollouts[0].slots[0, -1])
        return [plan.best.instructions for plan in plans]

    own = sequences(True)
    assert set(own) == {goal.instructions, goal.instructions[::-1]} and own == sequences(True)
    others = sequences(False)
    assert len(set(others)) > 4
    for steps in others:
        assert {step.thing.color for step in steps} == {"red", "green"}
        assert len({step.target for step in steps}) == 2


def test_sequences_leave_alone_what_is_done(oracle: OracleWorldModel, objects, grounder) -> None:
    goal = Goal.parse("put the red block in the blue bowl and the green block in the gray bowl")
    objects[0]["position"] = (0.60, -0.10, 0.035)  # red lies in blue
    plan = BeamPlanner(oracle).plan(RGB, goal, grounder)
    assert plan.best.instructions == (put_in("green", "gray"),)


def test_controller_reads_the_rollout(oracle: OracleWorldModel, camera, grounder) -> None:
    plan = BeamPlanner(oracle, **ONE_STEP).plan(RGB, Goal.parse("put the red block in the gray bowl"), grounder)
    action = Controller(camera).act(plan.rollout, plan.grounding, plan.instruction)
    np.testing.assert_allclose(action.pick, (0.45, -0.12), atol=0.01)
    np.testing.assert_allclose(action.place, (0.42, 0.08), atol=0.01)
    assert action.to_action().dtype == np.float32 and action.to_action().shape == (4,)


def test_programs_that_say_the_planners_old_name_go_on() -> None:
    assert planning.InstructionPlanner is planning.BeamPlanner and "InstructionPlanner" in planning.__all__
