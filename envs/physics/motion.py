"""Pick and place as a sequence of tool motions, one per camera frame.

Hover, descend to contact, suck, lift, hover over the place, lower, let go, rise, return home. The last frame
looks like a first one, so that several such motions can follow each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import dist

import numpy as np
from numpy.typing import NDArray

from envs.physics.robot import Robot

Action = NDArray[np.float32]
"""(5,): dx, dy, dz in metres, dyaw in radians, suction (on above 0.5)."""

CLEARANCE = 0.018
"""How much higher than at the pick the tip lets go, in metres: over the bowl's floor, below its rim."""

MAX_SPEED = 3.0
"""Fastest motion of the tip along an axis, in m/s."""

MAX_TURN = 8.0
"""Fastest turn of the tip, in rad/s."""

CLEAR = 0.06
"""With joints at constant speed: how far the tip rises straight up first, in metres, out of a bowl."""

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

    The motion goes on when nothing was gripped: a wrong pick is a real failure, not an error. What already
    hangs over the place to pick is only carried on.
    """
    yaw, motion, grip_height = robot.yaw, robot.world.setup.motion, robot.world.sizes.block
    over_pick, over_place = (*pick, motion.pick_height), (*place, motion.place_height)
    if not (robot.holding >= 0 and dist(robot.target[:2], pick) < robot.world.sizes.block / 2):
        yield from _travel(robot, over_pick, APPROACH, suction=False)
        yield from _descend(robot, suction=True)
        grip_height = robot.target[2]
        yield from _rise(robot, over_pick, LIFT, suction=True)
    yield from _travel(robot, over_place, CARRY, suction=True, turn=turn)
    if motion.joint_speed is None:
        yield from _travel(robot, (*place, grip_height + CLEARANCE), LOWER, suction=True)
    else:
        yield from _descend(robot, suction=True)
    yield from _travel(robot, robot.target, RELEASE, suction=False)
    yield from _rise(robot, over_place, RISE, suction=False)
    yield from _travel(robot, robot.arm.home, RETURN, suction=False, turn=yaw - robot.yaw)


def _travel(
    robot: Robot, goal: tuple[float, ...], seconds: float, suction: bool, turn: float = 0.0
) -> Iterator[Action]:
    """Move to ``goal``, softly within ``seconds``, or with joints at constant speed; longer only where the
    speed limits ask for it."""
    speed = robot.world.setup.motion.joint_speed
    way = _soft_way(robot, goal, seconds, turn) if speed is None else _joint_way(robot, goal, speed, turn)
    yaw = 0.0
    for place, angle in way:
        delta = place - robot.target
        if robot.touched and delta[2] < 0:
            delta[2] = 0.0
        yield _action(delta, angle - yaw, suction)
        yaw = angle


Way = list[tuple[NDArray[np.float64], float]]
"""For each frame the tip's place (3, metres), and how far it has turned (radians)."""


def _soft_way(robot: Robot, goal: tuple[float, ...], seconds: float, turn: float) -> Way:
    start, way = np.array(robot.target), np.array(goal) - robot.target
    peak = 1.5  # of the smooth profile's speed over its mean
    slowest = max(float(np.abs(way).max()) / MAX_SPEED, abs(turn) / MAX_TURN) * peak
    frames = max(1, round(seconds / robot.frame_time), int(np.ceil(slowest / robot.frame_time)))
    shares = [frame / frames for frame in range(1, frames + 1)]
    shares = [share * share * (3 - 2 * share) for share in shares]
    return [(start + share * way, share * turn) for share in shares]


def _joint_way(robot: Robot, goal: tuple[float, ...], speed: float, turn: float) -> Way:
    arm, yaw = robot.arm, robot.yaw
    start = np.array(arm.inverse(robot.target, yaw))
    way = np.array(arm.inverse(arm.within_reach(goal), yaw + turn)) - start  # type: ignore[arg-type]
    frames = max(1, int(np.ceil(np.linalg.norm(way) / speed / robot.frame_time)))
    while True:
        shares = np.arange(1, frames + 1) / frames
        tips = [np.array(arm.forward(tuple(start + share * way))[0]) for share in shares]
        steps = np.diff([np.array(robot.target), *tips], axis=0)
        fastest = max(float(np.abs(steps).max()) / MAX_SPEED, abs(turn) / frames / MAX_TURN)
        if fastest <= robot.frame_time:
            return [(tip, float(share) * turn) for tip, share in zip(tips, shares, strict=True)]
        frames += 1


def _rise(robot: Robot, goal: tuple[float, ...], seconds: float, suction: bool) -> Iterator[Action]:
    """Move up to ``goal``; joints at constant speed bend aside, so first straight up, clear of a bowl."""
    motion, (x, y, z) = robot.world.setup.motion, robot.target
    if motion.joint_speed is not None:
        top = robot.arm.within_reach((x, y, min(z + CLEAR, goal[2])))[2]
        while robot.target[2] < top - 1e-4:
            way = min(top - robot.target[2], motion.descent_speed * robot.frame_time)
            yield _action((0.0, 0.0, way), 0.0, suction)
    yield from _travel(robot, goal, seconds, suction)


def _descend(robot: Robot, suction: bool) -> Iterator[Action]:
    """Move straight down until something is touched, or as far as the arm may."""
    lowest, speed = robot.arm.reach_low[2], robot.world.setup.motion.descent_speed
    while robot.target[2] > lowest + 1e-4:
        way = max(lowest - robot.target[2], -speed * robot.frame_time)
        yield _action((0.0, 0.0, way), 0.0, suction)
        if robot.touched:
            return


def _action(delta: tuple[float, float, float] | NDArray[np.float64], dyaw: float, suction: bool) -> Action:
    return np.array([*delta, dyaw, float(suction)], dtype=np.float32)
