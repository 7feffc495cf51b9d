from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet as p
import pytest

from envs.colors import COLORS, ROBOT_RGB
from envs.factors import Factors
from envs.geometry import SPAWN, WORKSPACE, Sizes
from envs.physics.camera import PRESETS, Camera
from planning.grounding import TABLETOP, Palette

Make = Callable[..., gym.Env[Any, Any]]
SIZES = Sizes()


def block_corners(block: dict[str, Any], edge: float = SIZES.block) -> np.ndarray:
    """The 8 corners (8, 3) of a block, in the world."""
    half = edge / 2
    turn = np.array(p.getMatrixFromQuaternion(block["orientation"])).reshape(3, 3)
    return block["position"] + np.array(list(product((-half, half), repeat=3))) @ turn.T


def project(camera: dict[str, np.ndarray], points: np.ndarray) -> np.ndarray:
    """As a user would, from `info["camera"]` alone."""
    in_camera = points @ camera["extrinsics"][:3, :3].T + camera["extrinsics"][:3, 3]
    in_image = in_camera @ camera["intrinsics"].T
    return in_image[:, :2] / in_image[:, 2:]


VIEWS = {
    "close": {},
    "paper": {"camera": "paper"},
    "cliport": {"scene": "cliport"},
    "moved": {"scene": "varied", "factors": Factors().without(["on_block", "carried"])},
}


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_projected_corners_bound_the_segmented_blocks(make: Make, view: dict[str, Any]) -> None:
    """Exact to half a pixel: pixel column c covers u from c to c + 1."""
    env = make(image_size=336, **view)
    worst = 0.0
    for seed in range(3):
        _, info = env.reset(seed=seed, options={"n_bowls": 1})
        for block in (item for item in info["objects"] if item["kind"] == "block"):
            edge = env.unwrapped.world.sizes.block
            corners = project(info["camera"], block_corners(block, edge))
            rows, columns = np.nonzero(info["segmentation"] == 2 + block["id"])
            seen = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            expected = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
            # Hidden blocks show less; every corner of a free one is within a pixel of its mask.
            if (np.abs(seen - expected) < 3).all():
                worst = max(worst, np.abs(seen - expected).max())
                continue
            assert info["segmentation"][rows.min() : rows.max(), columns.min() : columns.max()].min() >= 0
    assert 0 < worst < 1.6


@pytest.mark.parametrize(
    ("view", "size"), [("close", 64), ("close", 336), ("paper", 336), ("cliport", 336), ("moved", 336)]
)
def test_the_grid_of_pixels_is_not_shifted(make: Make, view: str, size: int) -> None:
    """Over many blocks, bounding boxes of masks and of projected corners are centred to a fifth of a pixel."""
    env = make(image_size=size, **VIEWS[view])
    shifts = []
    for seed in range(6):
        _, info = env.reset(seed=seed, options={"n_bowls": 1, "n_objects": 4})
        for block in (item for item in info["objects"] if item["kind"] == "block"):
            corners = project(info["camera"], block_corners(block, env.unwrapped.world.sizes.block))
            rows, columns = np.nonzero(info["segmentation"] == 2 + block["id"])
            center = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
            shifts.append(center - (corners.min(axis=0) + corners.max(axis=0)) / 2)
    assert np.abs(np.median(shifts, axis=0)).max() < 0.2


def test_depth_is_the_distance_along_the_optical_axis(make: Make) -> None:
    env = make(extras=("depth",), image_size=128)
    observation, info = env.reset(seed=2)
    camera = info["camera"]
    rows, columns = np.nonzero(info["segmentation"] == 0)
    # Back to the world from pixel centres and depth: the table is z = 0.
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    points = np.linalg.inv(camera["intrinsics"]) @ pixels * observation["depth"][rows, columns]
    world = np.linalg.inv(camera["extrinsics"]) @ np.vstack([points, np.ones(len(rows))])
    assert np.median(np.abs(world[2])) < 0.003
    assert WORKSPACE.x[0] - 0.1 < world[0].min() and world[0].max() < WORKSPACE.x[1] + 0.1


def test_project_is_what_the_info_says(make: Make) -> None:
    _, info = make().reset(seed=0)
    points = np.array([[0.5, 0.1, 0.0], [0.3, -0.2, 0.1]])
    assert np.allclose(Camera(PRESETS["close"], 64).project(points), project(info["camera"], points))


