"""The families of `RearrangeBlocks-v0`, judged by the simulator: ``python -m benchmarks.rearrange``.

For each family: how often one random sentence reaches the goal, beside the share of the sentences that should by the
rule of `outcome`; how often the expert does; and how many sentences it needs. 60 seeded scenes of each, 2 CPU minutes.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import tyro
from joblib import Parallel, delayed

import envs
from envs.tabletop import TabletopEnv
from envs.tasks.rearrange import FAMILIES, Rearrange, arrangement_after
from textocvp.metrics import wilson_interval


@dataclass(frozen=True)
class Args:
    """Measure the families."""

    episodes: int = 60
    """Scenes of each family; their seeds count from 0."""
    workers: int = 2
    """Processes."""
    scene: str = "simple"
    """Of the environments: simple, cliport or varied."""


@dataclass(frozen=True)
class Played:
    """What came of one start."""

    chance: float  # share of the sentences that should reach the goal
    random: bool  # whether a random sentence did
    expert: bool  # whether the expert did
    sentences: int  # the fewest that should


def play(scene: str, family: str, seeds: range) -> list[Played]:
    """Each start twice: with one random sentence, and with the expert."""
    env = gym.make("RearrangeBlocks-v0", scene=scene).unwrapped
    assert isinstance(env, TabletopEnv) and isinstance(env.task, Rearrange)
    task, results = env.task, []
    for seed in seeds:
        _, info = env.reset(seed=seed, options={"family": family})
        start, said = info["supports"], task.sentences(env.scene.objects, "seen")
        plan = task.solve(env.scene, start)
        assert plan and not info["is_success"]
        should = [all(task.holds(arrangement_after(start, pair), env.scene)) for pair in said]
        pair = said[np.random.default_rng([seed, 3]).integers(len(said))]
        luck = env.step(envs.Expert(env).primitive(pair))[4]["is_success"]
        env.reset(seed=seed, options={"family": family})
        for action in envs.Expert(env).actions():
            info = env.step(action)[4]
        results.append(Played(float(np.mean(should)), luck, info["is_success"], len(plan)))
    env.close()
    return results


def main(args: Args) -> None:
    """Run and print."""
    print(f"{'family':<10}{'chance':>8}{'one random sentence':>21}{'expert':>9}   95 % interval     sentences")
    run = Parallel(n_jobs=args.workers, return_as="generator")
    every = run(delayed(play)(args.scene, family, range(args.episodes)) for family in FAMILIES)
    for family, results in zip(FAMILIES, every, strict=True):
        total, wins = len(results), sum(each.expert for each in results)
        share, counts = wilson_interval(wins, total), Counter(each.sentences for each in results)
        print(
            f"{family:<10}{np.mean([each.chance for each in results]):>8.1%}"
            f"{sum(each.random for each in results):>14} of {total:<4}{wins:>5}/{total:<5}"
            f"{share.low:.1%} to {share.high:.1%}   "
            + ", ".join(f"{number}: {count}" for number, count in sorted(counts.items())),
            flush=True,
        )


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
