"""How often the scripted expert succeeds, judged by the simulator: ``python -m benchmarks.expert``.

500 seeded scenes in each control mode; about 4 CPU minutes. Prints a table and names every seed that failed.
"""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium as gym
import tyro
from joblib import Parallel, delayed
from tqdm import tqdm

import envs
from textocvp.metrics import wilson_interval

GROUP = 25  # episodes that share an environment


@dataclass(frozen=True)
class Args:
    """Measure the expert's success."""

    episodes: int = 500
    """Scenes in each control mode; their seeds count from 0."""
    workers: int = 2
    """Processes."""
    scene: str = "simple"
    """Of the environments: simple, cliport or varied."""


def play(scene: str, control: str, seeds: range) -> list[bool]:
    """For each seed, whether the expert reaches the goal of its scene and the arm is home in the end."""
    env = gym.make("PutBlockInBowl-v0", scene=scene, control=control)
    results = []
    for seed in seeds:
        env.reset(seed=seed)
        terminated = truncated = False
        for action in envs.Expert(env).actions():
            terminated, truncated = env.step(action)[2:4]
            if truncated:
                break
        results.append(terminated)
    env.close()
    return results


def main(args: Args) -> None:
    """Run and print."""
    print(f"{'control':<12}{'success':>14}{'share':>9}   95 % interval")
    for control in ("primitive", "ee"):
        groups = [range(k, min(k + GROUP, args.episodes)) for k in range(0, args.episodes, GROUP)]
        run = Parallel(n_jobs=args.workers, return_as="generator")
        jobs = (delayed(play)(args.scene, control, seeds) for seeds in groups)
        results: list[bool] = []
        with tqdm(total=args.episodes, unit="episode", desc=control, leave=False) as progress:
            for group in run(jobs):
                results += group
                progress.update(len(group))
        wins, total = sum(results), len(results)
        share = wilson_interval(wins, total)
        print(f"{control:<12}{wins:>8}/{total:<5}{share.value:>9.2%}   {share.low:.2%} to {share.high:.2%}")
        failed = [seed for seed, success in enumerate(results) if not success]
        if failed:
            print(f"  failed seeds: {failed}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