def test_extrinsics_are_a_rigid_motion_into_opencvs_frame() -> None:
    for preset in PRESETS.values():
        matrix = Camera(preset, 64).extrinsics
        assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3))
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        up, _ = matrix[:3, :3] @ (0, 0, 1), matrix
        assert up[1] < 0  # y points down
        target = matrix @ (*preset.target, 1)
        assert target[:2] == pytest.approx((0, 0), abs=1e-9) and target[2] > 0


def test_the_close_view_sees_only_table_and_blocks_of_7_pixels(make: Make) -> None:
    env = make()
    for x, y, yaw in product((SPAWN.x[0], 0.5, SPAWN.x[1]), SPAWN.y, (0.0, np.pi / 4)):
        layout = [
            {"kind": "block", "color": "red", "xy": (x, y), "yaw": yaw},
            {"kind": "bowl", "color": "blue", "xy": (0.5, 0.0)},
        ]
        _, info = env.reset(seed=0, options={"layout": layout})
        label = info["segmentation"]
        widths = [np.ptp(np.nonzero(label == 2 + k)[1]) + 1 for k in range(2)]
        assert widths[0] >= 7
        assert widths[1] > 1.4 * widths[0] if yaw == 0 else widths[1] > widths[0]
        assert not (label[:, 0] > 1).any() and not (label[:, -1] > 1).any() and not (label[-1] > 1).any()


def test_the_resting_arm_is_seen_at_the_upper_edge(make: Make) -> None:
    for seed in range(5):
        _, info = make().reset(seed=seed)
        arm = info["segmentation"] == 1
        assert arm.sum() >= 60
        assert arm[0].any() and not arm[16:].any()


def test_colours_are_the_named_ones(make: Make) -> None:
    """Table and floor exactly; objects up to mild shading, which keeps the hue; the arm all of one hue."""
    env = make(image_size=128)
    for seed in range(4):
        observation, info = env.reset(seed=seed, options={"color_split": "all"})
        rgb, label = observation["rgb"].astype(float), info["segmentation"]
        assert (rgb[label == 0] == 47).all()
        for item in info["objects"]:
            pixels, named = rgb[label == 2 + item["id"]], np.array(COLORS[item["color"]])
            share = pixels / named
            assert share.min() > 0.6 and share.max() < 1.1
            assert np.abs(np.median(pixels, axis=0) - named).max() < 0.16 * 255
            assert (share.max(axis=1) - share.min(axis=1)).max() < 0.1
        share = rgb[label == 1] / np.array(ROBOT_RGB)
        assert (share.max(axis=1) - share.min(axis=1)).max() < 0.1


def test_labels_and_palette_of_the_info_are_what_is_drawn(make: Make) -> None:
    """From `info` alone: each object's pixels carry its label, and the palette's colour up to shading."""
    env = make(image_size=128)
    for seed in range(4):
        observation, info = env.reset(seed=seed, options={"color_split": "all"})
        rgb, segmentation, palette = observation["rgb"].astype(float), info["segmentation"], info["palette"]
        labels = [item["label"] for item in info["objects"]]
        assert set(np.unique(segmentation)) == {0, 1, *labels} and len(set(labels)) == len(labels)
        assert (rgb[segmentation == 0] == palette["table"]).all()
        assert Palette.from_info(palette) == TABLETOP  # which is meant where a program gives none
        things = [(item["label"], palette["colors"][item["color"]]) for item in info["objects"]]
        seen_at = {}
        for label, color in [*things, (1, palette["robot"])]:
            share = np.median(rgb[segmentation == label], axis=0) / color
            assert share.min() > 0.6 and share.max() < 1.1 and np.ptp(share) < 0.1
            rows, columns = np.nonzero(segmentation == label)
            seen_at[label] = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        for item in info["objects"]:
            (center,) = project(info["camera"], item["position"][None])
            assert np.abs(seen_at[item["label"]] - center).max() < 8


def test_the_paper_view_has_the_papers_floor_and_table(make: Make) -> None:
    observation, info = make(camera="paper", image_size=128).reset(seed=0)
    background = observation["rgb"][info["segmentation"] == 0].reshape(-1, 3)
    assert {tuple(color) for color in np.unique(background, axis=0).tolist()} == {(47,) * 3, (239,) * 3}
    assert (observation["rgb"][0, 0] == 239).all() and (observation["rgb"][-1, 64] == 47).all()
