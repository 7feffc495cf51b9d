"""Pick and place as a sequence of tool motions, one per camera frame.

Hover, descend to contact, suck, lift, hover over the place, lower, let go, rise, return home. The last frame
looks like a first one, so that several such motions can follow each other.
"""

from collections.abc import Iterator
from math import dist

import numpy as np
from numpy.typing import NDArray

from ..geometry import Point
from .robot import Robot

Action = NDArray[np.float32]  # (5,): dx, dy, dz in metres, dyaw in radians, suction (on above 0.5)

CLEARANCE = 0.018  # metres that the tip lets go higher than at the pick: over the bowl's floor, below its rim

MAX_SPEED = 3.0  # fastest motion of the tip along an axis, in m/s
MAX_TURN = 8.0  # fastest turn of the tip, in rad/s

STACK_GAP = 0.02  # metres between a hanging block that is carried and the highest block that it may pass
CLEAR = 0.06  # metres that the tip first rises straight up, out of a bowl, with joints at constant speed
# Seconds. Nearly constant, whatever the distance: an episode of the default camera has about 25 frames.
APPROACH, LIFT, CARRY, LOWER, RELEASE, RISE, RETURN = 4 / 15, 3 / 15, 5 / 15, 2 / 15, 1 / 15, 2 / 15, 4 / 15


def pick_and_place(
    robot: Robot, pick: tuple[float, float], place: tuple[float, float], turn: float = 0.0
) -> Iterator[Action]:
    """The actions of one pick-and-place; each must be executed on ``robot`` before the next is drawn.

    Places are in metres; ``turn`` is the yaw of the block from pick to place, radians. The motion goes on
    when nothing was gripped: a wrong pick is a real failure, not an error. What already hangs over the place
    to pick is only carried on.
    """
    yaw, motion, block = robot.yaw, robot.world.setup.motion, robot.world.sizes.block
    grip_height = block
    if not (robot.holding >= 0 and dist(robot.target[:2], pick) < block / 2):
        if _top(robot) > robot.arm.home[2]:  # up first, past whatever stands beside
            up = (*robot.target[:2], _over_all(robot, motion.pick_height))
            yield from _travel(robot, up, RISE, suction=False)
        yield from _travel(robot, (*pick, _over_all(robot, motion.pick_height)), APPROACH, suction=False)
        yield from _descend(robot, suction=True)
        # What was taken off another block is let go as low as what stood on the table.
        grip_height = robot.target[2] if robot.target[2] < 1.5 * block else block
        yield from _rise(robot, (*pick, _over_all(robot, motion.pick_height)), LIFT, suction=True)
    over_place = (*place, _over_all(robot, motion.place_height))
    yield from _travel(robot, over_place, CARRY, suction=True, turn=turn)
    if motion.joint_speed is None:
        yield from _travel(robot, (*place, grip_height + CLEARANCE), LOWER, suction=True)
    else:
        yield from _descend(robot, suction=True)
    yield from _travel(robot, robot.target, RELEASE, suction=False)
    over_place = (*place, _over_all(robot, motion.place_height))
    yield from _rise(robot, over_place, RISE, suction=False)
    home = robot.arm.home
    if _top(robot) > home[2]:
        yield from _travel(robot, (*home[:2], over_place[2]), RETURN, suction=False, turn=yaw - robot.yaw)
    yield from _travel(robot, home, RETURN, suction=False, turn=yaw - robot.yaw)


def _over_all(robot: Robot, usual: float) -> float:
    """A height of the tip, ``usual`` or more, at which a hanging block clears whatever is not held."""
    return min(max(usual, _top(robot) + robot.world.sizes.block + STACK_GAP), robot.arm.reach_high[2])


def _top(robot: Robot) -> float:
    """Height of the highest block that is not held, in metres."""
    world = robot.world
    loose = (i for i, body in enumerate(world.objects) if body in world.blocks and i != robot.holding)
    return max((world.pose(index)[0][2] + world.sizes.block / 2 for index in loose), default=0.0)


def _travel(robot: Robot, goal: Point, seconds: float, suction: bool, turn: float = 0.0) -> Iterator[Action]:
    """Move to ``goal``, softly in ``seconds`` (more at the speed limits) or with joints at constant speed."""
    speed = robot.world.setup.motion.joint_speed
    way = _soft_way(robot, goal, seconds, turn) if speed is None else _joint_way(robot, goal, speed, turn)
    yaw = 0.0
    for place, angle in way:
        delta = place - robot.target
        if robot.touched and delta[2] < 0:
            delta[2] = 0.0
        yield _action(delta, angle - yaw, suction)
        yaw = angle


# For each frame the tip's place (3, metres), and how far it has turned (radians).
Way = list[tuple[NDArray[np.float64], float]]


def _soft_way(robot: Robot, goal: Point, seconds: float, turn: float) -> Way:
    start, way = np.array(robot.target), np.array(goal) - robot.target
    peak = 1.5  # of the smooth profile's speed over its mean
    slowest = max(float(np.abs(way).max()) / MAX_SPEED, abs(turn) / MAX_TURN) * peak
    frames = max(1, round(seconds / robot.frame_time), int(np.ceil(slowest / robot.frame_time)))
    shares = [frame / frames for frame in range(1, frames + 1)]
    shares = [share * share * (3 - 2 * share) for share in shares]
    return [(start + share * way, share * turn) for share in shares]


def _joint_way(robot: Robot, goal: Point, speed: float, turn: float) -> Way:
    arm, yaw = robot.arm, robot.yaw
    start = np.array(arm.inverse(robot.target, yaw))
    way = np.array(arm.inverse(arm.within_reach(goal), yaw + turn)) - start
    frames = max(1, int(np.ceil(np.linalg.norm(way) / speed / robot.frame_time)))
    while True:
        shares = np.arange(1, frames + 1) / frames
        tips = [np.array(arm.forward(tuple(start + share * way))[0]) for share in shares]
        steps = np.diff([np.array(robot.target), *tips], axis=0)
        fastest = max(float(np.abs(steps).max()) / MAX_SPEED, abs(turn) / frames / MAX_TURN)
        if fastest <= robot.frame_time:
            return [(tip, float(share) * turn) for tip, share in zip(tips, shares, strict=True)]
        frames += 1


def _rise(robot: Robot, goal: Point, seconds: float, suction: bool) -> Iterator[Action]:
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
