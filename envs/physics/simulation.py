"""The physical tabletop: a PyBullet world built from a scene, stepped, read out and rendered."""

import os
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import Any, NoReturn

import numpy as np
import pybullet as p
from gymnasium import logger
from gymnasium.error import ClosedEnvironmentError
from numpy.typing import NDArray

from ..colors import RGB
from ..geometry import BLOCK_MASS, BOWL_MASS, TABLE, Box2, Sizes
from ..scene import ObjectSpec, Scene
from ..scenes import Light, Setup
from .arm import Joints, arm_urdf
from .camera import Camera
from .shapes import bowl_contact_file, bowl_mesh

GRAVITY = -9.8
TABLE_THICKNESS = 0.04

# Labels of a segmentation that every scene has: table and floor, and the robot.
LABELS = {"background": 0, "robot": 1}

FIRST_OBJECT = 2  # object i has the label FIRST_OBJECT + i

DISPLAY_SECONDS = 20  # for a window to open, which takes 1 or 2


@dataclass(frozen=True)
class Image:
    """One camera frame of size H = W."""

    rgb: NDArray[np.uint8]  # (H, W, 3), 0..255
    segmentation: NDArray[np.uint8]  # (H, W): 0 table and floor, 1 arm, 2 + i object i
    depth: NDArray[np.float32]  # (H, W), metres along the optical axis; the camera's `far` where nothing is


@dataclass
class Bullet:
    """PyBullet's functions, bound to one of its clients; ClosedEnvironmentError when it is gone."""

    client: int

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if self.client < 0:
            raise ClosedEnvironmentError("the environment was closed; make a new one")
        return partial(getattr(p, name), physicsClientId=self.client)

    def draw(
        self, size: int, camera: Camera, light: Light
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.integer]]:
        """What a camera sees: colours (S, S, 4), OpenGL's depth buffer (S, S), and bodies (S, S), -1 where none is."""
        _, _, rgba, depth, bodies = self.getCameraImage(
            size,
            size,
            camera.view_matrix,
            camera.projection_matrix,
            lightDirection=light.direction,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=light.specular,
            shadow=0,
            renderer=p.ER_TINY_RENDERER,
        )
        colors = np.asarray(rgba, dtype=np.uint8).reshape(size, size, 4)
        return colors, np.asarray(depth, np.float32).reshape(size, size), np.asarray(bodies).reshape(size, size)


