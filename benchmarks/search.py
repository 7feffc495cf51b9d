"""What foreseeing outcomes saves over imagining films: ``python -m benchmarks.search``.

Three figures, each measured in this run: 30 sentences parsed, imagined and scored, as films of 24 frames and as
outcomes, in turns; in how many `val` scenes of `PutBlockInBowl-v0` both choose the same sentence; and seconds of a plan
in scenes of `RearrangeBlocks-v0` that need three sentences. About 5 minutes on 2 cores.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro

import envs  # noqa: F401 - registers the environments
from envs.splits import SPLITS
from experiments.runtime import CANDIDATES, planning_work
from experiments.study.scenes import SampledScene, sample_scene, study_scenes
from experiments.study.timing import Work, race
from planning import AppearanceGrounder, BeamPlanner, Goal, SearchPlanner
from planning.search import Wanted, places
from textocvp import WorldModel


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


def foresight(model: WorldModel, sampled: SampledScene) -> Work:
    """What `planning_work` does in a query, with outcomes instead of films."""
    image_1HW3, ground = sampled.observation["rgb"][None], AppearanceGrounder.from_info(sampled.info)
    goal = Goal.parse(sampled.texts[0])
    said = ground(model.parse(image_1HW3)).with_kinds(goal.things).instructions("in")
    texts = [said[i % len(said)].text for i in range(CANDIDATES)]

    def query() -> object:
        parsed = model.parse(image_1HW3)
        grounding = ground(parsed).with_kinds(goal.things)
        things = sorted(grounding.things)
        return Wanted.of_relations(goal, things).ratios(places(model.outcome(parsed, texts), grounding, things))

    return query


def main(args: Args) -> None:
    """Run and print."""
    torch.set_num_threads(args.threads)
    model, val = WorldModel.from_pretrained(args.checkpoint), SPLITS["val"]
    env = (scenes := study_scenes("val", args.scenes, seed=0))[0].make()
    same, films, outcomes = 0, [], []
    for number, scene in enumerate(scenes):
        sampled = sample_scene(env, scene)
        image, ground = sampled.observation["rgb"], AppearanceGrounder.from_info(sampled.info)
        goal = Goal.parse(sampled.texts[0])
        chosen = BeamPlanner(model, depth=1, candidates="scene", horizon=24).plan(image, goal, ground).instruction
        same += SearchPlanner(model, depth=1).plan(image, goal, ground).instruction == chosen
        if number < args.repeats:
            works = {"films": planning_work(model, "query", sampled), "outcomes": foresight(model, sampled)}
            seconds = race(works, 1, 0.0)
            films.append(seconds["films"][0])
            outcomes.append(seconds["outcomes"][0])
    ratios = np.quantile(np.divide(films, outcomes), [0.5, 0.25, 0.75])
    took = f"films {np.median(films):.3f} s, outcomes {np.median(outcomes):.3f} s"
    faster = f"{ratios[0]:.1f} times faster (quartiles {ratios[1]:.1f}, {ratios[2]:.1f})"
    print(f"{CANDIDATES} sentences, median of {len(films)}: {took}; {faster}")
    print(f"the same choice in {same} of {args.scenes} scenes ({same / args.scenes:.3f})")
    env = gym.make("RearrangeBlocks-v0", control="primitive")
    planned, steps = [], []
    for number in range(args.repeats):
        observation, info = env.reset(seed=val.seed(number), options={"family": "swap", "n_objects": 6})
        goal = Goal.parse(info["instruction"])
        plan = SearchPlanner(model).plan(observation["rgb"], goal, AppearanceGrounder.from_info(info))
        planned.append(plan.seconds)
        steps.append(len(plan.best.instructions))
    print(f"plans over 6 objects, sentences {sorted(steps)}: median {np.median(planned):.2f} s, longest "
          f"{max(planned):.2f} s")  # fmt: skip


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
