"""A calibrated camera: the one thing, besides its own picture, that the planner knows about the robot's
cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A pinhole camera with OpenCV axes (x right, y down, z forward).

    Pixels are (x, y); the centre of the top-left pixel is (0.5, 0.5). World points are in metres, z up.

    Attributes:
        intrinsics: (3, 3), in pixels.
        extrinsics: (4, 4), world to camera, in metres.
    """

    intrinsics: Array
    extrinsics: Array

    def __post_init__(self) -> None:
        if np.shape(self.intrinsics) != (3, 3) or np.shape(self.extrinsics) != (4, 4):
            raise ValueError(
                f"intrinsics must be (3, 3) and extrinsics (4, 4), "
                f"got {np.shape(self.intrinsics)} and {np.shape(self.extrinsics)}"
            )

    @classmethod
    def from_info(cls, camera: Mapping[str, Any]) -> PinholeCamera:
        """From `info["camera"]` of the environments, which has `intrinsics` and `extrinsics`."""
        return cls(
            np.asarray(camera["intrinsics"], dtype=np.float64),
            np.asarray(camera["extrinsics"], dtype=np.float64),
        )

    def project(self, points: ArrayLike) -> Array:
        """World points (..., 3) in metres -> pixels (..., 2)."""
        points = np.asarray(points, dtype=np.float64)
        in_camera = points @ self.extrinsics[:3, :3].T + self.extrinsics[:3, 3]
        homogeneous = in_camera @ self.intrinsics.T
        return homogeneous[..., :2] / homogeneous[..., 2:]

    def depth(self, points: ArrayLike) -> Array:
        """Distance of world points (..., 3) along the optical axis, (...) in metres."""
        points = np.asarray(points, dtype=np.float64)
        return points @ self.extrinsics[2, :3] + self.extrinsics[2, 3]

    def unproject_to_plane(self, pixels: ArrayLike, z: float) -> Array:
        """Pixels (..., 2) -> the world points (..., 3) in metres that they show at height `z` above the
        table.

        Raises:
            ValueError: if a pixel's ray does not meet that plane in front of the camera.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)
        rotation, translation = self.extrinsics[:3, :3], self.extrinsics[:3, 3]
        rays = (homogeneous @ np.linalg.inv(self.intrinsics).T) @ rotation  # camera -> world
        center = -rotation.T @ translation
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (z - center[2]) / rays[..., 2:]
        if not np.all(np.isfinite(reach) & (reach > 0)):
            raise ValueError(f"a pixel's ray does not meet the plane z = {z} m in front of the camera")
        return center + reach * rays

    def metres_per_pixel(self, pixels: ArrayLike, z: float) -> Array:
        """How many metres one pixel spans across the line of sight, where pixels (..., 2) show height `z`:
        (...).
        """
        focal = float(self.intrinsics[0, 0])
        return self.depth(self.unproject_to_plane(pixels, z)) / focal
