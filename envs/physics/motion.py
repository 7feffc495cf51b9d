"""Pick and place as a sequence of tool motions, one per camera frame.

Hover, descend to contact, suck, lift, hover over the place, lower, let go, rise, return home. The last frame
looks like a first one, so that several such motions can follow each other.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from envs.physics.robot import HOME, REACH_LOW, Robot

Action = NDArray[np.float32]
"""(5,): dx, dy, dz in metres, dyaw in radians, suction (on above 0.5)."""

TRAVEL_HEIGHT = 0.16
"""Height of the tip on its way, in metres: a hanging block clears whatever stands on the table."""

CLEARANCE = 0.018
"""How much higher than at the pick the tip lets go, in metres: over the bowl's floor, below its rim."""

MAX_SPEED = 3.0
"""Fastest motion of the tip along an axis, in m/s."""

MAX_TURN = 8.0
"""Fastest turn of the tip, in rad/s."""

DESCENT_SPEED = 0.675
"""In m/s: at 15 frames a second, contact falls well inside a frame for blocks on the table and in bowls."""

# Seconds. Nearly constant, whatever the distance: an episode of the default camera has about 25 frames.
APPROACH, LIFT, CARRY, LOWER, RELEASE, RISE, RETURN = 4 / 15, 3 / 15, 5 / 15, 2 / 15, 1 / 15, 2 / 15, 4 / 15


def pick_and_place(
    robot: Robot, pick: tuple[float, float], place: tuple[float, float], turn: float = 0.0
) -> Iterator[Action]:
    """The actions of one pick-and-place; each must be executed on ``robot`` before the next is drawn.

    Args:
        robot: the arm; its contact and grip decide when the descents end.
        pick: where to descend first, metres.
        place: where to let go, metres.
        turn: yaw of the block from pick to place, radians.

    The motion goes on when nothing was gripped: a wrong pick is a real failure, not an error.
    """
    yaw = robot.yaw
    yield from _travel(robot, (*pick, TRAVEL_HEIGHT), APPROACH, suction=False)
    yield from _descend(robot, REACH_LOW[2], suction=True)
    grip_height = robot.target[2]
    yield from _travel(robot, (*pick, TRAVEL_HEIGHT), LIFT, suction=True)
    yield from _travel(robot, (*place, TRAVEL_HEIGHT), CARRY, suction=True, turn=turn)
    yield from _travel(robot, (*place, grip_height + CLEARANCE), LOWER, suction=True)
    yield from _travel(robot, robot.target, RELEASE, suction=False)
    yield from _travel(robot, (*place, TRAVEL_HEIGHT), RISE, suction=False)
    yield from _travel(robot, HOME, RETURN, suction=False, turn=yaw - robot.yaw)


def _travel(
    robot: Robot, goal: tuple[float, ...], seconds: float, suction: bool, turn: float = 0.0
) -> Iterator[Action]:
    """Move to ``goal`` softly; longer than ``seconds`` only where the speed limits ask for it."""
    start, way = np.array(robot.target), np.array(goal) - robot.target
    peak = 1.5  # of the smooth profile's speed over its mean
    slowest = max(float(np.abs(way).max()) / MAX_SPEED, abs(turn) / MAX_TURN) * peak
    frames = max(1, round(seconds / robot.frame_time), int(np.ceil(slowest / robot.frame_time)))
    yaw = 0.0
    for frame in range(1, frames + 1):
        share = frame / frames
        share = share * share * (3 - 2 * share)
        delta = start + share * way - robot.target
        if robot.touched and delta[2] < 0:
            delta[2] = 0.0
        yield _action(delta, share * turn - yaw, suction)
        yaw = share * turn


def _descend(robot: Robot, lowest: float, suction: bool) -> Iterator[Action]:
    """Move straight down until something is touched, or to ``lowest``."""
    while robot.target[2] > lowest + 1e-4:
        way = max(lowest - robot.target[2], -DESCENT_SPEED * robot.frame_time)
        yield _action((0.0, 0.0, way), 0.0, suction)
        if robot.touched:
            return


def _action(delta: tuple[float, float, float] | NDArray[np.float64], dyaw: float, suction: bool) -> Action:
    return np.array([*delta, dyaw, float(suction)], dtype=np.float32)
