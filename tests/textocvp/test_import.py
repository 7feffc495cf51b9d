"""Importing the package is quick: what takes seconds is imported where it is needed."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("module", ["textocvp", "textocvp.cli", "textocvp.world_model", "planning"])
def test_heavy_libraries_wait_until_they_are_needed(module: str) -> None:
    heavy = (
        "transformers",
        "torchmetrics",
        "accelerate",
        "lpips",
        "tensorboard",
        "matplotlib.pyplot",
        "scipy.optimize",
    )
    code = f"import sys, {module}; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_loading_a_model_imports_no_compiler() -> None:
    code = "import sys, textocvp; textocvp.WorldModel.from_pretrained(); print('torch._dynamo' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_names_of_old_still_lead_there() -> None:
    from textocvp import config, data, episodes, presets

    assert episodes.EpisodeFile is data.episodes.EpisodeFile
    assert config.preset("cater") is presets.preset("cater")
    with pytest.raises(AttributeError, match="no attribute 'presets'"):
        _ = config.presets
