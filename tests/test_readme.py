"""The README keeps its word: every snippet runs, in order, in an empty folder that looks like a fresh clone.

A block that would take too long has comments above it, `<!-- instead: COMMANDS -->` with quick equivalents
and `<!-- because: REASON -->`. Blocks marked `<!-- ci: NAME -->` are the commands that `.ci/run` itself runs.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest

from textocvp.world_model import DEFAULT_CHECKPOINT, bundled_checkpoints

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"((?:<!--.*?-->\n)*)```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Snippet:
    """A fenced block: its language, what it says, and what is to be run."""

    language: str
    text: str
    run: str
    ci: str | None
    because: str | None


def snippets() -> Iterator[Snippet]:
    for comments, language, text in BLOCK.findall(README):
        notes = {name: value.strip() for name, value in re.findall(r"<!-- (\w+):\s*(.*?)\s*-->", comments, re.DOTALL)}
        yield Snippet(language, text, notes.get("instead", text), notes.get("ci"), notes.get("because"))


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty folder with this repository's files, so that what the snippets write stays out of the
    repository."""
    folder = tmp_path_factory.mktemp("clone")
    for name in ("envs", "textocvp", "planning", "experiments", "pyproject.toml"):
        (folder / name).symlink_to(ROOT / name)
    programs = folder / "programs"
    programs.mkdir()
    (programs / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    if shutil.which("textocvp", path=str(Path(sys.executable).parent)) is None:  # not installed: run from the source
        (programs / "textocvp").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m textocvp.cli "$@"\n')
    for program in programs.iterdir():
        program.chmod(0o755)
    return folder


def shell(commands: str, folder: Path) -> None:
    path = os.pathsep.join([str(folder / "programs"), str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "2"}
    for command in commands.replace("\\\n", " ").strip().splitlines():
        done = subprocess.run(
            command, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"$ {command}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"


def test_only_languages_that_are_run() -> None:
    assert {snippet.language for snippet in snippets()} == {"python", "bash"}
    assert [snippet.ci for snippet in snippets() if snippet.ci] == ["install", "test"]
    assert all(snippet.because for snippet in snippets() if snippet.run != snippet.text)


@pytest.mark.skipif(
    DEFAULT_CHECKPOINT not in bundled_checkpoints(), reason=f"the checkpoint {DEFAULT_CHECKPOINT} is not there yet"
)
def test_every_snippet_runs(clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(clone)
    names: dict[str, Any] = {}
    for snippet in snippets():
        if snippet.language == "python":
            exec(compile(snippet.run, "README.md", "exec"), names)
        elif snippet.ci is None:
            shell(snippet.run, clone)
    for film in ("imagined.gif", "what-if.gif"):
        assert len(list(iio.imiter(clone / film))) == 33  # the shown frame, and as many as the model looks ahead
    assert names["what_if"].slots.shape[0] == 3 and names["then"].texts[0].endswith("yellow bowl")
    assert (clone / "strip.png").stat().st_size > 1000
    assert (clone / "runs" / "predictor" / "checkpoint" / "model.safetensors").is_file()


def test_every_file_it_points_to_exists() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", README)
    local = [target for target in targets if "://" not in target]
    missing = [target for target in local if not (ROOT / target).exists()]
    if DEFAULT_CHECKPOINT not in bundled_checkpoints():
        missing = [t for t in missing if not t.startswith(("docs/", "textocvp/checkpoints/"))]
    assert local and not missing
    for path in re.findall(r"`((?:textocvp|planning|experiments|envs)/[\w/]+\.py)`", README):
        assert (ROOT / path).is_file()
