"""How well a parser sees, on held-out episodes as they are and under other light.

    python benchmarks/parser.py runs/parser/checkpoint data/varied-test.h5 [--episodes 40] [--drawn]

All objects of at least 4 visible pixels count. Bars for scenes `varied` at 168x168: object IoU .80, above one half .93,
robot IoU .90, followed .95.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from textocvp.data import open_episodes
from textocvp.model import TextOCVP
from textocvp.training.evaluate_parser import measure_parser
from textocvp.training.light import jpeg

Frames = NDArray[np.uint8]
WOOD = (133, 94, 66)  # RGB


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


def gain(factor: float) -> Callable[[Frames], Frames]:
    return lambda frames: _picture(frames * factor)


def gradient(frames: Frames) -> Frames:
    """25 % darker at the left edge, 25 % brighter at the right one."""
    return _picture(frames * np.linspace(0.75, 1.25, frames.shape[2])[:, None])


def noise(frames: Frames) -> Frames:
    return _picture(frames + 8 * np.random.default_rng(0).standard_normal(frames.shape))


def wood(frames: Frames) -> Frames:
    """Everything that has the table's colour in the first frame's lower middle becomes a wooden board."""
    H, W = frames.shape[1:3]
    table = np.median(frames[:, int(0.55 * H) : int(0.75 * H), W // 4 : -W // 4].reshape(-1, 3), axis=0)
    is_table = np.abs(frames - table).max(-1, keepdims=True) <= 4
    rng, row = np.random.default_rng(0), np.linspace(0, 1, H)[:, None]
    rings = 3 * np.sin(14 * row + rng.normal(0, 0.2, (1, W)).cumsum(1) * 0.3) + rng.normal(0, 1.5, (H, 1))
    board = np.array(WOOD) * (1 + 0.04 * rings[..., None])
    return _picture(np.where(is_table, board, frames))


def _picture(frames: NDArray[np.floating]) -> Frames:
    return frames.round().clip(0, 255).astype(np.uint8)


LIGHTS: dict[str, Callable[[Frames], Frames]] = {
    "as it is": lambda frames: frames,
    "brightness x 0.7": gain(0.7),
    "brightness x 1.25": gain(1.25),
    "gradient of 25 %": gradient,
    "noise of sigma 8": noise,
    "JPEG, quality 75": lambda frames: np.stack([jpeg(frame, 75) for frame in frames]),
    "wooden table": wood,
}


def main(args: Benchmark) -> None:
    """Run the command line."""
    model = TextOCVP.from_pretrained(args.checkpoint)
    with open_episodes(args.data, args.episodes) as episodes:
        for name, change in LIGHTS.items():
            if name == "as it is" or args.lights:
                figures = measure_parser(
                    model, episodes, range(len(episodes)), min_pixels=4, drawn_masks=args.drawn, change=change
                )
                print(f"{name:18} {figures}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
