"""Files that replace others: whatever happens, the old one or the new one is there whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path with the same ending to write to; the file there takes the place of `path` when the block ends well.

    Raises:
        OSError: if there is no room, for example; it names `path`. Nothing half-written stays.
    """
    new = path.with_name(f".new-{path.name}")
    try:
        yield new
        new.replace(path)
    except BaseException as error:
        new.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and (error.filename in (None, str(new))):
            error.filename = str(path)  # those of `write` have none
        raise


def replace_text(path: Path, text: str) -> None:
    """Write a text file; an old one stays whole until the new one is."""
    with replacing(path) as new:
        new.write_text(text, encoding="utf-8")
