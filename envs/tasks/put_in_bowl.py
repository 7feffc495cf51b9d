"""``put the <color> block in the <color> bowl``."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

import pybullet as p

from envs.physics.robot import Robot
from envs.physics.simulation import Tabletop
from envs.scene import GoalPair, ObjectSpec
from envs.tasks.base import SETTLED_SPEED, Relation


class In(Relation):
    """A block lies in a bowl, which has room for one."""

    name = "in"
    kinds = ("block", "bowl")
    exclusive = True

    def fulfilled(self, world: Tabletop, robot: Robot, pair: GoalPair) -> bool:
        """Whether the block rests inside the bowl.

        Its centre is within the inner rim and below the rim's height, in the bowl's own frame; the bowl
        stands upright; the gripper has let go; nothing moves any more.
        """
        position, orientation = world.pose(pair.target)
        x, y, z = p.multiplyTransforms(*p.invertTransform(position, orientation), *world.pose(pair.thing))[0]
        upright = p.getMatrixFromQuaternion(orientation)[8] > 0.9
        return (
            upright
            and hypot(x, y) < world.sizes.bowl_inner_radius
            and 0.0 < z < world.sizes.bowl_height
            and robot.holding != pair.thing
            and world.speed(pair.thing) < SETTLED_SPEED
        )

    def fulfilled_at_start(self, objects: Sequence[ObjectSpec], thing: int, target: int) -> bool:
        return objects[thing].inside == target
