"""The looks and measures of a tabletop: what `scene="simple"`, "cliport" and "varied" mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import atan2, ceil, cos, degrees, hypot, radians, sin
from typing import Any

import numpy as np

from .checks import check_choice, check_range
from .colors import COLORS, FLOOR_RGB, RGB, ROBOT_RGB, TABLE_RGB, palette
from .factors import NO_FACTORS, SHARES, Factors
from .geometry import SIZES, SPAWN, TABLE, WORKSPACE, Box2, Point, Sizes
from .physics.arm import A2, A3, D1, D4, D5, D6, Arm, Paint
from .physics.camera import PRESETS, CameraPreset
from .physics.ur5 import find_package, missing
from .scene import MAX_OBJECTS


@dataclass(frozen=True)
class Light:
    """One lamp far away, and light from everywhere. Faces away from the lamp have only the latter."""

    direction: Point  # towards the lamp
    ambient: float
    diffuse: float
    specular: float = 0.0


@dataclass(frozen=True)
class Motion:
    """How a pick-and-place moves."""

    pick_height: float  # height of the tip over the place to pick, before and after, in metres
    place_height: float
    descent_speed: float  # in m/s; contact must fall well inside a frame, on the table and in bowls
    # Length of the joints' velocity, rad/s, constant along straight lines, as in CLIPort; the tip goes down
    # until something is touched. None: the tip moves softly along straight lines, for fixed times.
    joint_speed: float | None = None


@dataclass(frozen=True)
class Setup:
    """Everything of a scene but its objects."""

    camera: CameraPreset
    physics_hz: int  # physics steps per second, unless the user asks for others
    table: Box2  # the table top that is seen
    workspace: Box2  # where a primitive may pick and place
    spawn: Box2  # where objects stand at the start
    edge: float  # how far from the spawn area's edge, in footprints
    arm: Arm
    motion: Motion
    light: Light
    sizes: Sizes = SIZES["paper"]
    table_rgb: RGB = TABLE_RGB
    floor_rgb: RGB = FLOOR_RGB
    # By id, the factor of an object's colour and what is added to it.
    object_tones: tuple[tuple[float, Point], ...] = ((1.0, (0, 0, 0)),) * MAX_OBJECTS
    round_bowls: bool = False  # whether bowls look round instead of conical; they feel the same
    oversampling: int = 1  # frames are drawn this many times larger along each axis and averaged
    crowded: bool = False  # whether objects may share a colour, stand on each other, and hang at the arm
    factors: Factors = NO_FACTORS

    @property
    def palette(self) -> dict[str, Any]:
        """See `envs.colors.palette`; the robot's colour is that of most of it."""
        return palette(self.arm.paint.dark if self.arm.paint else ROBOT_RGB, self.table_rgb)

    @property
    def missing(self) -> str:
        """What to say where the arm should have the UR5's shape and its package is not installed; else nothing."""
        return missing() if self.arm.paint is not None and find_package() is None else ""

    def object_rgb(self, index: int, color: str) -> RGB:
        """The exact colour of an object."""
        gain, tint = self.object_tones[index]
        return _shifted(COLORS[color], tint, gain)

    def with_factors(self, drawn: Mapping[str, Any]) -> Setup:
        """This setup with the values of `Factors.draw`."""
        tint = drawn.get("tint", np.zeros((4, 3)))

        def gray(name: str, usual: RGB, row: int) -> RGB:
            return _shifted((drawn[name],) * 3 if name in drawn else usual, tint[row])

        light, arm, sizes = self.light, self.arm, self.sizes
        if "light_tilt" in drawn or "light_turn" in drawn:
            x, y, z = light.direction
            tilt = radians(drawn.get("light_tilt", degrees(atan2(hypot(x, y), z))))
            turn = radians(drawn.get("light_turn", degrees(atan2(y, x))))
            light = replace(light, direction=(sin(tilt) * cos(turn), sin(tilt) * sin(turn), cos(tilt)))
        strengths = ("ambient", "diffuse", "specular")
        light = replace(light, **{name: drawn[name] for name in strengths if name in drawn})
        if arm.paint is not None:
            dark, pale = gray("arm_dark", arm.paint.dark, 2), gray("arm_light", arm.paint.light, 3)
            arm = replace(arm, paint=replace(arm.paint, dark=dark, light=pale))
        if "block" in drawn or "bowl" in drawn:
            block = drawn.get("block", sizes.block)
            # A block must lie flat at any yaw. Whole millimetres, because each bowl is a generated file.
            narrowest = 2 * sizes.bowl_radius * (1.1 * block * 0.5**0.5 / sizes.bowl_floor_radius)
            bowl = max(drawn.get("bowl", 2 * sizes.bowl_radius), narrowest)
            sizes = sizes.resized(block, ceil(1000 * bowl) / 1000)
        view = np.array([self.camera.eye, self.camera.target]) + drawn.get("camera_shift", 0.0)
        (eye, target), fov = map(tuple, view.tolist()), self.camera.fov + drawn.get("camera_zoom", 0.0)
        gains = drawn.get("object_gain", [1.0] * MAX_OBJECTS)
        tints = drawn.get("object_tint", [(0, 0, 0)] * MAX_OBJECTS)
        return replace(
            self,
            camera=replace(self.camera, eye=eye, target=target, fov=fov),
            arm=arm,
            light=light,
            sizes=sizes,
            table_rgb=gray("table_gray", self.table_rgb, 0),
            floor_rgb=gray("floor_gray", self.floor_rgb, 1),
            object_tones=tuple(zip(gains, tints, strict=True)),
        )


