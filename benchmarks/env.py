"""Speed of the environment: ``python -m benchmarks.env``.

CPU time of this one process, so that other work on the machine counts as little as possible. Bars: in the scene
`simple` 2.5 ms a render and .8 s an episode at 64x64, 2.2 s an episode at 336x336; in `cliport` and `varied` at 168x168
25 ms of an episode for each of its frames.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from timeit import timeit
from typing import Any

import gymnasium as gym
import numpy as np
import tyro

import envs
from envs.dataset import EpisodeConfig, collect
from envs.physics.ur5 import find_package
from textocvp.data import open_episodes

# Name, pixels along a side of a frame, and physics steps from one to the next.
SCENES = (
    ("simple", 64, 16), ("simple", 336, 8), ("cliport", 168, 16), ("cliport", 336, 16), ("varied", 168, 16),
    ("varied", 336, 16),
)  # fmt: skip
COLUMNS = ("ms/render", "ms/step", "ms/reset", "s/episode", "frames")  # of an episode with its reset


@dataclass(frozen=True)
class Args:
    """Measure the environment's speed."""

    episodes: int = 10
    """Episodes for each figure."""
    reading: bool = True
    """Whether to measure random clips too (collects 40 episodes first)."""


def measure(scene: str, size: int, stride: int, episodes: int) -> list[float]:
    """Play expert episodes; the figures of `COLUMNS`."""
    env = gym.make("PutBlockInBowl-v0", scene=scene, image_size=size, render_stride=stride, record_frames=True)
    world = env.unwrapped.world  # type: ignore[attr-defined]
    taken = []
    for seed in range(episodes + 1):
        begin = time.process_time()
        env.reset(seed=seed)
        built = time.process_time()
        for action in envs.Expert(env).actions():
            frames = 1 + len(env.step(action)[4]["frames"])
        taken.append((1e3 * (built - begin), time.process_time() - begin, frames))
    render, step = _mean_ms(world.render, 30), _mean_ms(world.step, 200)
    env.close()
    return [render, step, *np.mean(taken[1:], axis=0)]  # the first one fills caches


def _mean_ms(call: Any, times: int) -> float:
    return 1e3 * timeit(call, number=times, timer=time.process_time) / times


def clip_speed(folder: Path) -> float:
    """Frames a second of random clips of 6 frames, in batches of 64."""
    collect(EpisodeConfig("train"), 40, folder / "clips.h5")
    with open_episodes(folder / "clips.h5") as episodes:
        rng = np.random.default_rng(0)
        spent = _mean_ms(lambda: episodes.clips(episodes.random_starts(rng, 64, 6), 6), 10)
    return 64 * 6 / (spent / 1e3)


def main(args: Args) -> None:
    """Run and print."""
    print(f"{'CPU time':<18}" + "".join(f"{column:>12}" for column in COLUMNS))
    for scene, size, stride in SCENES:
        figures = measure(scene, size, stride, args.episodes)
        print(f"{f'{scene} {size}x{size}':<18}" + "".join(f"{figure:>12.3f}" for figure in figures), flush=True)
    if not find_package():
        print("the arm is drawn with cylinders: the extra `ur5` is not installed")
    if args.reading:
        with TemporaryDirectory() as folder:
            print(f"random clips of 6 frames: {clip_speed(Path(folder)):,.0f} frames/s (bar: 2,000)")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
