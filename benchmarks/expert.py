"""How often the scripted expert succeeds, judged by the simulator: ``python benchmarks/expert.py``.

500 seeded scenes in each control mode; about 4 CPU minutes. Prints a table and names every seed that failed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import sqrt
from typing import Any

import gymnasium as gym
import tyro
from joblib import Parallel, delayed
from tqdm import tqdm

import envs


@dataclass(frozen=True)
class Args:
    """Measure the expert's success."""

    episodes: int = 500
    """Scenes in each control mode; their seeds count from 0."""
    workers: int = 2
    """Processes."""


@cache
def _environment(control: str) -> gym.Env[Any, Any]:
    return gym.make("PutBlockInBowl-v0", control=control)


def succeeds(control: str, seed: int) -> bool:
    """Whether the expert reaches the goal of the scene with this seed, and the arm is home in the end."""
    env = _environment(control)
    env.reset(seed=seed)
    terminated = False
    for action in envs.Expert(env).actions():
        terminated, truncated = env.step(action)[2:4]
        if truncated:
            break
    return terminated


def wilson(successes: int, total: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927): honest also near 0 and 1, where the usual one has no width."""
    z, share = 1.96, successes / total
    middle = (share + z * z / (2 * total)) / (1 + z * z / total)
    half = z * sqrt(share * (1 - share) / total + z * z / (4 * total * total)) / (1 + z * z / total)
    return middle - half, middle + half


def main(args: Args) -> None:
    """Run and print."""
    # As a module of its own, so that worker processes can import what they are to run.
    from benchmarks.expert import succeeds as job

    print(f"{'control':<12}{'success':>14}{'share':>9}   95 % interval")
    for control in ("primitive", "ee"):
        run = Parallel(n_jobs=args.workers, return_as="generator", batch_size=10)
        jobs = (delayed(job)(control, seed) for seed in range(args.episodes))
        results = list(tqdm(run(jobs), total=args.episodes, unit="episode", desc=control, leave=False))
        low, high = wilson(sum(results), len(results))
        share = sum(results) / len(results)
        print(f"{control:<12}{sum(results):>8}/{len(results):<5}{share:>9.2%}   {low:.2%} to {high:.2%}")
        failed = [seed for seed, success in enumerate(results) if not success]
        if failed:
            print(f"  failed seeds: {failed}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
