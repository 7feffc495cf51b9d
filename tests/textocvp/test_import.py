"""Importing the package is quick: what takes seconds is imported where it is needed."""

from __future__ import annotations

import subprocess
import sys


def test_heavy_libraries_wait_until_they_are_needed() -> None:
    heavy = ("transformers", "torchmetrics", "accelerate", "lpips", "tensorboard", "matplotlib.pyplot")
    code = f"import sys, textocvp; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
