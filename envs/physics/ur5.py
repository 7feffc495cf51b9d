"""The real shape of a UR5: the light meshes of the package `example-robot-data` (extra `ur5`, BSD licence)."""

from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from math import cos, radians
from pathlib import Path

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from ..geometry import Point
from .shapes import generated_file

PACKAGE = "example-robot-data"
FOLDER = "cmeel.prefix/share/example-robot-data/robots/ur_description/meshes/ur5/collision"

CREASE = radians(40.0)  # faces that meet at a larger angle keep an edge; others are shaded as one round surface

_BACK = np.diag([-1.0, -1.0, 1.0])
_ALONG = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
_DOWN = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Link of our arm -> mesh, its turn and its shift (metres) from the mesh's frame to the link's.
_MESHES: dict[str, tuple[str, NDArray[np.float64], Point]] = {
    "base": ("base", _BACK, (0, 0, 0)),
    "shoulder": ("shoulder", np.eye(3), (0, 0, 0)),
    "upper_arm": ("upperarm", _ALONG, (0, 0, 0)),
    "forearm": ("forearm", _ALONG, (0, 0, 0)),
    "wrist1": ("wrist1", _ALONG, (0, -0.093, 0)),
    "wrist2": ("wrist2", _DOWN, (0, 0, 0)),
    "gripper": ("wrist3", _DOWN, (0, 0, 0)),
}


def find_package() -> Distribution | None:
    """The installed package, if there is one."""
    try:
        return distribution(PACKAGE)
    except PackageNotFoundError:
        return None


def missing() -> str:
    """What to say where there is no package."""
    return (
        f"the package {PACKAGE} is not installed, so the arm is drawn with cylinders instead of the UR5's own shape; "
        "pip install 'textocvp[ur5]' gets it"
    )


def ur5_meshes() -> dict[str, str]:
    """Link of our arm -> OBJ file in that link's frame; empty, with a warning, when the package is missing."""
    if not all(Path(path).exists() for path in _write_meshes().values()):
        _write_meshes.cache_clear()  # the temporary folder was swept
    return _write_meshes()


@cache
def _write_meshes() -> dict[str, str]:
    """Convert the package's meshes.

    PyBullet draws the STL files black, because they carry no normals; these files do.
    """
    package = find_package()
    if package is None:
        logger.warn(missing())
        return {}
    folder, paths = Path(str(package.locate_file(FOLDER))), {}
    for link, (name, turn, shift) in _MESHES.items():
        corners = _read_stl(folder / f"{name}.stl") @ turn.T + shift
        paths[link] = generated_file(f"ur5-{name}", ".obj", _obj(corners, _smooth_normals(corners)))
    return paths


def _read_stl(path: Path) -> NDArray[np.float64]:
    """Corners (F, 3, 3) in metres of the triangles of a binary STL file, without empty ones."""
    triangle = np.dtype([("normal", "<3f4"), ("corners", "<9f4"), ("attribute", "<u2")])
    corners = np.frombuffer(path.read_bytes(), triangle, offset=84)["corners"].reshape(-1, 3, 3)
    corners = corners.astype(np.float64)
    return corners[np.linalg.norm(_face_normals(corners), axis=1) > 1e-12]


def _face_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Outward normals (F, 3), as long as twice the face's area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _smooth_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normals (F, 3, 3) of all corners: means over the faces that meet there without an edge."""
    faces = _face_normals(corners)
    units = faces / np.linalg.norm(faces, axis=1, keepdims=True)
    points = corners.reshape(-1, 3).round(5)
    order = np.lexsort(points.T)
    starts = np.flatnonzero(np.any(np.diff(points[order], axis=0) != 0, axis=1)) + 1
    normals = np.empty((len(points), 3))
    for group in np.split(order, starts):
        meeting = group // 3
        smooth = units[meeting] @ units[meeting].T > cos(CREASE)
        normals[group] = smooth @ faces[meeting]
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).reshape(corners.shape)


def _obj(corners: NDArray[np.float64], normals: NDArray[np.float64]) -> str:
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in corners.reshape(-1, 3)]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals.reshape(-1, 3)]
    lines += [f"f {k}//{k} {k + 1}//{k + 1} {k + 2}//{k + 2}" for k in range(1, 3 * len(corners), 3)]
    return "\n".join(lines) + "\n"
