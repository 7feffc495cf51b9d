"""When is a block in a bowl? The simulator alone judges."""

from __future__ import annotations

from math import hypot

import pybullet as p

from envs.robot import Robot
from envs.simulation import Tabletop

CLIPORT_RADIUS = 0.05
"""CLIPort calls it success when block and bowl centres are this close in the plane (metres)."""

SETTLED_SPEED = 0.05
"""In m/s. A resting block of a few grams jitters by up to a fifth of this in PyBullet's contact solver."""


def is_inside(world: Tabletop, robot: Robot, block: int, bowl: int) -> bool:
    """Whether a block rests inside a bowl.

    Its centre is within the inner rim and below the rim's height, in the bowl's own frame; the bowl stands
    upright; the gripper has let go; nothing moves any more.
    """
    position, orientation = world.pose(bowl)
    x, y, z = p.multiplyTransforms(*p.invertTransform(position, orientation), *world.pose(block))[0]
    upright = p.getMatrixFromQuaternion(orientation)[8] > 0.9
    return (
        upright
        and hypot(x, y) < world.sizes.bowl_inner_radius
        and 0.0 < z < world.sizes.bowl_height
        and robot.holding != block
        and world.speed(block) < SETTLED_SPEED
    )


def is_near(world: Tabletop, block: int, bowl: int) -> bool:
    """CLIPort's criterion: centres within 5 cm in the plane, in hand or not."""
    (x, y, _), (a, b, _) = world.pose(block)[0], world.pose(bowl)[0]
    return hypot(x - a, y - b) < CLIPORT_RADIUS
