"""What foreseeing outcomes saves over imagining films: ``python -m benchmarks.search``.

Three figures, each measured in this run: 30 sentences parsed, imagined and scored, as films of 24 frames and as
outcomes, in turns; in how many `val` scenes of `PutBlockInBowl-v0` both choose the same sentence; and seconds of a plan
in scenes of `RearrangeBlocks-v0` that need three sentences. About 5 minutes on 2 cores.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import gymnasium as gym
import numpy as np
import torch
import tyro

import envs  # noqa: F401 - registers the environments
from envs.splits import SPLITS
from planning import (
    DEFAULT_CRITERION,
    DEFAULT_SCORE,
    AppearanceGrounder,
    BeamPlanner,
    Goal,
    SearchPlanner,
    measure_rollout,
    watched_frames,
)
from planning.search import Wanted, places
from textocvp import WorldModel

SENTENCES, FRAMES, STRIDE = 30, 24, 3


@dataclass(frozen=True)
class Args:
    """Measure what planning costs."""

    checkpoint: str = "tabletop-small"
    """Of a model that foresees outcomes: a bundled name or a folder."""
    scenes: int = 200
    """In which the choices are compared."""
    repeats: int = 15
    """Of what is timed."""
    threads: int = 2
    """Of torch."""


def main(args: Args) -> None:
    """Run and print."""
    torch.set_num_threads(args.threads)
    model, val = WorldModel.from_pretrained(args.checkpoint), SPLITS["val"]
    env = gym.make("PutBlockInBowl-v0", control="primitive")
    same, films, outcomes = 0, [], []
    for number in range(args.scenes):
        seed = val.seed(number)
        observation, info = env.reset(seed=seed, options=val.options(seed))
        ground, goal = AppearanceGrounder.from_info(info), Goal.parse(info["instruction"])
        film = BeamPlanner(model, depth=1, candidates="scene")
        chosen = film.plan(observation["rgb"], goal, ground).instruction
        same += SearchPlanner(model, depth=1).plan(observation["rgb"], goal, ground).instruction == chosen
        if number >= args.repeats:
            continue
        (one,) = goal.instructions
        frames = watched_frames(FRAMES + 1, DEFAULT_CRITERION.thresholds.settle_frames, STRIDE)
        said = ground(model.parse(observation["rgb"][None])).instructions("in")
        texts = [said[i % len(said)].text for i in range(SENTENCES)]
        began = perf_counter()
        parsed = model.parse(observation["rgb"][None])
        grounding = ground(parsed).with_kinds(goal.things)
        trace = measure_rollout(model.rollout(parsed, texts, horizon=FRAMES), grounding, one, frames=frames)
        DEFAULT_SCORE(trace), DEFAULT_CRITERION(trace)
        films.append(perf_counter() - began)
        began = perf_counter()
        parsed = model.parse(observation["rgb"][None])
        grounding = ground(parsed).with_kinds(goal.things)
        things = sorted(grounding.things)
        Wanted.of_relations(goal, things).ratios(places(model.outcome(parsed, texts), grounding, things))
        outcomes.append(perf_counter() - began)
    ratios = np.quantile(np.divide(films, outcomes), [0.5, 0.25, 0.75])
    took = f"films {np.median(films):.3f} s, outcomes {np.median(outcomes):.3f} s"
    faster = f"{ratios[0]:.1f} times faster (quartiles {ratios[1]:.1f}, {ratios[2]:.1f})"
    print(f"{SENTENCES} sentences, median of {len(films)}: {took}; {faster}")
    print(f"the same choice in {same} of {args.scenes} scenes ({same / args.scenes:.3f})")
    env = gym.make("RearrangeBlocks-v0", control="primitive")
    seconds, steps = [], []
    for number in range(args.repeats):
        observation, info = env.reset(seed=val.seed(number), options={"family": "swap", "n_objects": 6})
        goal = Goal.parse(info["instruction"])
        plan = SearchPlanner(model).plan(observation["rgb"], goal, AppearanceGrounder.from_info(info))
        seconds.append(plan.seconds)
        steps.append(len(plan.best.instructions))
    print(f"plans over 6 objects, sentences {sorted(steps)}: median {np.median(seconds):.2f} s, longest "
          f"{max(seconds):.2f} s")  # fmt: skip


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
