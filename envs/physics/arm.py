"""The robot arm: a UR5-like chain with UR5 link lengths, its URDF, and closed-form inverse kinematics.

With all angles 0 (not UR's own signs) the arm lies stretched along +x and the tool points down. Joints: pan about
z, lift, elbow and wrist1 about y (positive lowers), wrist2 about x, wrist3 about z.
"""

from dataclasses import dataclass
from math import acos, asin, atan2, cos, hypot, pi, sin, sqrt

from ..colors import RGB, ROBOT_RGB
from ..geometry import Point
from .shapes import generated_file
from .ur5 import ur5_meshes

Joints = tuple[float, float, float, float, float, float]

# Universal Robots' published lengths of the UR5, in metres.
D1, A2, A3, D4, D5, D6 = 0.089159, 0.425, 0.39225, 0.10915, 0.09465, 0.0823
SHOULDER_OFFSET, ELBOW_OFFSET = 0.13585, 0.1197
TOOL = 0.10  # length of the plain arm's suction gripper below the flange
TIP_RADIUS = 0.018  # radius of the suction cup

# The suction gripper of a painted arm: radius, length, and height of the centre over the flange.
GRIPPER = ((0.0382, 0.047, -0.0115), (0.0145, 0.055, -0.0625), (0.007, 0.02, -0.10))

CUP_RGB: RGB = (55, 140, 215)
FOOT_RGB: RGB = (218, 218, 218)
TIP_LINK = 6  # index of the link that carries the suction cup; its frame is the tip itself


@dataclass(frozen=True)
class Paint:
    """The two grays that a UR5 mostly has, RGB in 0..255."""

    dark: RGB = (50, 50, 50)  # shoulder, forearm, second wrist and gripper
    light: RGB = (203, 203, 203)  # upper arm, first and third wrist

    @property
    def links(self) -> dict[int, RGB]:
        """By PyBullet's index of the link; the base is -1."""
        dark, light = self.dark, self.light
        return {0: dark, 1: light, 2: dark, 3: light, 4: dark, 5: light, 6: CUP_RGB, 7: dark, -1: FOOT_RGB}


@dataclass(frozen=True)
class Arm:
    """How an arm is built and where its tip may be, in metres."""

    home: Point  # where the tip rests
    reach_low: Point  # the tip's commanded place stays within these corners, and within the arm's own reach
    reach_high: Point
    tool: float = TOOL  # length of the suction gripper below the flange
    paint: Paint | None = None  # None: a plain arm of cylinders in `ROBOT_RGB`

    @property
    def home_joints(self) -> Joints:
        return self.inverse(self.home, 0.0)

    def inverse(self, position: Point, yaw: float) -> Joints:
        """Joint angles (radians, elbow up) that hold the tip at ``position`` (metres), pointing straight down.

        Raises:
            ValueError: when the point is out of the arm's reach.
        """
        x, y, z = position
        reach, name = hypot(x, y), f"the point ({x:.3f}, {y:.3f}, {z:.3f}) m"
        if reach <= D4:
            raise ValueError(f"{name} is too close to the robot's base")
        pan = atan2(y, x) - asin(D4 / reach)
        radial = sqrt(reach * reach - D4 * D4) - D5
        height = z + self.tool + D6 - D1
        distance = hypot(radial, height)
        if not abs(A2 - A3) < distance < A2 + A3 - 1e-3:
            raise ValueError(f"{name} is out of the arm's reach")
        at_shoulder = acos((A2 * A2 + distance * distance - A3 * A3) / (2 * A2 * distance))
        at_elbow = acos((A2 * A2 + A3 * A3 - distance * distance) / (2 * A2 * A3))
        lift = -atan2(height, radial) - at_shoulder
        elbow = pi - at_elbow
        return pan, lift, elbow, -lift - elbow, 0.0, yaw - pan

    def forward(self, joints: Joints) -> tuple[Point, float]:
        """Tip position in metres and yaw in radians for joint angles with a vertical tool (wrist2 = 0)."""
        pan, lift, elbow, wrist1, _, wrist3 = joints
        wrist_pitch = lift + elbow + wrist1
        drop = self.tool + D6
        radial = A2 * cos(lift) + A3 * cos(lift + elbow) + D5 * cos(wrist_pitch) - drop * sin(wrist_pitch)
        z = D1 - A2 * sin(lift) - A3 * sin(lift + elbow) - D5 * sin(wrist_pitch) - drop * cos(wrist_pitch)
        x = radial * cos(pan) - D4 * sin(pan)
        y = radial * sin(pan) + D4 * cos(pan)
        return (x, y, z), pan + wrist3

    def within_reach(self, point: Point) -> Point:
        """The nearest allowed place, found axis by axis; over far places the tip hangs lower."""
        bounds = zip(point, self.reach_low, self.reach_high, strict=True)
        x, y, z = (min(max(value, low), high) for value, low, high in bounds)
        longest, drop = A2 + A3 - 2e-3, D6 + self.tool - D1
        lowest = self.reach_low[2] + drop
        furthest = hypot(sqrt(longest**2 - lowest**2) + D5, D4)
        if (reach := hypot(x, y)) > furthest:
            x, y = x * furthest / reach, y * furthest / reach
        radial = sqrt(x * x + y * y - D4 * D4) - D5
        return x, y, min(z, sqrt(longest**2 - radial * radial) - drop)


