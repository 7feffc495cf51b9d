"""A calibrated camera: all that the planner knows about the robot's cell, besides the camera's own picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

Array = NDArray[np.float64]

MIDDLE_HEIGHT = 0.03  # metres above the table at which apparent sizes are measured
# Metres from what is seen of a block that carries another, whose top is hidden: the other's middle is so much higher,
# and its own middle so much farther from the camera along the table.
STEP_UP, STEP_BACK = 0.0575, 0.023


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
        return self.metres_per_pixel_at(self.unproject_to_plane(pixels, z))

    def metres_per_pixel_at(self, points: Array) -> Array:
        """The same (...) where world points (..., 3) are."""
        return (points @ self.extrinsics[2, :3] + self.extrinsics[2, 3]) / float(self.intrinsics[0, 0])


# The camera "close" of the environments, in pictures of 64x64 pixels.
CLOSE = PinholeCamera(
    np.array([[260.619085695187, 0.0, 32.5], [0.0, 260.619085695187, 31.5], [0.0, 0.0, 1.0]]),
    np.array([[0.0, 1.0, 0.0, 0.0], [0.8290375725550417, 0.0, -0.5591929034707468, -0.4062284105519705],
              [-0.5591929034707468, 0.0, -0.8290375725550417, 2.274004522700666], [0.0, 0.0, 0.0, 1.0]]),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class View:
    """What thresholds in pixels, all of them calibrated in pictures of `CLOSE`, are in those of another camera.

    They follow the place in the picture: a camera that is near shows one end of the table much larger than the other,
    and stacks lean. In pictures of `CLOSE` itself they stay what they are.
    """

    camera: PinholeCamera = CLOSE

    def zoom(self, places_N2: Tensor) -> Tensor:
        """How many pixels (...) a pixel of `CLOSE` is, where places (..., 2) in pixels show the table."""
        if self._is_close:
            return torch.ones_like(places_N2[..., 0])
        zoom = _METRES / self.camera.metres_per_pixel_at(self._points(places_N2))
        return torch.as_tensor(zoom).to(places_N2)

    @property
    def zoom_at_middle(self) -> float:
        """`zoom` in the middle of the picture."""
        return float(self.zoom(torch.as_tensor(self.camera.intrinsics[:2, 2])))

    def raised(self, offset_N2: Tensor, places_N2: Tensor) -> Tensor:
        """From pixels of `CLOSE` to pixels here: offsets (..., 2) of what is on top of things at places (..., 2)."""
        if self._is_close:
            return offset_N2
        step = _step(self.camera, self._points(places_N2)) / np.linalg.norm(_step(CLOSE, _MIDDLE))
        right_N1, down_N1 = offset_N2.split(1, dim=-1)
        step_N2 = torch.as_tensor(step).to(offset_N2)
        side_N2 = torch.stack([-step_N2[..., 1], step_N2[..., 0]], dim=-1)  # at a right angle to it
        return right_N1 * side_N2 - down_N1 * step_N2

    @cached_property
    def _is_close(self) -> bool:
        same = np.allclose(self.camera.intrinsics, CLOSE.intrinsics, rtol=0, atol=1e-9)
        return same and np.allclose(self.camera.extrinsics, CLOSE.extrinsics, rtol=0, atol=1e-9)

    def _points(self, places_N2: Tensor) -> Array:
        """The points (..., 3) that places show; what is imagined out of the picture counts as at its edge."""
        inside = np.nan_to_num(places_N2.detach().cpu().double().numpy())
        inside = np.clip(inside, 0.0, 2 * self.camera.intrinsics[:2, 2])
        return self.camera.unproject_to_plane(inside, MIDDLE_HEIGHT)


def _step(camera: PinholeCamera, points: Array) -> Array:
    """Pixels (..., 2) from what is seen of blocks at points (..., 3) that carry others to these."""
    towards = (-camera.extrinsics[:3, :3].T @ camera.extrinsics[:3, 3] - points) * (1.0, 1.0, 0.0)
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    upper, lower = points + np.array([0.0, 0.0, STEP_UP]), points + STEP_BACK * towards
    return camera.project(upper) - camera.project(lower)


_MIDDLE = CLOSE.unproject_to_plane(CLOSE.intrinsics[:2, 2], MIDDLE_HEIGHT)
_METRES = CLOSE.metres_per_pixel_at(_MIDDLE)
