"""A calibrated camera: all that the planner knows about the robot's cell, besides the camera's own picture."""

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

    Pixels are (x, y); the centre of the top-left pixel is (0.5, 0.5). World points are in metres, z up from the table.
    """

    intrinsics: Array  # (3, 3), in pixels
    extrinsics: Array  # (4, 4), world to camera, in metres

    def __post_init__(self) -> None:
        inner, outer = np.shape(self.intrinsics), np.shape(self.extrinsics)
        if (inner, outer) != ((3, 3), (4, 4)):
            raise ValueError(f"intrinsics must be (3, 3) and extrinsics (4, 4), got {inner} and {outer}")

    @classmethod
    def from_info(cls, camera: Mapping[str, Any]) -> PinholeCamera:
        """From `info["camera"]` of the environments, which has `intrinsics` and `extrinsics`."""
        return cls(*(np.asarray(camera[name], dtype=np.float64) for name in ("intrinsics", "extrinsics")))

    def project(self, points: ArrayLike) -> Array:
        """World points (..., 3) to pixels (..., 2)."""
        points = np.asarray(points, dtype=np.float64)
        in_camera = points @ self.extrinsics[:3, :3].T + self.extrinsics[:3, 3]
        homogeneous = in_camera @ self.intrinsics.T
        return homogeneous[..., :2] / homogeneous[..., 2:]

    def unproject_to_plane(self, pixels: ArrayLike, z: float) -> Array:
        """The world points (..., 3) that pixels (..., 2) show at height `z`.

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
        """Metres (...) that one pixel spans across the line of sight, where pixels (..., 2) show height `z`."""
        depth = self.unproject_to_plane(pixels, z) @ self.extrinsics[2, :3] + self.extrinsics[2, 3]
        return depth / float(self.intrinsics[0, 0])
