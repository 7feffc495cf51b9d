"""How well a parser sees, on held-out episodes as they are and under other light.

    python benchmarks/parser.py runs/parser/checkpoint data/varied-test.h5 [--episodes 40] [--drawn]

All objects of at least 4 visible pixels count. Bars for scenes `varied` at 168x168: object IoU .80, above one half .93,
robot IoU .90, followed .95.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from experiments.study.pictures import CHANGES, UNCHANGED, change_picture
from textocvp.data import open_episodes
from textocvp.model import TextOCVP
from textocvp.training.evaluate_parser import measure_parser

Frames = NDArray[np.uint8]


@dataclass
class Benchmark:
    """Measure a parser."""

    checkpoint: tyro.conf.Positional[str]
    data: tyro.conf.Positional[Path]
    """Held-out episodes with masks."""
    episodes: int = 40
    lights: bool = True
    """Also under other light."""
    drawn: bool = False
    """Measure the masks that the renderer draws instead of the parser's own."""


def relit(name: str, frames_THW3: Frames) -> Frames:
    """A clip changed as `CHANGES` says, every frame in the same way: light, grain and noise stand still.

    The table is whatever has, in a frame, the commonest colour of the first one's lower middle.
    """
    H, W = frames_THW3.shape[1:3]
    table = np.median(frames_THW3[0, int(0.55 * H) : int(0.75 * H), W // 4 : -W // 4].reshape(-1, 3), axis=0)
    is_table_THW = np.abs(frames_THW3 - table).max(-1) <= 4
    pairs = zip(frames_THW3, is_table_THW, strict=True)
    return np.stack([change_picture(name, *pair, np.random.default_rng(0)) for pair in pairs])


def main(args: Benchmark) -> None:
    """Run the command line."""
    model = TextOCVP.from_pretrained(args.checkpoint)
    with open_episodes(args.data, args.episodes) as episodes:
        for name in CHANGES if args.lights else [UNCHANGED]:
            figures = measure_parser(
                model, episodes, range(len(episodes)), min_pixels=4, drawn_masks=args.drawn,
                change=partial(relit, name),
            )  # fmt: skip
            print(f"{name:19} {figures}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
