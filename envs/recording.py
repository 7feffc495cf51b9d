"""What is kept of each camera frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.robot import Robot
from envs.simulation import Image, Tabletop


@dataclass(frozen=True)
class Frame:
    """One camera frame and the state it shows."""

    image: Image
    arm: NDArray[np.float32]
    """(6,) joint angles in radians."""
    gripper: NDArray[np.float32]
    """(5,): tip x, y, z in metres, yaw in radians, 1 if something is held."""
    position: NDArray[np.float32]
    """(n, 3) objects, metres."""
    orientation: NDArray[np.float32]
    """(n, 4) objects, quaternions x y z w."""


class Recorder:
    """Collects the frames of one environment step."""

    def __init__(self, world: Tabletop, robot: Robot) -> None:
        self._world, self._robot = world, robot
        self.frames: list[Frame] = []

    @property
    def newest(self) -> Frame:
        return self.frames[-1]

    @property
    def image(self) -> Image:
        """What was seen last."""
        return self.frames[-1].image

    def restart(self) -> None:
        """Forget all frames."""
        self.frames = []

    def capture(self) -> None:
        """Add the frame of this moment."""
        grip = self._robot.state()
        position, orientation = self._world.poses()
        self.frames.append(
            Frame(
                image=self._world.render(),
                arm=self._robot.joints().astype(np.float32),
                gripper=np.array([*grip.position, grip.yaw, grip.holding >= 0], dtype=np.float32),
                position=position.astype(np.float32),
                orientation=orientation.astype(np.float32),
            )
        )

    def info(self) -> dict[str, Any]:
        """All frames, stacked: `frames` (T, H, W, 3), `frame_segmentations` (T, H, W), and `frame_states`, a
        dict of `arm` (T, 6), `gripper` (T, 5), `object_position` (T, n, 3) and `object_orientation` (T, n,
        4)."""
        frames = self.frames
        return {
            "frames": np.stack([frame.image.rgb for frame in frames]),
            "frame_segmentations": np.stack([frame.image.segmentation for frame in frames]),
            "frame_states": {
                "arm": np.stack([frame.arm for frame in frames]),
                "gripper": np.stack([frame.gripper for frame in frames]),
                "object_position": np.stack([frame.position for frame in frames]),
                "object_orientation": np.stack([frame.orientation for frame in frames]),
            },
        }
