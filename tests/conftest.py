"""Without PyBullet, which the newest Pythons lack, the tests that import the environments are left out."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

NEEDS_PYBULLET = re.compile(r"^(from|import) (envs|experiments|pybullet)\b|^README = ", re.MULTILINE)

if find_spec("pybullet") is None:
    tests = Path(__file__).parent
    collect_ignore = ["envs", "experiments"]
    collect_ignore += [
        str(file) for file in tests.rglob("test_*.py") if NEEDS_PYBULLET.search(file.read_text("utf-8"))
    ]
