"""Collect expert episodes into an HDF5 file: ``python -m envs.collect --split train --episodes 10000 --out F``.

The file is the same for any number of workers. A run that was killed, at whatever moment, is resumed by
giving the same command again; a finished one is left as it is. docs/data.md describes the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import imageio.v3 as iio
import numpy as np
import tyro
from numpy.typing import NDArray

from envs.dataset import EpisodeConfig, collect, episode_count, record_episode
from envs.factors import FACTORS
from envs.geometry import SIZES
from envs.physics.camera import PRESETS
from envs.scenes import SCENES
from envs.splits import SEEDS_PER_SPLIT, SPLITS

if TYPE_CHECKING:
    SplitName = str
    SceneName = str
    CameraName = str
    SizesName = str
    FactorName = str
else:
    SplitName = tyro.extras.literal_type_from_choices(SPLITS)
    SceneName = tyro.extras.literal_type_from_choices(SCENES)
    CameraName = tyro.extras.literal_type_from_choices(PRESETS)
    SizesName = tyro.extras.literal_type_from_choices(SIZES)
    FactorName = tyro.extras.literal_type_from_choices(FACTORS)

COLUMNS = 9
"""Frames of an episode on a contact sheet."""

PIXELS = 128
GAP = 4


@dataclass(frozen=True)
class Args:
    """Collect expert episodes into an HDF5 file, or show what they look like."""

    split: SplitName = "train"
    """Which scenes; the splits' seeds are disjoint."""
    episodes: int = 100
    """How many episodes the file shall have."""
    workers: int = 1
    """Processes."""
    out: Path | None = None
    """The file to write. Default: data/tabletop-SPLIT.h5, or preview-SPLIT.png."""
    image_size: int = 64
    """Height and width in pixels."""
    scene: SceneName = "simple"
    """Made easy, as CLIPort's, or CLIPort's with random factors."""
    camera: CameraName | None = None
    """Camera preset; by default the scene's."""
    sizes: SizesName | None = None
    """Of blocks and bowls: the paper's or CLIPort's own; by default the scene's."""
    without: tuple[FactorName, ...] = ()
    """Factors of the scene to leave out."""
    preview: bool = False
    """Write a contact sheet PNG of the first episodes instead."""

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= SEEDS_PER_SPLIT:
            raise ValueError(f"--episodes must be 1 to {SEEDS_PER_SPLIT}, not {self.episodes}")
        if self.workers < 1:
            raise ValueError(f"--workers must be at least 1, not {self.workers}")


def main(args: Args) -> None:
    """Run the command line."""
    factors = SCENES[args.scene].factors.without(args.without)
    config = EpisodeConfig(args.split, args.scene, args.image_size, args.camera, args.sizes, factors=factors)
    if args.preview:
        out = args.out or Path(f"preview-{args.split}.png")
        save_contact_sheet(config, min(args.episodes, 8), out)
        print(f"wrote {out}")
    else:
        out = args.out or Path(f"data/tabletop-{args.split}.h5")
        collect(config, args.episodes, out, args.workers)
        print(f"{out}: {episode_count(out, config)} episodes of split {args.split}")


def save_contact_sheet(config: EpisodeConfig, episodes: int, out: Path) -> None:
    """Write a PNG with one row for each episode: frames evenly spread from the first to the last."""
    env = config.make()
    try:
        rows = [_contact_row(record_episode(env, config, i).arrays["frames"]) for i in range(episodes)]
    finally:
        env.close()
    out.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(out, np.concatenate(rows))


def _contact_row(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`COLUMNS` frames of (T, H, W, 3) beside each other with a gap; small ones enlarged."""
    chosen = frames[np.linspace(0, len(frames) - 1, COLUMNS).round().astype(int)]
    factor = max(1, PIXELS // frames.shape[1])
    large = chosen.repeat(factor, axis=1).repeat(factor, axis=2)
    spaced = np.pad(large, ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255)
    return np.concatenate(list(spaced), axis=1)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
