"""``put the <color> block in the <color> bowl``."""

from collections.abc import Sequence

from ..physics.robot import Robot
from ..physics.simulation import Tabletop
from ..physics.supports import SETTLED_SPEED, in_bowl
from ..scene import GoalPair, ObjectSpec
from .base import Relation


class In(Relation):
    """A block lies in a bowl, which has room for one."""

    name = "in"
    kinds = ("block", "bowl")
    exclusive = True

    def fulfilled(self, world: Tabletop, robot: Robot, pair: GoalPair) -> bool:
        """Whether the block rests inside the bowl: `in_bowl` holds, the gripper has let go, nothing moves."""
        released = robot.holding != pair.thing and world.speed(pair.thing) < SETTLED_SPEED
        return released and in_bowl(world, pair.thing, pair.target)

    def fulfilled_at_start(self, objects: Sequence[ObjectSpec], thing: int, target: int) -> bool:
        return objects[thing].inside == target
