"""Collect episodes into an HDF5 file: ``python -m envs.collect --split train --episodes 10000 --out F``.

``--world cater`` draws clips of CATER-hard instead of the robot's tabletop.

The expert does what each scene asks. With ``--policy any-sentence`` random sentences are carried out, sensible or
not, several in a row in scenes with stacks and filled bowls; each is an episode.

The file is the same for any number of workers and any backend. A run that was killed, at whatever moment, is resumed by
giving the same command again; a finished one is left as it is. docs/data.md describes the file.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import imageio.v3 as iio
import numpy as np
import tyro
from numpy.typing import NDArray

from textocvp.files import replacing

from .cater.record import Captions, CaterConfig
from .checks import check_range
from .dataset import Backend, EpisodeConfig, World, collect, episode_count
from .factors import FACTORS
from .geometry import SIZES
from .physics.camera import PRESETS
from .scenes import SCENES
from .splits import SEEDS_PER_SPLIT, SPLITS

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

SENTENCES = 8  # of a scene
TABLETOP_ONLY = ("policy", "sentences_per_scene", "scene", "camera", "sizes", "without")
CATER_ONLY = ("captions",)
CATER_SPLITS = ("train", "val", "test")
COLUMNS = 9  # frames of an episode on a contact sheet
PIXELS, GAP = 128, 4  # height of a row, and the space between its frames


@dataclass(frozen=True)
class Args:
    """Collect episodes into an HDF5 file, or show what they look like."""

    world: Literal["tabletop", "cater"] = "tabletop"
    """The robot's tabletop, or CATER-hard, which has no robot and takes only split, sizes of the file and captions."""
    split: SplitName = "train"
    """Which scenes; the splits' seeds are disjoint."""
    episodes: int = 100
    """How many episodes the file shall have."""
    policy: Literal["expert", "any-sentence"] = "expert"
    """What is played: each scene's own sentence, or any."""
    sentences_per_scene: int | None = None
    """Sentences in a row with any-sentence, by default 8."""
    workers: int = 1
    """Processes."""
    backend: Backend = "processes"
    """What runs them: processes of this machine, or the Dask or Ray cluster that the environment names."""
    out: Path | None = None
    """The file to write. Default: data/tabletop-SPLIT.h5 (sentences-SPLIT.h5), or preview-SPLIT.png."""
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
    captions: Captions = "explicit"
    """Of CATER-hard: with every attribute and the cell, or with some attributes and the quadrant."""
    fresh: bool = False
    """Throw away the episodes that the file has, and begin anew."""
    preview: bool = False
    """Write a contact sheet PNG of the first episodes instead."""

    def __post_init__(self) -> None:
        check_range("--episodes", self.episodes, 1, SEEDS_PER_SPLIT, whole=True)
        check_range("--workers", self.workers, 1, None, whole=True)
        if self.sentences_per_scene is not None:
            check_range("--sentences-per-scene", self.sentences_per_scene, 1, None, whole=True)
            if self.policy == "expert":
                raise ValueError("--sentences-per-scene needs --policy any-sentence; the expert plays one")
        if self.without and SCENES[self.scene].factors.without(self.without) == SCENES[self.scene].factors:
            raise ValueError(f"--without leaves out nothing of --scene {self.scene}; --scene varied has these factors")
        other = CATER_ONLY if self.world == "tabletop" else TABLETOP_ONLY
        defaults = {each.name: each.default for each in fields(self)}
        for name in other:
            if getattr(self, name) != defaults[name]:
                raise ValueError(f"--{name.replace('_', '-')} is not for --world {self.world}")
        if self.world == "cater" and self.split not in CATER_SPLITS:
            raise ValueError(f"--split of --world cater is one of {', '.join(CATER_SPLITS)}, not {self.split}")


def main(args: Args) -> None:
    """Run the command line."""
    config = configuration(args)
    if args.preview:
        out = args.out or Path(f"preview-{args.split}.png")
        save_contact_sheet(config, min(args.episodes, 8), out)
        print(f"wrote {out}")
    else:
        name = args.world if args.policy == "expert" else "sentences"
        out = args.out or Path(f"data/{name}-{args.split}.h5")
        collect(config, args.episodes, out, args.workers, args.backend, fresh=args.fresh)
        print(f"{out}: {episode_count(out, config)} episodes of split {args.split}")
        if args.world == "tabletop" and (missing := SCENES[args.scene].missing):
            print(missing)  # the environment has warned before, where a bar may have hidden it


def configuration(args: Args) -> World:
    """What decides the content of the episodes."""
    if args.world == "cater":
        return CaterConfig(args.split, args.image_size, args.captions)
    return EpisodeConfig(
        args.split,
        args.scene,
        args.image_size,
        args.camera,
        args.sizes,
        factors=SCENES[args.scene].factors.without(args.without),
        policy=args.policy,
        sentences=1 if args.policy == "expert" else args.sentences_per_scene or SENTENCES,
    )


def save_contact_sheet(config: World, episodes: int, out: Path) -> None:
    """Write a PNG with one row for each episode: frames evenly spread from the first to the last."""
    env = config.make()
    try:
        played = config.record(env, range(episodes))
        rows = [_contact_row(episode.arrays["frames"]) for episode in played]
    finally:
        env.close()
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as part:
        iio.imwrite(part, np.concatenate(rows), extension=out.suffix)


def _contact_row(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`COLUMNS` frames of (T, H, W, 3) beside each other with a gap; small ones enlarged."""
    chosen = frames[np.linspace(0, len(frames) - 1, COLUMNS).round().astype(int)]
    factor = max(1, PIXELS // frames.shape[1])
    large = chosen.repeat(factor, axis=1).repeat(factor, axis=2)
    spaced = np.pad(large, ((0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255)
    return np.concatenate(list(spaced), axis=1)


if __name__ == "__main__":
    try:
        if sum(one.split("=")[0] == "--without" for one in sys.argv) > 1:  # only the last would count
            raise ValueError("give --without once, with all factors after it")
        main(tyro.cli(Args, description=__doc__))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
