"""Episodes of any format, what is cached of them, and training batches.

Another format is a subclass of `Episodes` in a file of its own, and a line in `FORMATS`.
"""

import os
from pathlib import Path

from textocvp.data.cater import CaterEpisodes
from textocvp.data.cliport import CliportEpisodes
from textocvp.data.episodes import EpisodeFile, Episodes

FORMATS: dict[str, type[Episodes]] = {"hdf5": EpisodeFile, "cliport": CliportEpisodes, "cater": CaterEpisodes}
"""Every format by name, in the order in which they are tried."""


def open_episodes(path: str | os.PathLike[str], first: int | None = None) -> Episodes:
    """Open the file or folder at `path`, of whichever format; with `first`, only the first so many episodes.

    Raises:
        FileNotFoundError: when there is nothing at `path`.
        ValueError: when no format knows it, it is damaged, or `first` is below 1.
    """
    path = Path(path)
    for kind in FORMATS.values():
        if kind.detect(path):
            return kind(path, first)
    if path.exists():
        raise ValueError(f"{path} is not an episode file, nor of another format ({', '.join(FORMATS)})")
    return EpisodeFile(path, first)  # which says that there is none, and how to collect one
