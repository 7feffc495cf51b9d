"""CATER's table in PyBullet: a clip's things as bodies without physics, drawn frame by frame."""

from functools import lru_cache
from itertools import product
from math import cos, pi, sin

import numpy as np
import pybullet as p
import scipy  # its parts are loaded when they are first used
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter

from ..physics.camera import Camera, CameraPreset
from ..physics.shapes import Mesh, lathed
from ..physics.simulation import Bullet
from ..scenes import Light
from .scenes import EYE, FRAMES, Clip, Thing

CAMERA = CameraPreset(eye=EYE, target=(0.0, 0.0, 0.2), fov=42.0, near=5.0, far=40.0)
OVERSAMPLING = 2  # pixels of a frame average so many drawn ones along each axis
FLOOR = 165.0  # gray of the floor, 0..255
LIGHT = (3.0, -1.0, 6.0)  # from where it comes; jittered by up to 1 in each direction
AMBIENT, DIFFUSE = 0.55, 0.45
SHINE = {"rubber": 0.1, "metal": 2.0}  # how much light is reflected as by a mirror
VIGNETTE = 0.2  # how much darker a corner of the floor is
SHADE, SOFT = 0.3, 0.012  # how much darker a shadow is, and how wide its border, in sides of the frame
SEGMENTS = 20  # corners of a circle
OUTLINE = 12  # and of one that throws a shadow


