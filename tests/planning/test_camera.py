import numpy as np
import pytest

from envs.colors import palette
from envs.physics.camera import PRESETS, Camera
from planning import PinholeCamera
from tests.planning.oracle import CAMERA_INFO, PALETTE_INFO


def test_the_tests_know_camera_and_colours_of_the_environments() -> None:
    close = Camera(PRESETS["close"], 64)
    np.testing.assert_allclose(CAMERA_INFO["intrinsics"], close.intrinsics, atol=1e-12)
    np.testing.assert_allclose(CAMERA_INFO["extrinsics"], close.extrinsics, atol=1e-12)
    assert palette() == PALETTE_INFO


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_agrees_with_the_environments_camera(preset: str) -> None:
    true = Camera(PRESETS[preset], 64)
    ours = PinholeCamera.from_info({"intrinsics": true.intrinsics, "extrinsics": true.extrinsics})
    points = np.random.default_rng(0).uniform([0.3, -0.2, 0.0], [0.7, 0.2, 0.2], (50, 3))
    pixels = ours.project(points)
    np.testing.assert_allclose(pixels, true.project(points))
    for point, pixel in zip(points, pixels, strict=True):
        np.testing.assert_allclose(ours.unproject_to_plane(pixel, point[2]), point, atol=1e-9)


def test_metres_per_pixel_is_the_width_of_a_pixel(camera: PinholeCamera) -> None:
    left, right = camera.unproject_to_plane([[31.5, 30.0], [32.5, 30.0]], 0.03)
    assert camera.metres_per_pixel([32.0, 30.0], 0.03) == pytest.approx(
        np.linalg.norm(right - left), rel=1e-6
    )


def test_a_ray_that_misses_the_plane_is_an_error(camera: PinholeCamera) -> None:
    with pytest.raises(ValueError, match="does not meet"):
        camera.unproject_to_plane([32.0, 32.0], 5.0)  # above the camera
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        PinholeCamera(np.eye(4), np.eye(4))
