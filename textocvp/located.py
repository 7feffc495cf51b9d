"""Where checkpoints are: in this package, in a folder, or on the Hugging Face hub."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

from textocvp.model import CONFIG_FILE, WEIGHTS_FILE, CheckpointError, checkpoint_folder

DEFAULT_CHECKPOINT = "tabletop-small"


@dataclass(frozen=True)
class Checkpoint:
    """Where a model came from.

    Attributes:
        name: the bundled name, the folder or the hub id that was asked for.
        sha256: of its `model.safetensors`; empty for a model that was never saved.
    """

    name: str
    sha256: str = ""

    @classmethod
    def of(cls, folder: Path, name: str) -> Checkpoint:
        """The checkpoint in `folder`, found under `name`."""
        return cls(name, hashlib.sha256((folder / WEIGHTS_FILE).read_bytes()).hexdigest())


def bundled_checkpoints() -> list[str]:
    """Names of the checkpoints that come with the package."""
    root = files("textocvp") / "checkpoints"
    if not root.is_dir():
        return []
    return sorted(folder.name for folder in root.iterdir() if (folder / CONFIG_FILE).is_file())


@contextmanager
def located(name: str) -> Iterator[Path]:
    """The folder of a checkpoint, for as long as the context lasts.

    Args:
        name: a bundled name, else a folder, else the id `owner/name` of a repository on the Hugging Face hub.

    Raises:
        CheckpointError: if there is none of these; the message lists the bundled ones.
    """
    if name in bundled_checkpoints():
        with as_file(files("textocvp") / "checkpoints" / name) as folder:
            yield folder
        return
    if Path(name).is_dir():
        yield Path(name)
        return
    bundled = ", ".join(bundled_checkpoints()) or "none"
    allowed = (
        f"Bundled checkpoints: {bundled}. Else give a folder that contains {CONFIG_FILE} and {WEIGHTS_FILE}, or the "
        "id owner/name of a repository on the Hugging Face hub that does."
    )
    if name.count("/") != 1 or name.startswith((".", "/", "~")):
        raise CheckpointError(f"unknown checkpoint {name!r}. {allowed}")
    try:
        fetched = checkpoint_folder(name)
    except CheckpointError as error:
        raise CheckpointError(f"unknown checkpoint {name!r}: {error}. {allowed}") from error
    yield fetched
