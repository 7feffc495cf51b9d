"""Speed of the environment: ``python -m benchmarks.env``.

CPU time of this one process, so that other work on the machine counts as little as possible. Beside our scene stands a
CLIPort-like one: 480 physics steps a second, and an arm of as many triangles as the visual meshes of a UR5. Its shapes
are made here, because no asset package is installed; `TRIANGLES` was chosen so that a render at 64x64 takes about the
26 ms that CLIPort's own meshes were measured to cost. Ratios are what carries over to other machines.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet as p
import tyro

import envs
from envs.dataset import EpisodeConfig, collect
from envs.physics.ur5 import find_package
from textocvp.data import open_episodes

LINKS = 7
TRIANGLES = 16_000  # of one link of the CLIPort-like arm


@dataclass(frozen=True)
class Args:
    """Measure the environment's speed."""

    episodes: int = 10
    """Episodes for each figure."""
    reading: bool = True
    """Whether to measure random clips too (collects 40 episodes first)."""


@dataclass(frozen=True)
class Speed:
    """CPU time of one way to run."""

    name: str
    frame_ms: float  # one render: RGB, segmentation and depth
    step_ms: float  # one physics step
    reset_ms: float  # building a scene
    episode_s: float  # a whole expert episode: reset, and all its frames
    frames: float  # of an episode, on average

    def row(self) -> str:
        """A line of the table."""
        return (
            f"{self.name:<28}{self.frame_ms:>10.2f}{self.step_ms:>10.3f}{self.reset_ms:>10.1f}"
            f"{self.episode_s:>12.2f}{self.frames:>8.1f}"
        )


def measure(
    name: str, size: int, hz: int, stride: int, episodes: int, meshes: Path | None = None, scene: str = "simple"
) -> Speed:
    """Play expert episodes; with ``meshes``, next to the dense arm of that file."""
    env = gym.make(
        "PutBlockInBowl-v0", scene=scene, image_size=size, physics_hz=hz, render_stride=stride, record_frames=True
    )
    world = env.unwrapped.world  # type: ignore[attr-defined]
    total = resets = 0.0
    count = 0
    for seed in range(episodes + 1):
        begin = time.process_time()
        env.reset(seed=seed)
        reset = time.process_time() - begin
        if meshes is not None:
            _add_dense_arm(world, meshes)
        begin = time.process_time()
        for action in envs.Expert(env).actions():
            frames = 1 + len(env.step(action)[4]["frames"])
        if seed > 0:  # the first one fills caches
            count += frames
            total += time.process_time() - begin + reset
            resets += reset
    render, step = _mean_ms(world.render, 30), _mean_ms(world.step, 200)
    env.close()
    return Speed(name, render, step, 1e3 * resets / episodes, total / episodes, count / episodes)


def _mean_ms(call: Any, times: int) -> float:
    begin = time.process_time()
    for _ in range(times):
        call()
    return 1e3 * (time.process_time() - begin) / times


def _add_dense_arm(world: Any, mesh: Path) -> None:
    """Stand dense links where the arm works; they touch nothing."""
    for link in range(LINKS):
        shape = world.bullet.createVisualShape(p.GEOM_MESH, fileName=str(mesh))
        place = [0.05 + 0.05 * link, 0.0, 0.25]
        world.bullet.createMultiBody(0, -1, shape, place)
    world._label = np.append(world._label, np.ones(LINKS, dtype=np.uint8))


def _write_dense_link(path: Path) -> None:
    """A tube of `TRIANGLES` triangles, 30 cm long."""
    rings, corners = 80, TRIANGLES // 160
    lines = [
        f"v {0.05 * cos(2 * pi * c / corners):.5f} {0.05 * sin(2 * pi * c / corners):.5f} {0.3 * r / rings:.5f}"
        for r in range(rings + 1)
        for c in range(corners)
    ]
    for r in range(rings):
        for c in range(corners):
            a, b = 1 + r * corners + c, 1 + r * corners + (c + 1) % corners
            lines += [f"f {a} {b} {a + corners}", f"f {b} {b + corners} {a + corners}"]
    path.write_text("\n".join(lines))


def clip_speed(folder: Path) -> float:
    """Frames a second of random clips of 6 frames, in batches of 64."""
    collect(EpisodeConfig("train"), 40, folder / "clips.h5")
    with open_episodes(folder / "clips.h5") as episodes:
        rng = np.random.default_rng(0)
        spent = _mean_ms(lambda: episodes.clips(episodes.random_starts(rng, 64, 6), 6), 10)
    return 64 * 6 / (spent / 1e3)


def main(args: Args) -> None:
    """Run and print."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        mesh = folder / "link.obj"
        _write_dense_link(mesh)
        print(f"{'CPU time':<28}{'ms/frame':>10}{'ms/step':>10}{'ms/reset':>10}{'s/episode':>12}{'frames':>8}")
        for size, stride, bars in ((64, 16, "2.5 ms a frame, 0.8 s an episode"), (336, 8, "2.2 s an episode")):
            ours = measure(f"ours {size}x{size}", size, 240, stride, args.episodes)
            print(ours.row(), flush=True)
            few = max(1, args.episodes // 5)
            like = measure(f"CLIPort-like {size}x{size}", size, 480, 2 * stride, few, mesh)
            print(like.row(), flush=True)
            print(
                f"  ours is {like.frame_ms / ours.frame_ms:.1f} times faster a frame and "
                f"{like.episode_s / ours.episode_s:.1f} times an episode (bars: {bars})"
            )
        for scene in ("cliport", "varied"):
            for size in (168, 336):
                speed = measure(f"{scene} {size}x{size}", size, 480, 16, args.episodes, scene=scene)
                print(speed.row())
                collecting = 1e3 * speed.episode_s / speed.frames
                print(
                    f"  {collecting:.1f} ms a frame of collection"
                    + (" (bar: 25)" if size == 168 else "")
                    + ("" if find_package() else ", with cylinders: the extra `ur5` is not installed")
                )
        if args.reading:
            print(f"random clips of 6 frames: {clip_speed(folder):,.0f} frames/s (bar: 2,000)")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