class Tabletop:
    """One PyBullet client with a table, the arm and the objects of a scene."""

    # A rebuild after `resetSimulation` is bit-exact, whereas PyBullet's saveState/restoreState is not (measured:
    # up to 32 mm off), so `build` is the only way back to a state.

    def __init__(self, setup: Setup, image_size: int, physics_hz: int, gui: bool = False) -> None:
        self.image_size, self.physics_hz = image_size, physics_hz
        self._use(setup)
        self.bullet = _connect(gui)
        # A world that is dropped without `close` would stay in PyBullet: 28 MB each.
        self._disconnect = weakref.finalize(self, _disconnect, self.bullet.client)
        self.table = self.arm = -1
        self.objects: list[int] = []
        self.steps = 0

    def close(self) -> None:
        """Disconnect. Safe to call twice."""
        self._disconnect()  # does nothing the second time
        self.bullet.client = -1  # PyBullet gives numbers away again

    def check_open(self) -> None:
        """Raise ClosedEnvironmentError after `close`."""
        self.bullet.isConnected()

    def __getstate__(self) -> NoReturn:
        raise TypeError("a simulator cannot be copied; copy the environment, which builds its own")

    @property
    def sizes(self) -> Sizes:
        """Of the objects that stand here."""
        return self.setup.sizes

    def _use(self, setup: Setup) -> None:
        self.setup = setup
        self.camera = Camera(setup.camera, self.image_size, setup.oversampling)
        self._background = self._empty(self.image_size)

    def _empty(self, image_size: int) -> Image:
        setup = self.setup
        drawn = Camera(setup.camera, image_size * setup.oversampling)
        return _empty_table(drawn, setup.table, setup.table_rgb, setup.floor_rgb)

    def build(self, setup: Setup, scene: Scene, joints: Joints) -> None:
        """Throw everything away and build ``scene`` with the arm at ``joints`` (radians)."""
        bullet = self.bullet
        self._use(setup)
        bullet.resetSimulation()
        # resetSimulation keeps some parameters and resets others, so all are set each time.
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / self.physics_hz, numSubSteps=0, numSolverIterations=50, deterministicOverlappingPairs=1
        )
        bullet.setGravity(0, 0, GRAVITY)
        self.table = self._add_table()
        self.arm = bullet.loadURDF(arm_urdf(setup.arm), useFixedBase=True)
        for link, rgb in (setup.arm.paint.links if setup.arm.paint else {}).items():
            bullet.changeVisualShape(self.arm, link, rgbaColor=_rgba(rgb))
        for index, angle in enumerate(joints):
            bullet.resetJointState(self.arm, index, angle)
        self._add_objects(scene)
        self.steps = 0
        self._label = np.zeros(2 + max([self.table, self.arm, *self.objects]), dtype=np.uint8)
        self._label[self.arm + 1] = LABELS["robot"]
        for index, body in enumerate(self.objects):
            self._label[body + 1] = FIRST_OBJECT + index

    def step(self) -> None:
        """One physics step."""
        self.bullet.stepSimulation()
        self.steps += 1

    def settle(self, max_steps: int) -> None:
        """Step until all objects rest, but at most ``max_steps`` steps; never a matter of wall-clock time."""
        for _ in range(max_steps):
            self.step()
            if all(self.speed(index) < 0.01 for index in range(len(self.objects))):
                return

    def pose(self, index: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """An object's position (3, metres; centre of a block, foot of a bowl) and quaternion x y z w."""
        return self.bullet.getBasePositionAndOrientation(self.objects[index])

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (n, 3) and orientations (n, 4) of all objects."""
        both = [self.pose(index) for index in range(len(self.objects))]
        return np.array([pose[0] for pose in both]), np.array([pose[1] for pose in both])

    def speed(self, index: int) -> float:
        """Linear speed of an object plus its turning speed times a block's size, in m/s."""
        linear, angular = self.bullet.getBaseVelocity(self.objects[index])
        return max(map(abs, linear)) + self.sizes.block * max(map(abs, angular))

    def render(self, image_size: int | None = None) -> Image:
        """What the camera sees now, in pictures of ``image_size`` pixels or the usual ones."""
        many = self.setup.oversampling
        size = (image_size or self.image_size) * many
        background = self._background if image_size is None else self._empty(image_size)
        rgba, depth, bodies = self.bullet.draw(size, self.camera, self.setup.light)
        # Four channels as one number: ten times as fast as a choice by channels.
        drawn = np.where(bodies == -1, background.rgb.view(np.uint32)[..., 0], rgba.view(np.uint32)[..., 0])
        colors = drawn.view(np.uint8).reshape(size, size, 4)
        rows = np.array([colors[i::many] for i in range(many)]).sum(axis=0, dtype=np.uint16)
        total = np.array([rows[:, i::many, :3] for i in range(many)]).sum(axis=0, dtype=np.uint16)
        center = np.s_[(many - 1) // 2 :: many, many // 2 :: many]
        bodies, depth = bodies[center], depth[center]
        metres = np.where(bodies == -1, background.depth[center], self.camera.depth_in_metres(depth))
        rgb = ((total + many * many // 2) // (many * many)).astype(np.uint8)
        return Image(rgb, self._label[bodies + 1], metres)

    def _add_table(self) -> int:
        half = [(TABLE.x[1] - TABLE.x[0]) / 2, (TABLE.y[1] - TABLE.y[0]) / 2, TABLE_THICKNESS / 2]
        center = [sum(TABLE.x) / 2, sum(TABLE.y) / 2, -TABLE_THICKNESS / 2]
        touch = self.bullet.createCollisionShape(p.GEOM_BOX, halfExtents=half)
        # Without a visual shape PyBullet would draw the contact shape, so the table's look is a speck that it
        # hides itself in; `_empty_table` paints what is really seen.
        look = self.bullet.createVisualShape(p.GEOM_BOX, halfExtents=[1e-4] * 3)
        return self.bullet.createMultiBody(0, touch, look, center)

    def _add_objects(self, scene: Scene) -> None:
        bullet, sizes = self.bullet, self.sizes
        looks: dict[str, dict[str, Any]] = {
            "block": {"halfExtents": [sizes.block / 2] * 3},
            "bowl": vars(bowl_mesh(sizes, self.setup.round_bowls)),
        }
        # One contact shape serves all bowls, and one all blocks; only looks differ.
        touches = {
            "bowl": bullet.createCollisionShape(p.GEOM_MESH, fileName=bowl_contact_file(sizes)),
            "block": bullet.createCollisionShape(p.GEOM_BOX, **looks["block"]),
        }
        self.objects = []
        for index, item in enumerate(scene.objects):
            rgba = _rgba(self.setup.object_rgb(index, item.color))
            shape, mass, z = p.GEOM_MESH, BOWL_MASS, 0.0
            if item.kind == "block":
                z = _floor(scene.objects, item, sizes) + sizes.block / 2 if item.height is None else item.height
                shape, mass = p.GEOM_BOX, BLOCK_MASS
            look = bullet.createVisualShape(shape, rgbaColor=rgba, **looks[item.kind])
            turn = p.getQuaternionFromEuler([0.0, 0.0, item.yaw])
            body = bullet.createMultiBody(mass, touches[item.kind], look, [item.x, item.y, z], turn)
            bullet.changeDynamics(body, -1, lateralFriction=1.0)
            self.objects.append(body)
        bodies = zip(self.objects, scene.objects, strict=True)
        self.blocks = {body for body, item in bodies if item.kind == "block"}


def _floor(objects: Sequence[ObjectSpec], item: ObjectSpec, sizes: Sizes) -> float:
    """Height of what a block stands on, in metres."""
    if item.on is not None:
        return _floor(objects, objects[item.on], sizes) + sizes.block
    return sizes.bowl_floor if item.inside is not None else 0.0


def _rgba(rgb: RGB) -> list[float]:
    return [value / 255 for value in rgb] + [1.0]


@lru_cache(maxsize=4)
def _empty_table(camera: Camera, table: Box2, table_rgb: RGB, floor_rgb: RGB) -> Image:
    """Table and floor without anything on them, as the camera sees them; colours have a fourth channel."""
    # Drawing a surface that fills the view is most of a frame's cost at 336x336.
    size = camera.size
    v, u = np.mgrid[:size, :size] + 0.5
    rays = np.linalg.inv(camera.intrinsics) @ np.stack([u.ravel(), v.ravel(), np.ones(size * size)])
    turn, shift = camera.extrinsics[:3, :3], camera.extrinsics[:3, 3]
    eye, rays = -turn.T @ shift, turn.T @ rays
    # The rays' parts along the optical axis are 1, so the factor that takes one to z = 0 is the depth.
    depth = -eye[2] / np.minimum(rays[2], -1e-9)
    x, y = eye[:2, None] + depth * rays[:2]
    on_table = (table.x[0] <= x) & (x <= table.x[1]) & (table.y[0] <= y) & (y <= table.y[1])
    rgba = np.where(on_table[:, None], (*table_rgb, 0), (*floor_rgb, 0)).astype(np.uint8)
    depth = np.where(on_table, depth, camera.preset.far).astype(np.float32)
    nothing = np.full((size, size), LABELS["background"], dtype=np.uint8)
    return Image(rgba.reshape(size, size, 4), nothing, depth.reshape(size, size))


def _connect(gui: bool) -> Bullet:
    # PyBullet ends the whole process when it finds no display, so look before asking.
    if gui and sys.platform.startswith("linux"):
        display = os.environ.get("DISPLAY")
        if not display or not _opens_windows(display):
            state = f"{display!r} shows no window" if display else "is not set"
            logger.warn(f"render_mode='human' needs a display and DISPLAY {state}: running without a window")
            gui = False
    client = p.connect(p.GUI if gui else p.DIRECT)
    if client < 0:
        hint = " its window; use render_mode='rgb_array'" if gui else ""
        raise RuntimeError(f"PyBullet could not start{hint}")
    return Bullet(client)


@cache
def _opens_windows(display: str) -> bool:
    """Whether PyBullet can open a window there, tried in a process that it may end."""
    code = "import pybullet; raise SystemExit(pybullet.connect(pybullet.GUI) < 0)"
    command, there = [sys.executable, "-c", code], {**os.environ, "DISPLAY": display}
    try:
        tried = subprocess.run(command, env=there, capture_output=True, timeout=DISPLAY_SECONDS)
    except subprocess.TimeoutExpired:
        return False
    return tried.returncode == 0


def _disconnect(client: int) -> None:
    if p.isConnected(client):
        p.disconnect(client)
