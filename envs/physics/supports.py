"""What stands on what, read off the simulator."""

from math import hypot

import pybullet as p

from ..scene import NOWHERE, TABLE
from .robot import CONTACT, Robot
from .simulation import Tabletop

UPWARD = 0.7  # height of a unit vector that points up: a contact that carries is less than 45 degrees off
SETTLED_SPEED = 0.05  # in m/s; a resting block jitters by up to a fifth of this in PyBullet's contact solver


def supports(world: Tabletop, robot: Robot) -> tuple[int, ...]:
    """For each object by id what carries it: `TABLE`, the id of a bowl or block, or `NOWHERE`.

    A block lies in a bowl that it touches when `in_bowl` holds, and on a block that it touches from above with its
    centre over the other's face. What is held, or neither in, on, nor flat on the table, is nowhere. Bowls that stand
    upright are on the table.
    """
    return tuple(_support(world, robot, index) for index in range(len(world.objects)))


def in_bowl(world: Tabletop, block: int, bowl: int) -> bool:
    """Whether a block's centre is within the inner rim and below it, in the frame of the bowl, which stands upright."""
    position, orientation = world.pose(bowl)
    x, y, z = p.multiplyTransforms(*p.invertTransform(position, orientation), *world.pose(block))[0]
    inside = hypot(x, y) < world.sizes.bowl_inner_radius and 0.0 < z < world.sizes.bowl_height
    return inside and _uprightness(orientation) > 0.9


def _support(world: Tabletop, robot: Robot, index: int) -> int:
    body, half = world.objects[index], world.sizes.block / 2
    (x, y, z), orientation = world.pose(index)
    if body not in world.blocks:
        return TABLE if _uprightness(orientation) > 0.9 else NOWHERE
    if index == robot.holding:
        return NOWHERE
    points = [point for point in world.bullet.getContactPoints(bodyA=body) if point[8] < CONTACT]
    touched = {point[2] for point in points}
    carriers = {point[2] for point in points if point[7][2] > UPWARD}  # the normal points from B to A
    for other, carrier in enumerate(world.objects):
        a, b, c = world.pose(other)[0]
        if carrier in carriers & world.blocks and c < z and hypot(x - a, y - b) < half:
            return other
        if carrier in touched - world.blocks and in_bowl(world, index, other):
            return other
    flat = world.table in carriers and z < 1.1 * half
    return TABLE if flat else NOWHERE


def _uprightness(orientation: tuple[float, ...]) -> float:
    """1 for what stands upright, 0 for what lies on its side."""
    return float(p.getMatrixFromQuaternion(orientation)[8])
