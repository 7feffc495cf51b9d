"""The folder a study writes: checked before the work starts, filled in one go when the work is done."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class OutputFolder:
    """A folder such as `results/controllability`.

    Making one creates the folder and proves that files can be written there, so that a study of an hour
    cannot fail at its last step. `fill` then gives a temporary folder beside the final files; only when its
    block ends well do the files move into place, each by one atomic rename, `results.json` last. Other files
    in the folder are left alone, so that `--out` may safely name a folder with something else in it.

    Raises:
        NotADirectoryError, PermissionError, OSError: if files cannot be written there; the message names it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.path, prefix=".writable-"):
                pass
        except (FileExistsError, NotADirectoryError):
            raise NotADirectoryError(
                f"cannot write to {self.path}: a file of that name is in the way"
            ) from None
        except OSError as error:
            raise type(error)(f"cannot write to {self.path}: {error.strerror or error}") from None

    @contextmanager
    def fill(self) -> Iterator[Path]:
        """A temporary folder; its files replace those of the same name here once the block ends well."""
        partial = Path(tempfile.mkdtemp(dir=self.path, prefix=".partial-"))
        try:
            yield partial
            files = sorted(p for p in partial.rglob("*") if p.is_file())
            # results.json says that a study is complete, so it must be the last to appear.
            for file in sorted(files, key=lambda p: p.name == "results.json"):
                target = self.path / file.relative_to(partial)
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(file, target)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
