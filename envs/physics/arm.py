"""The robot arm: a UR5-like chain with UR5 link lengths, its URDF, and closed-form inverse kinematics.

Joint convention (not UR's own signs): with all angles 0 the arm lies stretched along +x and the tool points
down.
Joints: pan about z, lift, elbow and wrist1 about y (positive lowers), wrist2 about x, wrist3 about z.
"""

from __future__ import annotations

from math import acos, asin, atan2, cos, hypot, pi, sin, sqrt

from envs.colors import ROBOT_RGB
from envs.physics.shapes import generated_file

Joints = tuple[float, float, float, float, float, float]
Point = tuple[float, float, float]

# Universal Robots' published lengths of the UR5, in metres.
D1, A2, A3, D4, D5, D6 = 0.089159, 0.425, 0.39225, 0.10915, 0.09465, 0.0823
SHOULDER_OFFSET, ELBOW_OFFSET = 0.13585, 0.1197

TOOL = 0.10
"""Length of the suction gripper below the flange."""

TIP_RADIUS = 0.018
"""Radius of the suction cup."""

FLANGE_RADIUS = 0.040

TIP_LINK = 6
"""Index of the link that carries the suction cup; its frame is the tip itself."""


def inverse_kinematics(position: Point, yaw: float) -> Joints:
    """Joint angles (radians, elbow up) that hold the tip at ``position`` (metres), pointing straight down.

    Raises:
        ValueError: when the point is out of the arm's reach.
    """
    x, y, z = position
    reach = hypot(x, y)
    if reach <= D4:
        raise ValueError(f"the point ({x:.3f}, {y:.3f}, {z:.3f}) m is too close to the robot's base")
    pan = atan2(y, x) - asin(D4 / reach)
    radial = sqrt(reach * reach - D4 * D4) - D5
    height = z + TOOL + D6 - D1
    distance = hypot(radial, height)
    if not abs(A2 - A3) < distance < A2 + A3 - 1e-3:
        raise ValueError(f"the point ({x:.3f}, {y:.3f}, {z:.3f}) m is out of the arm's reach")
    at_shoulder = acos((A2 * A2 + distance * distance - A3 * A3) / (2 * A2 * distance))
    at_elbow = acos((A2 * A2 + A3 * A3 - distance * distance) / (2 * A2 * A3))
    lift = -atan2(height, radial) - at_shoulder
    elbow = pi - at_elbow
    return pan, lift, elbow, -lift - elbow, 0.0, yaw - pan


def forward_kinematics(joints: Joints) -> tuple[Point, float]:
    """Tip position in metres and yaw in radians for joint angles with a vertical tool (wrist2 = 0)."""
    pan, lift, elbow, wrist1, _, wrist3 = joints
    wrist_pitch = lift + elbow + wrist1
    drop = TOOL + D6
    radial = A2 * cos(lift) + A3 * cos(lift + elbow) + D5 * cos(wrist_pitch) - drop * sin(wrist_pitch)
    z = D1 - A2 * sin(lift) - A3 * sin(lift + elbow) - D5 * sin(wrist_pitch) - drop * cos(wrist_pitch)
    x = radial * cos(pan) - D4 * sin(pan)
    y = radial * sin(pan) + D4 * cos(pan)
    return (x, y, z), pan + wrist3


def arm_urdf() -> str:
    """Path of the generated URDF. Only the suction cup can touch things; the other links are for the eye."""
    tool_z = -D6 - TOOL
    links = [
        _link("base", 2.0, [_cylinder(0.075, D1 + 0.05, (0, 0, D1 / 2 - 0.02))]),
        _link(
            "shoulder", 1.0, [_cylinder(0.06, SHOULDER_OFFSET + 0.06, (0, SHOULDER_OFFSET / 2, 0), along="y")]
        ),
        _link("upper_arm", 1.0, [_cylinder(0.055, A2, (A2 / 2, 0, 0), along="x")]),
        _link("forearm", 1.0, [_cylinder(0.045, A3, (A3 / 2, 0, 0), along="x")]),
        _link("wrist1", 0.3, [_cylinder(0.04, 0.12, (0, 0, 0), along="y")]),
        _link("wrist2", 0.3, [_cylinder(0.04, D5 + 0.04, (D5 / 2 + 0.01, 0, 0), along="x")]),
        _link(
            "gripper",
            0.2,
            [
                _cylinder(FLANGE_RADIUS, D6 + 0.045, (0, 0, tool_z + TOOL - 0.005 + (D6 + 0.045) / 2 - 0.04)),
                _cylinder(0.027, TOOL, (0, 0, tool_z + TOOL / 2 + 0.003)),
            ],
        ),
        _link("tip", 0.01, [], contact=f'<cylinder radius="{TIP_RADIUS}" length="0.01"/>', contact_z=0.005),
    ]
    joints = [
        _joint("pan", "base", "shoulder", (0, 0, D1), "0 0 1"),
        _joint("lift", "shoulder", "upper_arm", (0, SHOULDER_OFFSET, 0), "0 1 0"),
        _joint("elbow", "upper_arm", "forearm", (A2, -ELBOW_OFFSET, 0), "0 1 0"),
        _joint("wrist1", "forearm", "wrist1", (A3, D4 - SHOULDER_OFFSET + ELBOW_OFFSET, 0), "0 1 0"),
        _joint("wrist2", "wrist1", "wrist2", (0, 0, 0), "1 0 0"),
        _joint("wrist3", "wrist2", "gripper", (D5, 0, 0), "0 0 1"),
        f'<joint name="tip" type="fixed"><parent link="gripper"/><child link="tip"/>'
        f'<origin xyz="0 0 {tool_z}"/></joint>',
    ]
    text = '<?xml version="1.0"?>\n<robot name="arm">\n' + "\n".join(links + joints) + "\n</robot>\n"
    return generated_file("arm", ".urdf", text)


def _link(name: str, mass: float, visuals: list[str], contact: str = "", contact_z: float = 0.0) -> str:
    inertia = mass * 0.01
    tensor = f'ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"'
    touch = (
        f'<collision><origin xyz="0 0 {contact_z}"/><geometry>{contact}</geometry></collision>'
        if contact
        else ""
    )
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/><inertia {tensor}/></inertial>'
        f"{''.join(visuals)}{touch}</link>"
    )


def _cylinder(radius: float, length: float, center: Point, along: str = "z") -> str:
    turn = {"x": f"0 {pi / 2} 0", "y": f"{pi / 2} 0 0", "z": "0 0 0"}[along]
    color = " ".join(f"{value / 255:.4f}" for value in ROBOT_RGB)
    return (
        f'<visual><origin xyz="{center[0]} {center[1]} {center[2]}" rpy="{turn}"/>'
        f'<geometry><cylinder radius="{radius}" length="{length}"/></geometry>'
        f'<material name="arm"><color rgba="{color} 1"/></material></visual>'
    )


def _joint(name: str, parent: str, child: str, origin: Point, axis: str) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin[0]} {origin[1]} {origin[2]}"/><axis xyz="{axis}"/>'
        f'<limit lower="-6.3" upper="6.3" effort="1000" velocity="20"/></joint>'
    )