def arm_urdf(arm: Arm) -> str:
    """Path of the generated URDF. Only the suction cup can touch things; the other links are for the eye.

    A painted arm has the UR5's real shape if its package is installed, else cylinders.
    """
    tool_z, flange = -D6 - arm.tool, D6 + 0.045
    looks = {
        "base": _cylinder(0.075, D1 + 0.05, (0, 0, D1 / 2 - 0.02)),
        "shoulder": _cylinder(0.06, SHOULDER_OFFSET + 0.06, (0, SHOULDER_OFFSET / 2, 0), along="y"),
        "upper_arm": _cylinder(0.055, A2, (A2 / 2, 0, 0), along="x"),
        "forearm": _cylinder(0.045, A3, (A3 / 2, 0, 0), along="x"),
        "wrist1": _cylinder(0.04, 0.12, (0, 0, 0), along="y"),
        "wrist2": _cylinder(0.04, D5 + 0.04, (D5 / 2 + 0.01, 0, 0), along="x"),
        "gripper": _cylinder(0.04, flange, (0, 0, tool_z + arm.tool - 0.005 + flange / 2 - 0.04)),
    }
    cup = ""
    if arm.paint is None:
        looks["gripper"] += _cylinder(0.027, arm.tool, (0, 0, tool_z + arm.tool / 2 + 0.003))
    else:
        for name, path in ur5_meshes().items():
            looks[name] = f'<visual><geometry><mesh filename="{path}"/></geometry></visual>'
        cup = _cylinder(0.0095, 0.016, (0, 0, 0.0025))
    cup += (
        '<collision><origin xyz="0 0 0.005"/>'
        f'<geometry><cylinder radius="{TIP_RADIUS}" length="0.01"/></geometry></collision>'
    )
    masses = (2.0, 1.0, 1.0, 1.0, 0.3, 0.3, 0.2)
    links = [_link(name, mass, looks[name]) for name, mass in zip(looks, masses, strict=True)]
    links.append(_link("tip", 0.01, cup))
    joints = [
        _joint("pan", "base", "shoulder", (0, 0, D1), "0 0 1"),
        _joint("lift", "shoulder", "upper_arm", (0, SHOULDER_OFFSET, 0), "0 1 0"),
        _joint("elbow", "upper_arm", "forearm", (A2, -ELBOW_OFFSET, 0), "0 1 0"),
        _joint("wrist1", "forearm", "wrist1", (A3, D4 - SHOULDER_OFFSET + ELBOW_OFFSET, 0), "0 1 0"),
        _joint("wrist2", "wrist1", "wrist2", (0, 0, 0), "1 0 0"),
        _joint("wrist3", "wrist2", "gripper", (D5, 0, 0), "0 0 1"),
        _joint("tip", "gripper", "tip", (0, 0, tool_z)),
    ]
    if arm.paint is not None:
        parts = [_cylinder(radius, length, (0, 0, z - D6)) for radius, length, z in GRIPPER]
        links.append(_link("tool", 0.01, "".join(parts)))
        joints.append(_joint("tool", "gripper", "tool", (0, 0, 0.0)))
    text = '<?xml version="1.0"?>\n<robot name="arm">\n' + "\n".join(links + joints) + "\n</robot>\n"
    return generated_file("arm", ".urdf", text)


def _link(name: str, mass: float, shapes: str) -> str:
    inertia = mass * 0.01
    tensor = f'ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"'
    return f'<link name="{name}"><inertial><mass value="{mass}"/><inertia {tensor}/></inertial>{shapes}</link>'


def _cylinder(radius: float, length: float, center: Point, along: str = "z") -> str:
    turn = {"x": f"0 {pi / 2} 0", "y": f"{pi / 2} 0 0", "z": "0 0 0"}[along]
    color = " ".join(f"{value / 255:.4f}" for value in ROBOT_RGB)
    return (
        f'<visual><origin xyz="{center[0]} {center[1]} {center[2]}" rpy="{turn}"/>'
        f'<geometry><cylinder radius="{radius}" length="{length}"/></geometry>'
        f'<material name="arm"><color rgba="{color} 1"/></material></visual>'
    )


def _joint(name: str, parent: str, child: str, origin: Point, axis: str = "") -> str:
    """A joint that turns about ``axis``, or is fixed."""
    kind = "revolute" if axis else "fixed"
    turning = f'<axis xyz="{axis}"/><limit lower="-6.3" upper="6.3" effort="1000" velocity="20"/>'
    return (
        f'<joint name="{name}" type="{kind}">'
        f'<parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin[0]} {origin[1]} {origin[2]}"/>{turning if axis else ""}</joint>'
    )
