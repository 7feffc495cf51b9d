"""Collect expert episodes into an HDF5 file: ``python -m envs.collect --split train --episodes 10000 --out
F``.

The file is the same for any number of workers. A run that was killed, at whatever moment, is resumed by
giving the same command again; a finished one is left as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from envs.collection import collect
from envs.episode import EpisodeConfig
from envs.preview import save_contact_sheet
from envs.splits import SEEDS_PER_SPLIT
from envs.storage import episode_count


@dataclass(frozen=True)
class Args:
    """Collect expert episodes into an HDF5 file, or show what they look like."""

    split: Literal["train", "val", "test", "unseen_colors", "more_objects", "controllability"] = "train"
    """Which scenes; the splits' seeds are disjoint."""
    episodes: int = 100
    """How many episodes the file shall have."""
    workers: int = 1
    """Processes."""
    out: Path | None = None
    """The file to write. Default: data/tabletop-SPLIT.h5, or preview-SPLIT.png."""
    image_size: int = 64
    """Height and width in pixels."""
    camera: Literal["close", "paper"] = "close"
    """Camera preset."""
    preview: bool = False
    """Write a contact sheet PNG of the first episodes instead."""

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= SEEDS_PER_SPLIT:
            raise ValueError(f"--episodes must be 1 to {SEEDS_PER_SPLIT}, not {self.episodes}")
        if self.workers < 1:
            raise ValueError(f"--workers must be at least 1, not {self.workers}")


def main(args: Args) -> None:
    """Run the command line."""
    config = EpisodeConfig(args.split, image_size=args.image_size, camera=args.camera)
    if args.preview:
        out = args.out or Path(f"preview-{args.split}.png")
        save_contact_sheet(config, min(args.episodes, 8), out)
        print(f"wrote {out}")
    else:
        out = args.out or Path(f"data/tabletop-{args.split}.h5")
        collect(config, args.episodes, out, args.workers)
        print(f"{out}: {episode_count(out, config)} episodes of split {args.split}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
