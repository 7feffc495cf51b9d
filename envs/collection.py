"""Many processes, one file: episodes are collected in pieces and merged in order, atomically."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
from joblib import Parallel, delayed
from tqdm import tqdm

from envs.episode import EpisodeConfig, record_episode
from envs.storage import episode_count, merge, write_episodes

EPISODES_PER_PIECE = 50
"""A kill costs each worker at most the piece it is at: a few seconds."""

EPISODES_PER_MERGE = 500


def collect(config: EpisodeConfig, episodes: int, out: Path, workers: int = 1) -> None:
    """Bring the file ``out`` to at least ``episodes`` episodes of the split.

    Finished pieces of 50 episodes wait in ``out``.parts until they are merged into ``out``, in order; both
    steps are atomic, so a kill loses no finished piece and doubles none.

    Raises:
        ValueError: when ``out`` exists and is something else, or was collected with another configuration.
    """
    done = episode_count(out, config)
    parts = out.with_name(out.name + ".parts")
    ranges = [
        (start, min(start + EPISODES_PER_PIECE, episodes))
        for start in range(done, episodes, EPISODES_PER_PIECE)
    ]
    pieces = [parts / f"{start:07d}-{stop:07d}.h5" for start, stop in ranges]
    waiting: list[Path] = []
    with tqdm(total=episodes, initial=min(done, episodes), unit="episode", desc=config.split) as progress:
        run = Parallel(n_jobs=workers, return_as="generator", pre_dispatch=2 * workers)
        jobs = (
            delayed(_collect_piece)(config, *span, piece) for span, piece in zip(ranges, pieces, strict=True)
        )
        for (start, stop), piece, _ in zip(ranges, pieces, run(jobs), strict=True):
            progress.update(stop - start)
            waiting.append(piece)
            # At least doubling bounds the copying by the size of the final file.
            if stop == episodes or stop - done >= max(EPISODES_PER_MERGE, done):
                merge(out, config, waiting, workshop=parts)
                for merged in waiting:
                    merged.unlink()
                waiting, done = [], stop
    # Only leftovers of killed processes remain.
    shutil.rmtree(parts, ignore_errors=True)


@cache
def _environment(config: EpisodeConfig) -> gym.Env[Any, Any]:
    """One environment for each worker process, whose PyBullet client is used again for each episode."""
    return config.make()


def _collect_piece(config: EpisodeConfig, start: int, stop: int, piece: Path) -> None:
    if episode_count(piece, config) == stop - start:
        return
    env = _environment(config)
    write_episodes(piece, config, [record_episode(env, config, number) for number in range(start, stop)])
