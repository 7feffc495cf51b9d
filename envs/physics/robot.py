"""The arm at work: it follows small tool motions, stops at contact, and sucks blocks.

Both control modes of the environments run over this one controller, one camera frame at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
import pybullet as p
from numpy.typing import NDArray

from envs.physics.arm import TIP_LINK, Joints, Point
from envs.physics.simulation import Tabletop

CONTACT = 0.002
"""Gap in metres at which the suction cup seals, and at which a downward motion stops."""

FORCE = 400.0
"""Motor torque in N m: the arm is strong enough to follow; its dynamics are not the subject."""


@dataclass(frozen=True)
class GripperState:
    """What the gripper is doing."""

    position: Point
    """The tip, in metres."""
    yaw: float
    """Radians."""
    holding: int
    """Id of the held object, or -1."""


class Robot:
    """The arm controller on a built `Tabletop`."""

    def __init__(self, world: Tabletop, frame_steps: int) -> None:
        self.world = world
        self.frame_steps = frame_steps
        self._joints = list(range(6))
        self.reset(world.setup.arm.home_joints)

    def reset(self, joints: Joints, holding: int = -1) -> None:
        """Take over an arm that was just built at ``joints`` (tool upright), ``holding`` a block or nothing."""
        self.arm = self.world.setup.arm
        self.target, self.yaw = self.arm.forward(joints)
        self.holding = -1
        self.touched = False
        self._grip = -1
        self._angles = np.array(joints)
        if holding >= 0:
            self._seal(holding)

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
                start[2] = end[2] = min(start[2], self.state().position[2])
        # Full turns do not matter, and yaw must not grow without bound over a long episode.
        self.yaw = (self.yaw + pi) % (2 * pi) - pi

    def state(self) -> GripperState:
        """Where the tip really is, and what it holds."""
        position = p.getLinkState(self.world.arm, TIP_LINK, physicsClientId=self.world.client)[4]
        return GripperState(position, self.yaw, self.holding)

    def joints(self) -> NDArray[np.float64]:
        """Joint angles (6,) in radians."""
        states = p.getJointStates(self.world.arm, self._joints, physicsClientId=self.world.client)
        return np.array([state[0] for state in states])

    def _drive(self, angles: NDArray[np.float64]) -> None:
        # Wrist3 may take the short way round only at ±pi, which a change of 2 pi would spoil.
        change = (angles - self._angles + pi) % (2 * pi) - pi
        angles = self._angles + change
        p.setJointMotorControlArray(
            self.world.arm,
            self._joints,
            p.POSITION_CONTROL,
            targetPositions=angles.tolist(),
            targetVelocities=(change * self.world.physics_hz).tolist(),
            forces=[FORCE] * 6,
            positionGains=[0.5] * 6,
            velocityGains=[1.0] * 6,
            physicsClientId=self.world.client,
        )
        self._angles = angles

    def _touching(self, body: int, link: int) -> list[int]:
        """Bodies that a link touches."""
        points = p.getContactPoints(bodyA=body, linkIndexA=link, physicsClientId=self.world.client)
        return [point[2] for point in points if point[8] < CONTACT]

    def _feels_contact(self) -> bool:
        if self.holding >= 0:
            held = self.world.objects[self.holding]
            return any(body != self.world.arm for body in self._touching(held, -1))
        return bool(self._touching(self.world.arm, TIP_LINK))

    def _try_grip(self) -> None:
        for body in self._touching(self.world.arm, TIP_LINK):
            # A bowl has no flat top to seal on.
            if body in self.world.blocks:
                self._seal(self.world.objects.index(body))
                return

    def _seal(self, index: int) -> None:
        """Fix the block to the cup as it stands."""
        client, body = self.world.client, self.world.objects[index]
        link = p.getLinkState(self.world.arm, TIP_LINK, physicsClientId=client)
        inverse = p.invertTransform(link[4], link[5])
        place = p.multiplyTransforms(*inverse, *self.world.pose(index))
        self._grip = p.createConstraint(
            self.world.arm,
            TIP_LINK,
            body,
            -1,
            p.JOINT_FIXED,
            [0, 0, 0],
            place[0],
            [0, 0, 0],
            place[1],
            physicsClientId=client,
        )
        # Cup and block would fight: the constraint holds them where the contact pushes them apart.
        p.setCollisionFilterPair(self.world.arm, body, TIP_LINK, -1, 0, physicsClientId=client)
        self.holding = index

    def _release(self) -> None:
        if self.holding < 0:
            return
        client, body = self.world.client, self.world.objects[self.holding]
        p.removeConstraint(self._grip, physicsClientId=client)
        p.setCollisionFilterPair(self.world.arm, body, TIP_LINK, -1, 1, physicsClientId=client)
        self.holding = -1
