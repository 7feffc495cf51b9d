"""Toy episodes and tiny checkpoints to train from."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.textocvp.conftest import PLACED, PUBLISHED
from tests.textocvp.training import both_stages
from textocvp.presets import PRESETS
from textocvp.training import run as training


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    both_stages.write_inputs(folder)
    return folder


@pytest.fixture
def folder(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Toy episodes and a checkpoint of each family; the tiny presets are known by name, every loss is logged."""
    shutil.copytree(inputs, tmp_path, dirs_exist_ok=True)
    for config in (PLACED, PUBLISHED):
        monkeypatch.setitem(PRESETS, config.name, config)
    monkeypatch.setattr(training, "LOG_EVERY", 1)
    return tmp_path
