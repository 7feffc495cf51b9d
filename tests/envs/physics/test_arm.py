from __future__ import annotations

from itertools import product

import pybullet as p
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.colors import COLORS, RGB, ROBOT_RGB
from envs.physics.arm import TIP_LINK, arm_urdf, forward_kinematics, inverse_kinematics
from envs.physics.robot import REACH_HIGH, REACH_LOW

inside = st.tuples(*(st.floats(low, high) for low, high in zip(REACH_LOW, REACH_HIGH, strict=True)))


@given(inside, st.floats(-3, 3))
def test_inverse_kinematics_reaches_every_point_of_the_reach(point: tuple[float, ...], yaw: float) -> None:
    position, angle = forward_kinematics(inverse_kinematics(point, yaw))
    assert position == pytest.approx(point, abs=1e-9)
    assert angle == pytest.approx(yaw, abs=1e-9)


def test_the_urdf_is_the_arm_of_the_formulas() -> None:
    client = p.connect(p.DIRECT)
    try:
        arm = p.loadURDF(arm_urdf(), useFixedBase=True, physicsClientId=client)
        for point in product(*zip(REACH_LOW, REACH_HIGH, strict=True)):
            for index, angle in enumerate(inverse_kinematics(point, 0.4)):
                p.resetJointState(arm, index, angle, physicsClientId=client)
            tip = p.getLinkState(arm, TIP_LINK, computeForwardKinematics=True, physicsClientId=client)
            roll, pitch, yaw = p.getEulerFromQuaternion(tip[5])
            assert tip[4] == pytest.approx(point, abs=1e-5)
            assert (roll, pitch) == pytest.approx((0, 0), abs=1e-5)  # the tool points straight down
            assert yaw == pytest.approx(0.4, abs=1e-5)
    finally:
        p.disconnect(client)


@pytest.mark.parametrize(
    ("point", "message"), [((1.5, 0, 0.1), "out of the arm's reach"), ((0, 0, 0.1), "base")]
)
def test_points_out_of_reach_are_refused(point: tuple[float, float, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        inverse_kinematics(point, 0.0)


def chroma(rgb: RGB) -> list[float]:
    """Colour without brightness: (rgb - L) / (L + 0.2), with L the mean of rgb scaled to 0..1."""
    values = [value / 255 for value in rgb]
    light = sum(values) / 3
    return [(value - light) / (light + 0.2) for value in values]


@pytest.mark.parametrize("name", COLORS)
def test_no_object_has_the_arms_hue(name: str) -> None:
    distance = sum(abs(a - b) for a, b in zip(chroma(ROBOT_RGB), chroma(COLORS[name]), strict=True))
    assert distance > 0.25
