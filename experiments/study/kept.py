"""What an interrupted study has done already, and what its figures depend on.

A study appends the result of every finished unit of work to `OUT/unfinished.pickle` and removes the file when it is
done. The file begins with the study's identity: a hash of the options that change figures, of all weights that it
reads, of what this machine can measure, and of the code. The code counts as Python reads it: comments, docstrings and
layout do not matter, and neither does git. A run of another identity starts anew. The file is read with `pickle`, so
study into no folder that somebody else has filled.
"""

import ast
import hashlib
import os
import pickle
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("envs", "experiments", "planning", "textocvp")


class KeptWork:
    """The file; `identity` is that of the study that is run now."""

    def __init__(self, path: Path, identity: str) -> None:
        self.path, self.seconds = path, 0.0
        self._found: dict[str, list[Any]] = {}
        header, end = identity.encode() + b"\n", 0
        if path.is_file():
            with path.open("rb") as file:
                if file.readline() == header:
                    end = self._read(file)
        if end:
            os.truncate(path, end)  # a record that was cut off in the middle is dropped
        else:
            path.write_bytes(header)
        self._file = path.open("ab")

    def _read(self, file: Any) -> int:
        end = file.tell()
        while True:
            try:
                part, seconds, outcome = pickle.load(file)
            except (EOFError, pickle.UnpicklingError, ValueError, AttributeError, IndexError):
                return int(end)
            self._found.setdefault(part, []).append(outcome)
            self.seconds, end = seconds, file.tell()

    def of(self, part: str) -> list[Any]:
        """The results of the first units of a part."""
        return self._found.get(part, [])

    def add(self, part: str, seconds: float, outcome: Any) -> None:
        """Keep a result, and how long the study has taken until now."""
        pickle.dump((part, seconds, outcome), self._file)
        self._file.flush()

    def close(self, *, done: bool) -> None:
        """Close the file, and remove it if the study is done."""
        self._file.close()
        if done:
            self.path.unlink()


def identity_of(parts: Iterable[str]) -> str:
    """A hash of all these texts and of the code."""
    return hashlib.sha256("\n".join([*parts, code_digest()]).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """The SHA-256 of a file, read in blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


@lru_cache(maxsize=1)
def code_digest() -> str:
    """A hash of all code that figures can depend on, without comments, docstrings and layout."""
    digest = hashlib.sha256()
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            digest.update(path.relative_to(ROOT).as_posix().encode())
            digest.update(bare_code(path.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()


def bare_code(source: str) -> str:
    """The syntax of a module without docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        documented = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        if documented and ast.get_docstring(node, clean=False) is not None:  # type: ignore[arg-type]
            node.body = node.body[1:]  # type: ignore[attr-defined]
    return ast.dump(tree)
