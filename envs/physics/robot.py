"""The arm at work: one camera frame at a time it moves its tip, stops at contact, and sucks blocks."""

from math import dist, pi

import numpy as np
import pybullet as p
from numpy.typing import NDArray

from ..geometry import Point
from .arm import TIP_LINK, Joints
from .simulation import Tabletop

JOINTS = list(range(6))
CONTACT = 0.002  # gap in metres at which the suction cup seals, and at which a downward motion stops
HOME_TOLERANCE = 0.02  # how close to its resting place the tip must be to count as home, in metres
FORCE = 400.0  # motor torque in N m: the arm is strong enough to follow; its dynamics are not the subject


class Robot:
    """The arm controller on a built `Tabletop`."""

    def __init__(self, world: Tabletop, frame_steps: int) -> None:
        self.world, self.frame_steps = world, frame_steps
        self.reset(world.setup.arm.home_joints)

    def reset(self, joints: Joints, holding: int = -1) -> None:
        """Take over an arm that was just built at ``joints`` (tool upright), ``holding`` a block or nothing."""
        self.arm = self.world.setup.arm
        self.target, self.yaw = self.arm.forward(joints)
        self.holding = self._grip = -1
        self.touched = False
        self._angles = np.array(joints)
        if holding >= 0:
            self._seal(holding)

    @property
    def is_home(self) -> bool:
        """Whether the tip is at its resting place."""
        return dist(self.tip(), self.arm.home) < HOME_TOLERANCE

    @property
    def frame_time(self) -> float:
        """Seconds from one camera frame to the next."""
        return self.frame_steps / self.world.physics_hz

    def hold_still(self, steps: int) -> None:
        """Let the world run while the arm keeps its place, until objects rest or ``steps`` steps are over."""
        self._drive(self._angles)
        self.world.settle(steps)

    def move(self, delta: NDArray[np.float32], dyaw: float, suction: bool) -> None:
        """Move the tip by ``delta`` (3, metres) and ``dyaw`` (radians) within one camera frame.

        A downward motion stops where the cup, or the block under it, touches something: `touched` tells. With
        ``suction`` on, a block that the cup touches is held; without, it is let go.
        """
        start, yaw = np.array(self.target), self.yaw
        end = np.array(self.arm.within_reach(tuple(start + delta)))
        lowering = bool(end[2] < start[2])
        self.touched = False
        if not suction:
            self._release()
        for step in range(1, self.frame_steps + 1):
            share = step / self.frame_steps
            self.target = tuple(start + share * (end - start))
            self.yaw = yaw + share * dyaw
            self._drive(np.array(self.arm.inverse(self.target, self.yaw)))
            self.world.step()
            if suction and self.holding < 0:
                self._try_grip()
            if lowering and not self.touched and self._feels_contact():
                # The tip lags a little behind its command: stop where it is, not where it was going to be.
                self.touched = True
                start[2] = end[2] = min(start[2], self.tip()[2])
        # Full turns do not matter, and yaw must not grow without bound over a long episode.
        self.yaw = (self.yaw + pi) % (2 * pi) - pi

    def tip(self) -> Point:
        """Where the tip really is, in metres."""
        return self.world.bullet.getLinkState(self.world.arm, TIP_LINK)[4]

    def joints(self) -> NDArray[np.float64]:
        """Joint angles (6,) in radians."""
        return np.array([state[0] for state in self.world.bullet.getJointStates(self.world.arm, JOINTS)])

    def _drive(self, angles: NDArray[np.float64]) -> None:
        # Wrist3 may take the short way round only at ±pi, which a change of 2 pi would spoil.
        change = (angles - self._angles + pi) % (2 * pi) - pi
        angles = self._angles + change
        self.world.bullet.setJointMotorControlArray(
            self.world.arm,
            JOINTS,
            p.POSITION_CONTROL,
            targetPositions=angles.tolist(),
            targetVelocities=(change * self.world.physics_hz).tolist(),
            forces=[FORCE] * 6,
            positionGains=[0.5] * 6,
            velocityGains=[1.0] * 6,
        )
        self._angles = angles

    def _touching(self, body: int, link: int) -> list[int]:
        """Bodies that a link touches."""
        points = self.world.bullet.getContactPoints(bodyA=body, linkIndexA=link)
        return [point[2] for point in points if point[8] < CONTACT]

    def _feels_contact(self) -> bool:
        if self.holding < 0:
            return bool(self._touching(self.world.arm, TIP_LINK))
        held = self.world.objects[self.holding]
        return any(body != self.world.arm for body in self._touching(held, -1))

    def _try_grip(self) -> None:
        # A bowl has no flat top to seal on.
        blocks = [body for body in self._touching(self.world.arm, TIP_LINK) if body in self.world.blocks]
        if blocks:
            self._seal(self.world.objects.index(blocks[0]))

    def _seal(self, index: int) -> None:
        """Fix the block to the cup as it stands."""
        world, body = self.world, self.world.objects[index]
        link = world.bullet.getLinkState(world.arm, TIP_LINK)
        place, turn = p.multiplyTransforms(*p.invertTransform(link[4], link[5]), *world.pose(index))
        self._grip = world.bullet.createConstraint(
            world.arm, TIP_LINK, body, -1, p.JOINT_FIXED, [0, 0, 0], place, [0, 0, 0], turn
        )
        # Cup and block would fight: the constraint holds them where the contact pushes them apart.
        world.bullet.setCollisionFilterPair(world.arm, body, TIP_LINK, -1, 0)
        self.holding = index

    def _release(self) -> None:
        if self.holding < 0:
            return
        world, body = self.world, self.world.objects[self.holding]
        world.bullet.removeConstraint(self._grip)
        world.bullet.setCollisionFilterPair(world.arm, body, TIP_LINK, -1, 1)
        self.holding = -1
