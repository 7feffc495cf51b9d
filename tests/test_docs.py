"""The map from the paper to the code leads somewhere, and so does every link between the pages."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

import pytest

from textocvp import cli

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
CARDS = sorted((ROOT / "textocvp" / "checkpoints").glob("*/README.md"))


def defined(path: Path) -> set[str]:
    """Names of classes and functions at the top of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))}


def test_every_file_and_name_of_the_map_exists() -> None:
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w/]+\.py)`(?: `(\w+)`)?", text)
    assert len(named) > 25
    for file, name in named:
        assert (ROOT / file).is_file(), file
        assert not name or name in defined(ROOT / file), f"{file} has no {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_to_files(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


def trainings(page: Path) -> list[list[str]]:
    """The arguments of every complete `textocvp train` command of a page."""
    blocks = re.findall(r"^```bash\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    found = [re.search(r"(?:textocvp(?:\.cli)? train|train\.sbatch) (.*--.*)", line) for line in lines]
    return [shlex.split(match.group(1)) for match in found if match]


@pytest.mark.parametrize("page", [*PAGES, *CARDS], ids=lambda page: str(page.relative_to(ROOT)))
def test_every_training_command_is_one_that_is_understood(
    page: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where there are no episodes: the first thing to be missed
    for arguments in trainings(page):
        assert cli.main(["train", *arguments]) == 1, arguments  # 2, as an exit, for options that there are not
        assert "there is no episode file" in capsys.readouterr().err, arguments


def test_commands_are_found() -> None:
    assert len(trainings(ROOT / "docs" / "models.md")) >= 12 and len(trainings(ROOT / "docs" / "scale.md")) == 3
    assert all(trainings(card) for card in CARDS)
