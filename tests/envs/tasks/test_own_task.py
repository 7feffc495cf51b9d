"""A task that the package does not have: the environment and the expert must carry it out as they are."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

import pytest

from envs import Expert, TabletopEnv
from envs.geometry import WORKSPACE
from envs.physics.robot import Robot
from envs.physics.simulation import Tabletop
from envs.scene import GoalPair, ObjectSpec
from envs.tasks import In, Relation, Task

NEAR = 0.089  # metres between centres; random scenes keep blocks farther apart


class Beside(Relation):
    """A block stands on the table next to another."""

    name = "beside"
    kinds = ("block", "block")

    def fulfilled(self, world: Tabletop, robot: Robot, pair: GoalPair) -> bool:
        (x, y, z), (a, b, c) = world.pose(pair.thing)[0], world.pose(pair.target)[0]
        return hypot(x - a, y - b) < NEAR and abs(z - c) < 0.01 and robot.holding != pair.thing

    def fulfilled_at_start(self, objects: Sequence[ObjectSpec], thing: int, target: int) -> bool:
        return hypot(objects[thing].x - objects[target].x, objects[thing].y - objects[target].y) < NEAR

    def place(self, world: Tabletop, pair: GoalPair) -> tuple[float, float]:
        x, y, _ = world.pose(pair.target)[0]
        gap = 1.45 * world.sizes.block
        sides = [(x + gap, y), (x - gap, y), (x, y + gap), (x, y - gap)]
        others = [world.pose(i)[0] for i in range(len(world.objects)) if i not in pair[1:]]
        return max(
            (side for side in sides if WORKSPACE.contains(*side)),
            key=lambda side: min(hypot(side[0] - o[0], side[1] - o[1]) for o in others),
        )


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_the_expert_carries_it_out(control: str) -> None:
    env = TabletopEnv(Task((Beside(),)), control=control)
    for seed in range(5):
        observation, info = env.reset(seed=seed, options={"n_bowls": 2})
        assert " beside the " in observation["instruction"] and env.observation_space.contains(observation)
        assert not info["is_success"] and not info["cliport_success"]
        for action in Expert(env).actions():
            *_, info = env.step(action)
        assert info["is_success"] and info["cliport_success"]
    with pytest.raises(ValueError, match="the form is: put the <color> block beside the <color> block"):
        env.reset(options={"instruction": "put the red block in the blue bowl"})
    env.close()


def test_a_task_of_two_relations_understands_both() -> None:
    task = Task((In(), Beside()), pairs=(1, 2))
    env = TabletopEnv(task)
    _, info = env.reset(seed=1, options={"n_bowls": 2})
    asked = task.questions(env.scene.objects)
    assert len(asked) == len({question.text for question in asked}) == 4 * 2 + 4 * 3
    for relation in ("in", "beside"):
        text = next(question.text for question in asked if f" {relation} the " in question.text)
        _, info = env.reset(options={"layout": info["objects"], "instruction": text})
        for action in Expert(env).actions():
            *_, info = env.step(action)
        assert info["is_success"], text
    assert {"in", "beside", "bowl", "and"} <= set(task.vocabulary)
    env.close()
