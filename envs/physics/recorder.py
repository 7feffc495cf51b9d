"""What is kept of each camera frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.physics.robot import Robot
from envs.physics.simulation import Image, Tabletop


class Recorder:
    """Collects the frames of one environment step, each with the state that it shows.

    A state is a dict of float32: `arm` (6,) joint angles in radians; `gripper` (5,) tip x, y, z in metres, yaw
    in radians, 1 if something is held; `object_position` (n, 3) metres; `object_orientation` (n, 4)
    quaternions x y z w.
    """

    def __init__(self, world: Tabletop, robot: Robot) -> None:
        self._world, self._robot = world, robot
        self.restart()

    def restart(self) -> None:
        """Drop all frames."""
        self.images: list[Image] = []
        self.states: list[dict[str, NDArray[np.float32]]] = []

    def capture(self) -> None:
        """Add the frame of this moment."""
        grip = self._robot.state()
        position, orientation = self._world.poses()
        self.images.append(self._world.render())
        self.states.append(
            {
                "arm": self._robot.joints().astype(np.float32),
                "gripper": np.array([*grip.position, grip.yaw, grip.holding >= 0], dtype=np.float32),
                "object_position": position.astype(np.float32),
                "object_orientation": orientation.astype(np.float32),
            }
        )

    def info(self) -> dict[str, Any]:
        """All T frames, stacked: `frames` (T, H, W, 3), `frame_segmentations` (T, H, W), and `frame_states`, a
        dict of the states' values (T, ...)."""
        return {
            "frames": np.stack([image.rgb for image in self.images]),
            "frame_segmentations": np.stack([image.segmentation for image in self.images]),
            "frame_states": {
                name: np.stack([state[name] for state in self.states]) for name in self.states[0]
            },
        }
