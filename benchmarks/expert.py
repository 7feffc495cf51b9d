"""How often the scripted expert succeeds, judged by the simulator: ``python -m benchmarks.expert``.

Seeded scenes of `PutBlockInBowl-v0` in each control mode, and of each family of `RearrangeBlocks-v0`. There also how
often one random sentence reaches the goal, beside the share of the sentences that should by the rule of `outcome`, and
how many sentences are needed. 60 scenes of each take 3 CPU minutes. Names every seed in which the expert failed.
"""

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

GROUP = 25  # episodes that share an environment


@dataclass(frozen=True)
class Args:
    """Measure the expert's success."""

    episodes: int = 60
    """Scenes of each kind; their seeds count from 0."""
    workers: int = 2
    """Processes."""
    scene: str = "simple"
    """Of the environments: simple, cliport or varied."""


@dataclass(frozen=True)
class Played:
    """What came of one start."""

    seed: int
    expert: bool  # whether the expert reached the goal, and the arm was home in the end
    random: bool = False  # whether a random sentence did
    chance: float = 0.0  # share of the sentences that should
    sentences: int = 1  # the fewest that should


def play(scene: str, kind: str, seeds: range) -> list[Played]:
    """Scenes of a control mode or of a family; those of a family twice, first with one random sentence."""
    family = kind if kind in FAMILIES else None
    name, options = ("RearrangeBlocks-v0", {"family": kind}) if family else ("PutBlockInBowl-v0", None)
    env = gym.make(name, scene=scene, control="primitive" if family else kind).unwrapped
    assert isinstance(env, TabletopEnv)
    results = []
    for seed in seeds:
        _, info = env.reset(seed=seed, options=options)
        beside = {}
        if isinstance(task := env.task, Rearrange):
            start, said = info["supports"], task.sentences(env.scene.objects, "seen")
            should = [all(task.holds(arrangement_after(start, pair), env.scene)) for pair in said]
            pair = said[np.random.default_rng([seed, 3]).integers(len(said))]
            beside = {"chance": float(np.mean(should)), "sentences": len(task.solve(env.scene, start) or ())}
            beside["random"] = env.step(envs.Expert(env).primitive(pair))[4]["is_success"]
            env.reset(seed=seed, options=options)
        terminated = truncated = False
        for action in envs.Expert(env).actions():
            terminated, truncated = env.step(action)[2:4]
            if truncated:
                break
        results.append(Played(seed, terminated, **beside))
    env.close()
    return results


def main(args: Args) -> None:
    """Run and print."""
    print(f"{'scenes':<10}{'expert':>9}{'95 % interval':>18}{'one random sentence':>21}{'chance':>8}   sentences")
    groups = [range(k, min(k + GROUP, args.episodes)) for k in range(0, args.episodes, GROUP)]
    run = Parallel(n_jobs=args.workers)
    for kind in ("primitive", "ee", *FAMILIES):
        found = [one for group in run(delayed(play)(args.scene, kind, seeds) for seeds in groups) for one in group]
        wins, total = sum(one.expert for one in found), len(found)
        share, counts = wilson_interval(wins, total), sorted(Counter(one.sentences for one in found).items())
        print(f"{kind:<10}{wins:>4}/{total:<4}{share.low:>9.2%} to {share.high:.2%}", end="", flush=True)
        if kind in FAMILIES:
            lucky, chance = sum(one.random for one in found), np.mean([one.chance for one in found])
            needed = ", ".join(f"{number}: {count}" for number, count in counts)
            print(f"{lucky:>14} of {total:<4}{chance:>8.1%}   {needed}", end="")
        print("".join(f"\n  failed: seed {one.seed}" for one in found if not one.expert))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