class Table:
    """One PyBullet client with the floor, and the things of one clip after the other."""

    def __init__(self, image_size: int) -> None:
        self.camera = Camera(CAMERA, image_size, OVERSAMPLING)
        self.bullet = Bullet(p.connect(p.DIRECT))
        self.clip: Clip | None = None
        self.bodies: list[int] = []

    def build(self, clip: Clip, jitter: NDArray[np.float64]) -> None:
        """Put the things of a clip in place of those that are there; `jitter` (3,) is added to the light's place."""
        for body in self.bodies:
            self.bullet.removeBody(body)
        self.clip, self.bodies = clip, [self._add(thing) for thing in clip.things]
        self.light = np.array(LIGHT) + jitter

    def film(self, clip: Clip, jitter: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """All frames of a clip (T, H, W, 3), and their labels (T, H, W); see `build` and `render`."""
        self.build(clip, jitter)
        frames, labels = zip(*map(self.render, range(FRAMES)), strict=True)
        return np.stack(frames), np.stack(labels)

    def render(self, frame: float) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The clip at a frame (H, W, 3), and its labels (H, W): 0 the floor, 1 + i thing i."""
        assert self.clip is not None
        centers, turns = self.clip.poses(frame)
        for body, center, turn in zip(self.bodies, centers, turns, strict=True):
            self.bullet.resetBasePositionAndOrientation(body, center.tolist(), turn.tolist())
        n, many = self.camera.size, OVERSAMPLING
        # PyBullet's renderer knows one shine for all, so there is a picture for each material.
        materials = sorted({thing.material for thing in self.clip.things})
        things, bodies = self._draw(materials[0])
        if len(materials) > 1:
            other, _ = self._draw(materials[1])
            of_other = np.zeros(max(self.bodies) + 2, bool)
            of_other[np.array(self.bodies) + 1] = [t.material == materials[1] for t in self.clip.things]
            things = np.where(of_other[bodies + 1][..., None], other, things)
        floor = self._floor(centers, turns)
        drawn = np.where(bodies[..., None] < 0, floor[..., None], things)
        image = drawn.reshape(n, many, n, many, 3).mean((1, 3), dtype=np.float32)
        labels = np.zeros(max(self.bodies) + 2, np.uint8)
        labels[np.array(self.bodies) + 1] = np.arange(1, len(self.bodies) + 1)
        # Of an even number of drawn pixels one has the corner that TinyRenderer samples in the middle.
        seen = labels[bodies[(many - 1) // 2 :: many, many // 2 :: many] + 1]
        return (image + 0.5).astype(np.uint8), seen

    def _draw(self, material: str) -> tuple[NDArray[np.uint8], NDArray[np.integer]]:
        """All things as if they were of this material (S, S, 3), and the bodies (S, S) that the pixels show, or -1."""
        light = Light(self.light.tolist(), AMBIENT, DIFFUSE, SHINE[material])
        rgba, _, bodies = self.bullet.draw(self.camera.size * OVERSAMPLING, self.camera, light)
        return rgba[..., :3], bodies

    def _floor(self, centers: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float32]:
        """The floor (S, S) with the things' shadows, each the outline of what it hides from the light."""
        # PyBullet's renderer throws shadows of its own, hard ones, at four times the cost of a frame.
        assert self.clip is not None
        size = self.camera.size * OVERSAMPLING
        picture = Image.new("L", (size, size))
        draw = ImageDraw.Draw(picture)
        drawn = Camera(CAMERA, size)
        for thing, center, turn in zip(self.clip.things, centers, turns, strict=True):
            points = _rotated(thing.radius * _outline(thing.shape), turn) + center
            points = points - np.maximum(points[:, 2:], 0) * (self.light / self.light[2])
            shadow = drawn.project(points)
            draw.polygon(shadow[scipy.spatial.ConvexHull(shadow).vertices].ravel().tolist(), fill=255)
        soft = np.asarray(picture.filter(ImageFilter.GaussianBlur(SOFT * size)), np.float32) / 255
        floor: NDArray[np.float32] = _empty_floor(size) * (1 - np.float32(SHADE) * soft)
        return floor

    def close(self) -> None:
        """Disconnect."""
        p.disconnect(self.bullet.client)

    def _add(self, thing: Thing) -> int:
        r = thing.radius
        look = {"rgbaColor": [*(value / 255 for value in thing.rgb), 1.0]}
        if thing.shape == "cube":
            half = [r / 2**0.5] * 3
            shape = self.bullet.createVisualShape(p.GEOM_BOX, halfExtents=half, **look)
        else:
            mesh = MESHES[thing.shape]
            scaled = [[r * value for value in vertex] for vertex in mesh.vertices]
            shape = self.bullet.createVisualShape(
                p.GEOM_MESH, vertices=scaled, normals=mesh.normals, indices=mesh.indices, **look
            )
        return int(self.bullet.createMultiBody(0, -1, shape, [0, 0, -10]))


@lru_cache(maxsize=4)
def _empty_floor(size: int) -> NDArray[np.float32]:
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    return (FLOOR * (1 - VIGNETTE / 2 * (axis[:, None] ** 2 + axis**2))).astype(np.float32)


@lru_cache(maxsize=8)
def _outline(shape: str) -> NDArray[np.float64]:
    """Points (N, 3) whose convex hull is a thing of radius 1."""
    if shape == "cube":
        return np.array([*product((-1.0, 1.0), repeat=3)]) / 2**0.5
    ring = np.exp(2j * pi * np.arange(OUTLINE) / OUTLINE)
    circle = np.stack([ring.real, ring.imag, 0 * ring.real], 1)
    if shape == "cone":
        return np.array([*(circle - (0, 0, 1)), (0, 0, 1)])
    if shape == "cylinder":
        return np.concatenate([circle * 0.9 - (0, 0, 1), circle * 0.9 + (0, 0, 1)])
    return np.concatenate(
        [circle * r + (0, 0, z) for r, z in ((0.5, -0.87), (0.87, -0.5), (1, 0), (0.87, 0.5), (0.5, 0.87))]
    )


def _rotated(points: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 3) turned by a quaternion x y z w."""
    # Not with `np.cross`, which takes longer than drawing.
    rotated: NDArray[np.float64] = points @ np.reshape(p.getMatrixFromQuaternion(turn.tolist()), (3, 3)).T
    return rotated


def _snitch() -> Mesh:
    """Three tori around one centre, each across the other two."""
    ring, tube, around, across = 0.75, 0.25, 16, 8
    vertices: list[list[float]] = []
    normals: list[list[float]] = []
    indices: list[int] = []
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        first = len(vertices)
        for i in range(around):
            for j in range(across):
                a, b = 2 * pi * i / around, 2 * pi * j / across
                normal = (cos(a) * cos(b), sin(a) * cos(b), sin(b))
                point = (ring * cos(a), ring * sin(a), 0.0)
                vertices.append([point[k] + tube * normal[k] for k in axes])
                normals.append([normal[k] for k in axes])
                here, right = first + i * across, first + (i + 1) % around * across
                k, up = j, (j + 1) % across
                indices += [here + k, right + k, right + up, here + k, right + up, here + up]
    return Mesh(vertices, normals, indices)


_BALL = [(cos(a), sin(a)) for a in (pi * k / 12 - pi / 2 for k in range(13))]
# Profiles are (radius, height); all meshes have radius 1.
MESHES = {
    "cone": lathed([(0.0, -1.0), (1.0, -1.0), (0.02, 1.0), (0.0, 1.0)], SEGMENTS),
    "cylinder": lathed([(0.0, -1.0), (0.9, -1.0), (0.9, 1.0), (0.0, 1.0)], SEGMENTS),
    "sphere": lathed(_BALL, SEGMENTS, lambda band, k, flat: _BALL[band : band + 2]),
    "snitch": _snitch(),
}
