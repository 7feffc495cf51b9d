"""The physical tabletop: a PyBullet world built from a scene, stepped, read out and rendered."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pybullet as p
from gymnasium import logger
from numpy.typing import NDArray

from envs.colors import RGB
from envs.geometry import BLOCK_MASS, BOWL_MASS, TABLE, Box2, Sizes
from envs.physics.arm import Joints, arm_urdf
from envs.physics.camera import Camera
from envs.physics.shapes import bowl_contact_file, bowl_mesh
from envs.scene import Scene
from envs.scenes import Setup

GRAVITY = -9.8
TABLE_THICKNESS = 0.04

LABELS = {"background": 0, "robot": 1}
"""Labels of a segmentation that every scene has: table and floor, and the robot."""

FIRST_OBJECT = 2
"""Object i has the label FIRST_OBJECT + i."""


@dataclass(frozen=True)
class Image:
    """One camera frame of size H = W."""

    rgb: NDArray[np.uint8]
    """(H, W, 3), 0..255."""
    segmentation: NDArray[np.uint8]
    """(H, W): 0 table and floor, 1 arm, 2 + i object i."""
    depth: NDArray[np.float32]
    """(H, W), metres along the optical axis; the camera's far distance where nothing is."""


class Tabletop:
    """One PyBullet client with a table, the arm and the objects of a scene.

    A rebuild after `resetSimulation` is bit-exact, whereas PyBullet's saveState/restoreState is not
    (measured: up to 32 mm off), so `build` is the only way back to a state.
    """

    def __init__(self, setup: Setup, image_size: int, physics_hz: int, gui: bool = False) -> None:
        self.image_size = image_size
        self.physics_hz = physics_hz
        self._use(setup)
        self.client = _connect(gui)
        self.arm = -1
        self.objects: list[int] = []
        self.blocks: set[int] = set()
        self.steps = 0

    def close(self) -> None:
        """Disconnect. Safe to call twice."""
        if self.client >= 0 and p.isConnected(self.client):
            p.disconnect(self.client)
        self.client = -1

    @property
    def sizes(self) -> Sizes:
        """Of the objects that stand here."""
        return self.setup.sizes

    def _use(self, setup: Setup) -> None:
        drawn = self.image_size * setup.oversampling
        self.setup = setup
        self.camera = Camera(setup.camera, self.image_size, setup.oversampling)
        self._view, self._projection = self.camera.view_matrix, self.camera.projection_matrix
        self._background = _empty_table(
            Camera(setup.camera, drawn), setup.table, setup.table_rgb, setup.floor_rgb
        )

    def build(self, setup: Setup, scene: Scene, joints: Joints) -> None:
        """Throw everything away and build ``scene`` with the arm at ``joints`` (radians)."""
        client = self.client
        self._use(setup)
        p.resetSimulation(physicsClientId=client)
        # resetSimulation keeps some parameters and resets others, so all are set each time.
        p.setPhysicsEngineParameter(
            fixedTimeStep=1 / self.physics_hz,
            numSubSteps=0,
            numSolverIterations=50,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        p.setGravity(0, 0, GRAVITY, physicsClientId=client)
        table = self._add_table()
        self.arm = p.loadURDF(arm_urdf(setup.arm), useFixedBase=True, physicsClientId=client)
        for index, rgb in enumerate(setup.arm.paint.links if setup.arm.paint else ()):
            link = index if index < p.getNumJoints(self.arm, physicsClientId=client) else -1
            rgba = [value / 255 for value in rgb] + [1.0]
            p.changeVisualShape(self.arm, link, rgbaColor=rgba, physicsClientId=client)
        for index, angle in enumerate(joints):
            p.resetJointState(self.arm, index, angle, physicsClientId=client)
        self._add_objects(scene)
        self.steps = 0
        self._label = np.zeros(2 + max([table, self.arm, *self.objects]), dtype=np.uint8)
        self._label[self.arm + 1] = LABELS["robot"]
        for index, body in enumerate(self.objects):
            self._label[body + 1] = FIRST_OBJECT + index

    def step(self) -> None:
        """One physics step."""
        p.stepSimulation(physicsClientId=self.client)
        self.steps += 1

    def settle(self, max_steps: int) -> None:
        """Step until all objects rest, but at most ``max_steps`` steps; never a matter of wall-clock time."""
        for _ in range(max_steps):
            self.step()
            if all(self.speed(index) < 0.01 for index in range(len(self.objects))):
                return

    def pose(self, index: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Position (3, metres, centre of a block, foot of a bowl) and orientation (quaternion x y z w) of an
        object."""
        return p.getBasePositionAndOrientation(self.objects[index], physicsClientId=self.client)

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (n, 3) and orientations (n, 4) of all objects."""
        both = [self.pose(index) for index in range(len(self.objects))]
        return np.array([pose[0] for pose in both]), np.array([pose[1] for pose in both])

    def speed(self, index: int) -> float:
        """Linear speed of an object plus its turning speed times a block's size, in m/s."""
        linear, angular = p.getBaseVelocity(self.objects[index], physicsClientId=self.client)
        return max(map(abs, linear)) + self.sizes.block * max(map(abs, angular))

    def render(self) -> Image:
        """What the camera sees now."""
        light, many = self.setup.light, self.setup.oversampling
        size = self.image_size * many
        _, _, rgba, depth, bodies = p.getCameraImage(
            size,
            size,
            self._view,
            self._projection,
            lightDirection=light.direction,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=light.specular,
            shadow=0,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        bodies = np.asarray(bodies).reshape(size, size)
        depth = np.asarray(depth, dtype=np.float32).reshape(size, size)
        # Four channels as one number: ten times as fast as a choice by channels.
        drawn = np.asarray(rgba, dtype=np.uint8).reshape(size, size, 4).view(np.uint32)[..., 0]
        drawn = np.where(bodies == -1, self._background.rgb.view(np.uint32)[..., 0], drawn)
        colors = drawn.view(np.uint8).reshape(size, size, 4)
        rows = np.array([colors[i::many] for i in range(many)]).sum(axis=0, dtype=np.uint16)
        total = np.array([rows[:, i::many, :3] for i in range(many)]).sum(axis=0, dtype=np.uint16)
        center = np.s_[(many - 1) // 2 :: many, many // 2 :: many]
        bodies, depth = bodies[center], depth[center]
        metres = np.where(bodies == -1, self._background.depth[center], self.camera.depth_in_metres(depth))
        rgb = ((total + many * many // 2) // (many * many)).astype(np.uint8)
        return Image(rgb, self._label[bodies + 1], metres)

    def _add_table(self) -> int:
        half = [(TABLE.x[1] - TABLE.x[0]) / 2, (TABLE.y[1] - TABLE.y[0]) / 2, TABLE_THICKNESS / 2]
        center = [sum(TABLE.x) / 2, sum(TABLE.y) / 2, -TABLE_THICKNESS / 2]
        touch = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=self.client)
        # Without a visual shape PyBullet would draw the contact shape, so the table's look is a speck that it
        # hides itself in; `_empty_table` paints what is really seen.
        look = p.createVisualShape(p.GEOM_BOX, halfExtents=[1e-4] * 3, physicsClientId=self.client)
        return p.createMultiBody(0, touch, look, center, physicsClientId=self.client)

    def _add_objects(self, scene: Scene) -> None:
        client, sizes = self.client, self.sizes
        half = [sizes.block / 2] * 3
        mesh = bowl_mesh(sizes, self.setup.round_bowls)
        # One contact shape serves all bowls, and one all blocks; only looks differ.
        bowl_touch = p.createCollisionShape(
            p.GEOM_MESH, fileName=bowl_contact_file(sizes), physicsClientId=client
        )
        block_touch = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
        self.objects = []
        for index, item in enumerate(scene.objects):
            rgba = [value / 255 for value in self.setup.object_rgb(index, item.color)] + [1.0]
            floor = sizes.bowl_floor if item.inside is not None else 0.0
            floor += sizes.block if item.on is not None else 0.0
            if item.kind == "block":
                look = p.createVisualShape(
                    p.GEOM_BOX, halfExtents=half, rgbaColor=rgba, physicsClientId=client
                )
                touch, mass = block_touch, BLOCK_MASS
                z = floor + sizes.block / 2 if item.height is None else item.height
            else:
                look = p.createVisualShape(
                    p.GEOM_MESH,
                    vertices=mesh.vertices,
                    normals=mesh.normals,
                    indices=mesh.indices,
                    rgbaColor=rgba,
                    physicsClientId=client,
                )
                touch, mass, z = bowl_touch, BOWL_MASS, 0.0
            turn = p.getQuaternionFromEuler([0.0, 0.0, item.yaw])
            body = p.createMultiBody(mass, touch, look, [item.x, item.y, z], turn, physicsClientId=client)
            p.changeDynamics(body, -1, lateralFriction=1.0, physicsClientId=client)
            self.objects.append(body)
        self.blocks = {
            body for body, item in zip(self.objects, scene.objects, strict=True) if item.kind == "block"
        }


@lru_cache(maxsize=4)
def _empty_table(camera: Camera, table: Box2, table_rgb: RGB, floor_rgb: RGB) -> Image:
    """Table and floor without anything on them, as the camera sees them; its colours have a fourth channel.

    They never change, and drawing a surface that fills the view is most of a frame's cost at 336x336.
    """
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


def _connect(gui: bool) -> int:
    # PyBullet ends the whole process when it finds no display, so look before asking.
    if gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        logger.warn("render_mode='human' needs a display and DISPLAY is not set: running without a window")
        gui = False
    client = p.connect(p.GUI if gui else p.DIRECT)
    if client < 0:
        raise RuntimeError(
            "PyBullet could not start" + (" its window; use render_mode='rgb_array'" if gui else "")
        )
    return client
