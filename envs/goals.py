"""Goal and state as numbers, and the rewards: for policies that read neither sentences nor pictures."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .colors import COLORS
from .physics.robot import Robot
from .physics.simulation import Tabletop
from .scene import MAX_OBJECTS, TABLE, GoalPair, ObjectSpec, Scene
from .tasks import Task

Floats = NDArray[np.float32]
Reward = Literal["sparse", "dense"]
REWARDS: tuple[Reward, ...] = ("sparse", "dense")

FARTHEST = 2.0  # metres from the origin along an axis to which places are clipped: things may fall off the table
REACH = 0.5  # metres from which on a distance counts in full in the dense reward
GOALS = ("achieved_goal", "desired_goal")
BEFORE = "achieved_before"  # where `info` has the achieved goal from before the step

ROW = 2 + len(COLORS) + 3  # of an object in the state
STATE_SIZE = 5 + MAX_OBJECTS * ROW


def goal_sizes(task: Task) -> dict[str, int]:
    """How many numbers each vector has."""
    facts = 1 + len(task.relations) * MAX_OBJECTS
    size = MAX_OBJECTS * (facts + 3) + 3
    return {**dict.fromkeys(GOALS, size), "goal": MAX_OBJECTS * (facts + 6)}


def state_vector(gripper: Floats, position: Floats, objects: tuple[ObjectSpec, ...]) -> Floats:
    """`gripper` (5,) and, for each of 8 ids: is there, is a bowl, 11 colours one-hot, place.

    Args:
        gripper, position: (5,) and (n, 3), as in `envs.physics.recorder.Recorder`.
    """
    rows = np.zeros((MAX_OBJECTS, ROW))
    for row, item, place in zip(rows, objects, position, strict=False):
        row[:2] = 1, item.kind == "bowl"
        row[2 + list(COLORS).index(item.color)] = 1
        row[-3:] = _clipped(place)
    return np.concatenate([gripper, rows.ravel()], dtype=np.float32)


def goal_vectors(task: Task, world: Tabletop, robot: Robot, scene: Scene) -> dict[str, Floats]:
    """The observations of `goal_sizes`.

    `achieved_goal` and `desired_goal` have 8 rows, by id, and last the tip's place, or where it rests. The row of a
    thing that the goal names says what is, or shall be, true of it (one number for the table, then one for each
    relation to each id), and where it is, or shall end. `goal` has 8 rows of what shall be true and is not yet, where
    the thing is, and where it shall end: all that a policy needs to know of the goal. Other rows are 0.
    """
    facts = 1 + len(task.relations) * MAX_OBJECTS
    names = ["", *(relation.name for relation in task.relations)]

    def column(pair: GoalPair) -> int:
        return 0 if pair.target == TABLE else 1 + pair.target + MAX_OBJECTS * (names.index(pair.relation) - 1)

    achieved, desired = np.zeros((2, MAX_OBJECTS, facts + 3))
    goal = np.zeros((MAX_OBJECTS, facts + 6))
    asked = task.asked(scene)
    for pair in task.true_of(world, robot, scene, {pair.thing for pair in asked}):
        achieved[pair.thing, column(pair)] = 1
    for pair, fulfilled in zip(asked, task.fulfilled(world, robot, scene), strict=True):
        achieved[pair.thing, column(pair)], desired[pair.thing, column(pair)] = fulfilled, 1
        achieved[pair.thing, facts:] = _clipped(world.pose(pair.thing)[0])
        desired[pair.thing, facts:] = _clipped(task.destination(world, scene, pair))
        if not fulfilled:
            row = desired[pair.thing]
            goal[pair.thing] = np.concatenate([row[:facts], achieved[pair.thing, facts:], row[facts:]])
    return {
        "achieved_goal": np.append(achieved, _clipped(robot.tip())).astype(np.float32),
        "desired_goal": np.append(desired, _clipped(robot.arm.home)).astype(np.float32),
        "goal": goal.ravel().astype(np.float32),
    }


def compute_reward(reward: Reward, achieved: ArrayLike, desired: ArrayLike, info: Any = None) -> NDArray[np.float64]:
    """The reward (...) of a step that led to ``achieved`` (..., D) where ``desired`` (..., D) was the goal.

    Args:
        info: of the step, or a sequence of one for each of a batch; the sparse reward needs their `achieved_before`.

    Raises:
        ValueError: where that is missing.
    """
    (facts, place, tip), (asked, goal, _) = _split(achieved), _split(desired)
    count = np.maximum(asked.sum((-2, -1)), 1)  # after relabelling a goal may be empty
    if reward == "sparse":
        had = _split(_before(info))[0]
        return ((facts * asked).sum((-2, -1)) - (had * asked).sum((-2, -1))) / count
    far = np.linalg.norm((place - goal)[..., :2], axis=-1)
    reach = np.linalg.norm(place - tip[..., None, :], axis=-1)
    cost = 0.5 + 0.25 * np.minimum(1, far / REACH) + 0.25 * np.minimum(1, reach / REACH)
    return 0 - (cost * (asked * (1 - facts)).sum(-1)).sum(-1) / count


def _split(vectors: ArrayLike) -> tuple[NDArray[np.float64], ...]:
    """Facts (..., 8, F), places (..., 8, 3) and tip (..., 3)."""
    values = np.asarray(vectors, dtype=np.float64)
    rows = values[..., :-3].reshape(*values.shape[:-1], MAX_OBJECTS, -1)
    return rows[..., :-3], rows[..., -3:], values[..., -3:]


def _before(info: Any) -> NDArray[np.float32]:
    try:
        return np.stack([each[BEFORE] for each in info]) if not isinstance(info, Mapping) else info[BEFORE]
    except (KeyError, TypeError):
        raise ValueError(
            f"the sparse reward is a change and needs info[{BEFORE!r}], as step gives it; with the HerReplayBuffer of "
            'stable-baselines3: copy_info_dict=True. Or use reward="dense"'
        ) from None


def _clipped(place: ArrayLike) -> NDArray[np.float64]:
    return np.clip(place, -FARTHEST, FARTHEST)
