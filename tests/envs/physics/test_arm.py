from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pybullet as p
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.colors import COLORS, RGB, ROBOT_RGB
from envs.geometry import Point
from envs.physics import ur5
from envs.physics.arm import TIP_LINK, Arm, arm_urdf
from envs.scenes import CLIPORT, SIMPLE
from envs.tabletop import TabletopEnv

ARMS = {"plain": SIMPLE.arm, "ur5": CLIPORT.arm}
anywhere = st.tuples(*[st.floats(-2, 2, allow_subnormal=False)] * 3)


needs_ur5 = pytest.mark.skipif(ur5.find_package() is None, reason="needs the extra `ur5`")


@pytest.fixture
def client() -> Iterator[int]:
    client = p.connect(p.DIRECT)
    yield client
    p.disconnect(client)


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
@given(anywhere, st.floats(-3, 3, allow_subnormal=False))
def test_inverse_kinematics_reaches_every_point_of_the_reach(arm: Arm, point: Point, yaw: float) -> None:
    allowed = arm.within_reach(point)
    position, angle = arm.forward(arm.inverse(allowed, yaw))
    assert position == pytest.approx(allowed, abs=1e-9)
    assert angle == pytest.approx(yaw, abs=1e-9)
    assert arm.within_reach(allowed) == pytest.approx(allowed, abs=1e-9)
    assert all(low <= at + 1e-9 for low, at in zip(arm.reach_low, allowed, strict=True))
    assert all(at - 1e-9 <= high for at, high in zip(allowed, arm.reach_high, strict=True))


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_the_urdf_is_the_arm_of_the_formulas(client: int, arm: Arm) -> None:
    body = p.loadURDF(arm_urdf(arm), useFixedBase=True, physicsClientId=client)
    for corner in product(*zip(arm.reach_low, arm.reach_high, strict=True)):
        point = arm.within_reach(corner)
        for index, angle in enumerate(arm.inverse(point, 0.4)):
            p.resetJointState(body, index, angle, physicsClientId=client)
        tip = p.getLinkState(body, TIP_LINK, computeForwardKinematics=True, physicsClientId=client)
        roll, pitch, yaw = p.getEulerFromQuaternion(tip[5])
        assert tip[4] == pytest.approx(point, abs=1e-5)
        assert (roll, pitch) == pytest.approx((0, 0), abs=1e-5)  # the tool points straight down
        assert yaw == pytest.approx(0.4, abs=1e-5)


def test_the_plain_arm_reaches_all_of_its_box() -> None:
    arm = SIMPLE.arm
    for corner in product(*zip(arm.reach_low, arm.reach_high, strict=True)):
        assert arm.within_reach(corner) == corner


@needs_ur5
def test_our_links_carry_the_meshes_as_the_ur5s_own_description_does(client: int) -> None:
    """Both arms in poses that differ in every joint: each link's mesh fills the same box in the world."""
    package = ur5.find_package()
    assert package is not None
    folder = Path(str(package.locate_file(ur5.FOLDER)))
    text = (folder.parents[2] / "urdf" / "ur5_robot.urdf").read_text()
    for old, new in (
        ("package://example-robot-data/robots/ur_description", str(folder.parents[2])),
        ("/visual/", "/collision/"),
        (".dae", ".stl"),
    ):
        text = text.replace(old, new)
    path = ur5.generated_file("test-ur5", ".urdf", text)
    turned = p.getQuaternionFromEuler([0, 0, np.pi])
    theirs = p.loadURDF(path, [0, 0, 0], turned, useFixedBase=True, physicsClientId=client)
    revolute = [
        index
        for index in range(p.getNumJoints(theirs, physicsClientId=client))
        if p.getJointInfo(theirs, index, physicsClientId=client)[2] == p.JOINT_REVOLUTE
    ]
    ours = p.loadURDF(arm_urdf(CLIPORT.arm), useFixedBase=True, physicsClientId=client)
    for pose in ((0.0, -1.5, 1.5, 0.0, 0.0, 0.0), (0.3, -1.2, 1.4, 0.5, -0.4, 0.7)):
        pan, lift, elbow, wrist1, wrist2, wrist3 = pose
        for index, angle in enumerate(pose):
            p.resetJointState(ours, index, angle, physicsClientId=client)
        as_ur = (pan - np.pi, lift, elbow, wrist1 - np.pi / 2, wrist2 - np.pi / 2, -wrist3)
        for index, angle in zip(revolute, as_ur, strict=True):
            p.resetJointState(theirs, index, angle, physicsClientId=client)
        for link, (index, (name, turn, shift)) in enumerate(zip(revolute, list(ur5._MESHES.values())[1:], strict=True)):
            corners = ur5._read_stl(folder / f"{name}.stl").reshape(-1, 3)
            expected = placed(client, theirs, index, corners)
            found = placed(client, ours, link, corners @ turn.T + shift)
            assert found == pytest.approx(expected, abs=1e-4), name


def placed(client: int, body: int, link: int, points: np.ndarray) -> np.ndarray:
    """Points of a link's frame in the world."""
    state = p.getLinkState(body, link, computeForwardKinematics=True, physicsClientId=client)
    turn = np.array(p.getMatrixFromQuaternion(state[5])).reshape(3, 3)
    return points @ turn.T + state[4]


def test_a_cubes_corners_keep_their_edges_and_a_flat_face_is_one() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    floor = square[[0, 1, 2, 0, 2, 3]].reshape(2, 3, 3)
    wall = floor[..., [0, 2, 1]]  # meets the floor at a right angle
    normals = ur5._smooth_normals(np.concatenate([floor, wall]))
    assert normals[:2] == pytest.approx(np.broadcast_to((0, 0, 1), (2, 3, 3)))
    assert normals[2:] == pytest.approx(np.broadcast_to((0, -1, 0), (2, 3, 3)))


def test_without_its_package_the_arm_is_of_cylinders_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ur5, "PACKAGE", "no-such-package")
    ur5._write_meshes.cache_clear()
    with pytest.warns(UserWarning, match=r"no-such-package is not installed.*textocvp\[ur5\]"):
        env = TabletopEnv(scene="cliport", image_size=168)
        _, info = env.reset(seed=0)
    env.close()
    ur5._write_meshes.cache_clear()
    share = (info["segmentation"] == 1).mean()
    assert 0.04 < share < 0.12  # as large as the real one, which has 7 %


@pytest.mark.parametrize(("point", "message"), [((1.5, 0, 0.1), "out of the arm's reach"), ((0, 0, 0.1), "base")])
def test_points_out_of_reach_are_refused(point: tuple[float, float, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SIMPLE.arm.inverse(point, 0.0)


def chroma(rgb: RGB) -> list[float]:
    """Colour without brightness: (rgb - L) / (L + 0.2), with L the mean of rgb scaled to 0..1."""
    values = [value / 255 for value in rgb]
    light = sum(values) / 3
    return [(value - light) / (light + 0.2) for value in values]


@pytest.mark.parametrize("name", COLORS)
def test_no_object_has_the_arms_hue(name: str) -> None:
    distance = sum(abs(a - b) for a, b in zip(chroma(ROBOT_RGB), chroma(COLORS[name]), strict=True))
    assert distance > 0.25
