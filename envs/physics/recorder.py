"""What is kept of each camera frame."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .robot import Robot
from .simulation import Image


class Recorder:
    """Collects the frames of one environment step, each with the state that it shows.

    A state is a dict of float32: `arm` (6,) joint angles in radians; `gripper` (5,) tip x, y, z in metres, yaw
    in radians, 1 if something is held; `object_position` (n, 3) metres; `object_orientation` (n, 4)
    quaternions x y z w; `motion` (5,) that led here: dx, dy, dz in metres, dyaw in radians, suction; 0 after a reset.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.restart()

    def restart(self) -> None:
        """Drop all frames."""
        self.images: list[Image] = []
        self.states: list[dict[str, NDArray[np.float32]]] = []

    def capture(self, motion: NDArray[np.float32]) -> None:
        """Add the frame of this moment, and the motion that led to it."""
        robot = self._robot
        self.images.append(robot.world.render())
        position, orientation = robot.world.poses()
        state = {
            "arm": robot.joints(),
            "gripper": np.array([*robot.tip(), robot.yaw, robot.holding >= 0]),
            "object_position": position,
            "object_orientation": orientation,
            "motion": motion,
        }
        self.states.append({name: value.astype(np.float32) for name, value in state.items()})

    def info(self) -> dict[str, Any]:
        """Lists over the T frames: `frames` (H, W, 3), `frame_segmentations` (H, W), and `frame_states` by name.

        No arrays (T, ...): T differs from step to step, and vectorised environments join arrays of one shape only.
        """
        names = self.states[0]
        return {
            "frames": [image.rgb.copy() for image in self.images],
            "frame_segmentations": [image.segmentation.copy() for image in self.images],
            "frame_states": {name: [state[name].copy() for state in self.states] for name in names},
        }
