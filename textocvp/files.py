"""Files that replace others: whatever happens, the old one or the new one is there whole."""

import errno
import io
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import h5py


@contextmanager
def replacing(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """A path with the same ending to write to; the file there takes the place of `path` when the block ends well.

    Args:
        folder: where several processes, of this machine or another, may write the same file at once; made if
            missing, on the same disk. What a killed process leaves there has a name of its own.

    Raises:
        OSError: if there is no room, for example, or if `path` is a folder or a device, which is said before the block
            is run; it names `path`. Nothing half-written stays.
    """
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "no ordinary file"
        raise OSError(errno.EISDIR if path.is_dir() else errno.EINVAL, f"this is {what} and is not replaced", str(path))
    if folder is None:
        new = path.with_name(f".new-{path.name}")
    else:
        folder.mkdir(parents=True, exist_ok=True)
        new = folder / f".new-{uuid.uuid4().hex}-{path.name}"
    try:
        yield new
        with open(new, "rb") as file:
            os.fsync(file.fileno())
        new.replace(path)
    except BaseException as error:
        new.unlink(missing_ok=True)  # on a full disk nothing else makes room
        if isinstance(error, OSError) and error.errno and (error.filename in (None, str(new))):
            error.filename = str(path)  # those of `write` have none
        raise


def replace_text(path: Path, text: str) -> None:
    """Write a text file; an old one stays whole until the new one is."""
    with replacing(path) as new:
        new.write_text(text, encoding="utf-8")


class _Disk(io.FileIO):
    """A file that keeps its first error to itself: HDF5 crashes when it cannot write what it closes."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0


@contextmanager
def hdf5_to_write(path: Path, mode: Literal["w", "r+"] = "w") -> Iterator[h5py.File]:
    """An HDF5 file, open to write; an OSError, when it is closed, where there was no room for it."""
    with _Disk(path, f"{mode[0]}+") as disk:
        try:
            with h5py.File(disk, mode) as file:
                yield file
        finally:
            if disk.error is not None:
                raise OSError(disk.error.errno, disk.error.strerror, str(path)) from disk.error
