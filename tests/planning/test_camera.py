import numpy as np
import pytest
import torch

from envs.colors import palette
from envs.physics.camera import PRESETS, Camera
from planning import RELATIONS, PinholeCamera, View
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
    assert camera.metres_per_pixel([32.0, 30.0], 0.03) == pytest.approx(np.linalg.norm(right - left), rel=1e-6)


def test_a_ray_that_misses_the_plane_is_an_error(camera: PinholeCamera) -> None:
    with pytest.raises(ValueError, match="does not meet"):
        camera.unproject_to_plane([32.0, 32.0], 5.0)  # above the camera
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        PinholeCamera(np.eye(4), np.eye(4))


def view_of(preset: str, size: int) -> View:
    true = Camera(PRESETS[preset], size, oversampling=2 if preset == "paper" else 1)
    return View(PinholeCamera(true.intrinsics, true.extrinsics))


def test_thresholds_stay_what_they_are_in_the_close_camera() -> None:
    places_N2 = torch.rand(50, 2) * 64
    offsets_N2 = torch.tensor([0.0, -6.9]).expand(50, 2)
    for view in (View(), view_of("close", 64)):
        assert (view.zoom(places_N2) == 1).all() and view.zoom_at_middle == 1
        assert torch.equal(view.raised(offsets_N2, places_N2), offsets_N2)


def test_thresholds_grow_with_what_a_camera_shows() -> None:
    assert view_of("close", 128).zoom_at_middle == pytest.approx(2, abs=0.02)
    paper = view_of("paper", 336)
    assert paper.zoom_at_middle == pytest.approx(1.55, abs=0.01)
    assert view_of("paper", 168).zoom_at_middle == pytest.approx(1.55 / 2, abs=0.01)
    far, near = paper.zoom(torch.tensor([[168.0, 150.0], [168.0, 300.0]]))
    assert near > 1.2 * far


@pytest.mark.parametrize("size", [336, 168])
@pytest.mark.parametrize("at", [(0.35, 0.0), (0.6, 0.0), (0.45, 0.35), (0.45, -0.35)])
def test_a_stack_leans_and_is_as_high_as_the_camera_shows_it(size: int, at: tuple[float, float]) -> None:
    """From the front face of the lower block, all that is seen of it, to the middle of the upper one."""
    view, middle = view_of("paper", size), np.array([*at, 0.029])
    towards = np.array([1.0, 0.0, 0.029]) - middle
    lower, upper = view.camera.project(
        [middle + 0.023 * towards / np.linalg.norm(towards), middle + np.array([0.0, 0.0, 0.058])]
    )
    lower_2, upper_2 = torch.tensor(lower), torch.tensor(upper)
    off = float(RELATIONS["on"].distance_of_places(upper_2, lower_2, view))
    assert off < 1.0 < RELATIONS["on"].within_px < float(RELATIONS["on"].distance_of_places(lower_2, lower_2, view))
    assert float(view.raised(torch.tensor([0.0, -1.0]), lower_2)[0]) * at[1] >= 0, "outwards"


def test_what_lies_out_of_the_picture_or_nowhere_has_a_size() -> None:
    places_N2 = torch.tensor([[-500.0, -500.0], [900.0, 50.0], [np.nan, np.nan], [np.inf, 0.0]])
    view = view_of("paper", 336)
    assert torch.isfinite(view.zoom(places_N2)).all()
    assert torch.isfinite(view.raised(torch.ones(4, 2), places_N2)).all()