def _shifted(rgb: tuple[float, ...], tint: Any, gain: float = 1.0) -> RGB:
    red, green, blue = np.clip(np.array(rgb) * gain + tint, 0, 255).round().astype(int).tolist()
    return red, green, blue


SIMPLE = Setup(
    camera=PRESETS["close"],
    physics_hz=240,
    table=TABLE,
    workspace=WORKSPACE,
    spawn=SPAWN,
    edge=0.0,
    # At home the arm is seen at the upper edge of the `close` view, in front of no object.
    arm=Arm(home=(0.348, 0.0, 0.13), reach_low=(0.20, -0.30, 0.006), reach_high=(0.78, 0.30, 0.25)),
    # At this height a hanging block clears all that stands on the table alone; over stacks the arm goes higher.
    motion=Motion(pick_height=0.16, place_height=0.16, descent_speed=0.675),
    # Mild light from above the camera's shoulder, and no shadow: faces and the rim of a bowl stay readable,
    # yet a thing keeps about one colour, the one it is named after. Ambient and diffuse light add up to
    # about 1 on a face seen from above.
    light=Light((0.5, -0.35, 1.0), ambient=0.74, diffuse=0.30),
)
"""A scene made easy: near camera, even light, an arm of a colour of its own, no colour twice."""

_CLIPORT_SPACE = Box2(x=(0.25, 0.75), y=(-0.5, 0.5))

CLIPORT = Setup(
    camera=PRESETS["paper"],
    physics_hz=480,
    table=_CLIPORT_SPACE,
    workspace=_CLIPORT_SPACE,
    spawn=_CLIPORT_SPACE,
    edge=1.5,
    arm=Arm(
        # Upper arm upright, forearm level: (-1, -.5, .5, -.5, -.5, 0) pi as a UR5 counts.
        home=(A3 + D5, D4, D1 + A2 - D6 - 0.12),
        reach_low=(0.20, -0.55, 0.006),
        reach_high=(0.85, 0.55, 0.42),
        tool=0.12,
        paint=Paint(),
    ),
    # 0.32 m over a block's top and a bowl's middle, as CLIPort's primitive; its arm has this speed.
    motion=Motion(pick_height=0.375, place_height=0.345, descent_speed=1.35, joint_speed=5.0),
    # PyBullet's light when none is asked for, which is CLIPort's.
    light=Light((-50.0, 30.0, 100.0), ambient=0.6, diffuse=0.35, specular=0.05),
    round_bowls=True,
    oversampling=2,
    crowded=True,
)
"""CLIPort's scene in the paper's view: the whole arm, a wide table, grays."""

SCENES: dict[str, Setup] = {"simple": SIMPLE, "cliport": CLIPORT, "varied": replace(CLIPORT, factors=Factors())}
"""Name of a scene -> what it is. "varied" is "cliport" with all factors on."""


def make_setup(
    scene: str,
    camera: str | None = None,
    sizes: str | None = None,
    factors: Factors | None = None,
    object_scale: float = 1.0,
) -> Setup:
    """The setup of a scene's name with some of it replaced; see `TabletopEnv` for the arguments.

    Raises:
        ValueError: for an unknown name, or factors that the scene cannot have.
    """
    check_choice("scene", scene, SCENES)
    setup = SCENES[scene]
    if camera is not None:
        check_choice("camera", camera, PRESETS)
        setup = replace(setup, camera=PRESETS[camera])
    if sizes is not None:
        check_choice("sizes", sizes, SIZES)
        setup = replace(setup, sizes=SIZES[sizes])
    if not isinstance(factors, Factors | None):
        raise ValueError(f"factors are Factors or a mapping of values, not {factors!r}")
    if factors is not None and not setup.crowded and any(getattr(factors, name) for name in SHARES):
        raise ValueError(f"the scene {scene!r} has no {', '.join(SHARES)}: set these factors to 0")
    check_range("object_scale", object_scale, 0.5, 1.0)
    return replace(setup, sizes=setup.sizes.scaled(object_scale), factors=factors or setup.factors)
