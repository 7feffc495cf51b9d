"""Generated shapes: the lathed bowl, for the eye and for contact. No asset package is needed."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import cos, hypot, pi, sin
from pathlib import Path

from ..geometry import Sizes

SEGMENTS = 24  # corners of the bowl's circle as seen
ARC = 5  # bands of a round wall
STAR = ((0.0, 1.0), (-1.0, 0.0), (-1.0, 0.0))  # normals (outward, upward) around a round bowl's floor
WALL_PARTS = 12  # convex parts of the bowl's wall as felt; a block's edge never meets their corners

Profile = list[tuple[float, float]]  # radius and height
Shade = Callable[[int, int, tuple[float, float]], Profile]


@dataclass(frozen=True)
class Mesh:
    """Triangles as PyBullet takes them. Python lists, because numpy arrays are 20 times slower there."""

    vertices: list[list[float]]
    normals: list[list[float]]
    indices: list[int]


def lathed(profile: Profile, segments: int, shade: Shade | None = None) -> Mesh:
    """A profile, its solid on the left, turned around the z axis: smooth around, with an edge between bands.

    Args:
        segments: corners of the circle.
        shade: the normals (outward, upward) at both ends of band number i at corner number k, from the band's own.
    """
    vertices: list[list[float]] = []
    normals: list[list[float]] = []
    indices: list[int] = []
    for band, ((r0, z0), (r1, z1)) in enumerate(pairwise(profile)):
        length = hypot(r1 - r0, z1 - z0)
        # The profile runs with the solid on its left, so the outward normal is its direction turned right.
        flat = ((z1 - z0) / length, -(r1 - r0) / length)
        first = len(vertices)
        for k in range(segments + 1):
            c, s = cos(2 * pi * k / segments), sin(2 * pi * k / segments)
            vertices += [[r0 * c, r0 * s, z0], [r1 * c, r1 * s, z1]]
            normals += [[r * c, r * s, z] for r, z in (shade(band, k, flat) if shade else [flat] * 2)]
        for k in range(segments):
            a = first + 2 * k
            indices += [a, a + 2, a + 1] if r0 > 0 else []
            indices += [a + 1, a + 2, a + 3] if r1 > 0 else []
    return Mesh(vertices, normals, indices)


@lru_cache(maxsize=16)
def bowl_mesh(sizes: Sizes, rounded: bool = False) -> Mesh:
    """The visible bowl, conical or ``rounded``."""
    if not rounded:
        return lathed(_bowl_profile(sizes), SEGMENTS)

    def shade(band: int, k: int, flat: tuple[float, float]) -> Profile:
        # As CLIPort's bowls look: the inner wall is shaded as if steep, the lowest band as a star.
        if ARC < band < 2 * ARC:
            return [(-1.0, 0.0)] * 2
        return [STAR[k % 3], (0.0, 1.0)] if band == 2 * ARC else [flat] * 2

    return lathed(_round_profile(sizes), SEGMENTS, shade)


def _bowl_profile(sizes: Sizes) -> Profile:
    """(radius, height) from the outer foot over the rim to the centre of the inner floor."""
    return [
        (sizes.bowl_foot_radius, 0.0),
        (sizes.bowl_radius, sizes.bowl_height),
        (sizes.bowl_inner_radius, sizes.bowl_height),
        (sizes.bowl_floor_radius, sizes.bowl_floor),
        (0.0, sizes.bowl_floor),
    ]


def _round_profile(sizes: Sizes) -> Profile:
    """The same for a bowl that is round inside and outside."""
    flat, height = 0.45 * sizes.bowl_radius, sizes.bowl_height

    def arc(rim: float, low: float) -> Profile:
        angles = [pi / 2 * k / ARC for k in range(ARC + 1)]
        return [(flat + (rim - flat) * sin(a), low + (height - low) * (1 - cos(a))) for a in angles]

    outside, inside = arc(sizes.bowl_radius, 0.0), arc(sizes.bowl_inner_radius, sizes.bowl_floor)
    return [*outside, *reversed(inside), (0.0, sizes.bowl_floor)]


def bowl_contact_file(sizes: Sizes) -> str:
    """Path of an OBJ file with one convex group for the bowl's floor and for each segment of its wall."""
    # Only the text is kept: a temporary folder may be swept while the program runs.
    return generated_file("bowl", ".obj", _bowl_parts(sizes))


@lru_cache(maxsize=16)
def _bowl_parts(sizes: Sizes) -> str:
    # A file, because ``createCollisionShapeArray`` silently stops at 16 shapes and a vertex array cannot hold
    # several parts; PyBullet turns each group of an OBJ file into one convex hull.
    lines: list[str] = []
    count = 0

    def add(name: str, points: list[tuple[float, float, float]]) -> None:
        nonlocal count
        lines.append(f"o {name}")
        lines.extend(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points)
        # The hull is taken of the points; the faces only have to mention each of them.
        lines.extend(f"f {count + 1} {count + k} {count + k + 1}" for k in range(2, len(points)))
        count += len(points)

    def ring(radius: float, z: float, first: int, last: int) -> list[tuple[float, float, float]]:
        angles = [2 * pi * k / WALL_PARTS for k in range(first, last)]
        return [(radius * cos(a), radius * sin(a), z) for a in angles]

    foot, floor = sizes.bowl_foot_radius, sizes.bowl_floor
    add("floor", ring(foot, 0.0, 0, WALL_PARTS) + ring(foot, floor, 0, WALL_PARTS))
    # Walls start a little above the table: the bowl stands on its floor alone, which saves contacts.
    start = floor / 2
    outer_start = foot + (sizes.bowl_radius - foot) * start / sizes.bowl_height
    for k in range(WALL_PARTS):
        add(
            f"wall{k}",
            ring(outer_start, start, k, k + 2)
            + ring(sizes.bowl_floor_radius - 0.002, start, k, k + 2)
            + ring(sizes.bowl_radius, sizes.bowl_height, k, k + 2)
            + ring(sizes.bowl_inner_radius, sizes.bowl_height, k, k + 2),
        )
    return "\n".join(lines) + "\n"


def generated_file(stem: str, suffix: str, text: str) -> str:
    """Path of a file with ``text`` in the user's temporary folder; its name carries the content's hash."""
    folder = Path(tempfile.gettempdir()) / f"textocvp-envs-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{stem}-{hashlib.sha256(text.encode()).hexdigest()[:16]}{suffix}"
    if not path.exists() or path.read_text() != text:
        # Renamed when whole, so that processes that start together never read half a file.
        part = path.with_suffix(f".{os.getpid()}.part")
        part.write_text(text)
        part.replace(path)
    return str(path)
