"""Cameras: presets, and the matrices that take a world point to a pixel."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import cos, radians, sin, tan

import numpy as np
from numpy.typing import NDArray

from ..geometry import Point


@dataclass(frozen=True)
class CameraPreset:
    """A place to look from. Metres and degrees; the image is square, so ``aspect`` squashes it."""

    eye: Point
    target: Point
    fov: float  # vertical field of view
    aspect: float = 1.0  # tangent of half the horizontal field of view over that of the vertical one
    near: float = 0.1
    far: float = 10.0


def _looking_at(target: Point, distance: float, pitch: float, fov: float) -> CameraPreset:
    eye = (target[0] + distance * cos(radians(pitch)), target[1], target[2] + distance * sin(radians(pitch)))
    return CameraPreset(eye, target, fov, near=distance - 1.0, far=distance + 1.0)


PRESETS: dict[str, CameraPreset] = {
    # CLIPort's front recorder view as measured in the paper's published frames.
    "paper": CameraPreset(eye=(1.0, 0.0, 0.75), target=(0.25, 0.0, 0.0), fov=70.8, aspect=1.125),
    # From the same side, but the workspace fills the frame. From afar with a long lens, so that near and far
    # blocks are of about one size, and steep enough that no object hides behind another.
    "close": _looking_at((0.49, 0.0, 0.0), distance=2.0, pitch=56.0, fov=14.0),
}


@dataclass(frozen=True)
class Camera:
    """A preset at an image size. Pixels: u right, v down; the top-left pixel's centre is (0.5, 0.5)."""

    preset: CameraPreset
    size: int
    oversampling: int = 1  # pixels average this many drawn ones along each axis; masks show the central one

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """(3, 3) ``K``: a point (X, Y, Z) of the camera frame has u = fx X/Z + cx, v = fy Y/Z + cy."""
        # PyBullet's TinyRenderer samples a pixel at its lower left corner instead of its centre (measured:
        # masks sit half a pixel right and up of the projected bodies), hence the shift. Of an even number of
        # drawn pixels one has that corner at the centre of their average.
        half, shift = self.size / 2, (self.oversampling % 2) / (2 * self.oversampling)
        fy = half / tan(radians(self.preset.fov) / 2)
        return np.array([[fy / self.preset.aspect, 0, half + shift], [0, fy, half - shift], [0, 0, 1]])

    @property
    def extrinsics(self) -> NDArray[np.float64]:
        """(4, 4) world -> camera, in OpenCV's frame: x right, y down, z forward; metres."""
        return _extrinsics(self.preset).copy()

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pixels (..., 2) as (u, v) of world points (..., 3) in metres."""
        matrix = self.extrinsics
        in_camera = np.asarray(points) @ matrix[:3, :3].T + matrix[:3, 3]
        in_image = in_camera @ self.intrinsics.T
        return in_image[..., :2] / in_image[..., 2:]

    @cached_property
    def view_matrix(self) -> list[float]:
        """OpenGL's view matrix (x right, y up, z backward), column-major, as PyBullet takes it."""
        return (np.diag([1.0, -1.0, -1.0, 1.0]) @ self.extrinsics).T.ravel().tolist()

    @cached_property
    def projection_matrix(self) -> list[float]:
        """OpenGL's projection matrix, column-major."""
        near, far = self.preset.near, self.preset.far
        scale = 1 / tan(radians(self.preset.fov) / 2)
        matrix = np.array(
            [
                [scale / self.preset.aspect, 0, 0, 0],
                [0, scale, 0, 0],
                [0, 0, (far + near) / (near - far), 2 * far * near / (near - far)],
                [0, 0, -1, 0],
            ]
        )
        return matrix.T.ravel().tolist()

    def depth_in_metres(self, buffer: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distance along the optical axis, from OpenGL's depth buffer (0..1)."""
        near, far = self.preset.near, self.preset.far
        return (far * near / (far - (far - near) * buffer)).astype(np.float32)


@lru_cache(maxsize=16)
def _extrinsics(preset: CameraPreset) -> NDArray[np.float64]:
    eye, target = np.array(preset.eye), np.array(preset.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix
