"""Which code and which weights a figure came from."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from experiments.reporting.results import Checkpoint

PACKAGES = ("textocvp", "torch", "numpy", "pybullet", "gymnasium")


def package_versions(packages: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Versions of Python and of the packages that figures depend on; `not installed` where there is none."""
    versions = {"python": platform.python_version()}
    for name in packages:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def checkpoint_record(name: str, weights: str | Path) -> Checkpoint:
    """The name and the SHA-256 of a weights file, read in blocks."""
    digest = hashlib.sha256()
    with open(weights, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return Checkpoint(name=name, sha256=digest.hexdigest())
