"""The closed loop: does a robot that plans in imagination reach the goal, judged by the simulator alone?"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean
from typing import Any, ClassVar

import numpy as np

from experiments.report.results import EpisodeLine
from experiments.study.methods import METHODS, Method
from experiments.study.pool import Worker
from experiments.study.scenes import SampledScene, StudyScene, place_of, play_expert, sample_scene, scene_hash
from planning import (
    AppearanceGrounder,
    Controller,
    EpisodeResult,
    Goal,
    LiteralController,
    PinholeCamera,
    SegmentationGrounder,
    run_episode,
)
from textocvp.protocols import LoadModel


@dataclass(frozen=True)
class LoopOutcome:
    """What came of one episode."""

    episode: LoopEpisode  # which one; or another study's, with `who` and `place`
    text: str  # the goal
    success: bool  # the simulator's verdict
    gained: float  # by how much the share of the goal that holds rose, by the simulator
    believes_reached: bool | None  # the planner's own verdict; None for the expert
    instructions: tuple[str, ...]  # what was carried out, in order
    # whether the candidate that scored best is the one that the goal names; None for goals of several steps
    # and for methods that do not rank
    ranked_first: bool | None = None
    planning_seconds: float | None = None  # mean time of a plan; None without one
    error: str | None = None  # why the loop gave up, or None

    @classmethod
    def of(cls, episode: LoopEpisode, text: str, result: EpisodeResult, first: bool | None = None) -> LoopOutcome:
        """What came of an episode in which a planner acted."""
        return cls(
            episode=episode,
            text=text,
            success=result.success,
            gained=round(result.gained, 6),
            believes_reached=result.believes_reached,
            instructions=tuple(attempt.instruction.text for attempt in result.attempts),
            ranked_first=first,
            planning_seconds=result.planning_seconds if result.attempts else None,
            error=result.error,
        )

    @property
    def steps(self) -> int:
        """Pick-and-places carried out."""
        return len(self.instructions)

    @property
    def lines(self) -> list[EpisodeLine]:
        """For `results.json`."""
        of, scene = self.episode, self.episode.scene
        what = of.who, of.place, "closed_loop_success", scene_hash(scene), scene.seed
        return [EpisodeLine(*what, self.text, float(self.success), self.instructions, self.error)]


@dataclass(frozen=True)
class LoopEpisode:
    """A unit of work: one method, one scene, one goal."""

    methods: ClassVar[Mapping[str, Method]] = METHODS  # who can act, by key
    method: str  # key of who acts
    scene: StudyScene  # where
    variant: int = 0  # 0 for the scene's own instruction, i for its i-th variant with another target bowl
    variants: int = 0  # how many variants there are
    seed: int = 0  # of the slots and of chance
    load: LoadModel | None = None  # makes the world model that is planned with; by default the study's own

    @property
    def acts(self) -> Method:
        """Who acts."""
        return self.methods[self.method]

    @property
    def who(self) -> str:
        """`method` of its line in `results.json`."""
        return self.method if self.load is None else f"{self.method}, {self.load}"

    @property
    def place(self) -> str:
        """`place` of its line."""
        return place_of(self.scene, self.variant)

    def order(self, goal: Goal) -> tuple[str, ...]:
        """What the expert does, in order."""
        return tuple(instruction.text for instruction in goal.instructions)

    def run(self, worker: Worker) -> LoopOutcome:
        """Play the episode."""
        env = worker.environment(self.scene)
        sampled = sample_scene(env, self.scene, self.variants)
        text = sampled.texts[self.variant]
        goal = Goal.parse(text)
        if self.acts.expert:
            order = self.order(goal)
            played = play_expert(env, sampled, self.variant, order)
            return LoopOutcome(self, text, played.success, played.gained, None, order)
        result = self.pursue(worker, sampled)
        ranks = self.acts.kind != "control" and len(goal.instructions) == 1
        first = [attempt.plan.best.instructions for attempt in result.attempts[:1]]
        return LoopOutcome.of(self, text, result, first == [goal.instructions] if ranks else None)

    def pursue(self, worker: Worker, sampled: SampledScene) -> EpisodeResult:
        """Plan and act until the goal is believed to be reached, or the attempts are used up."""
        goal, method = Goal.parse(sampled.texts[self.variant]), self.acts
        world_model = worker.model(self.load)
        # Seeded by scene and variant too: one stream for all episodes would depend on their order.
        rng = np.random.default_rng([self.seed, self.scene.seed, self.variant or method.chance])
        assert method.plan is not None
        controller: Callable[[PinholeCamera], Controller | LiteralController] = method.controller
        if controller is Controller and getattr(world_model, "foresees", False):
            controller = partial(Controller, outcome=world_model.outcome)
        return run_episode(
            worker.environment(self.scene),
            method.plan(world_model, goal, rng, self.seed),
            goal,
            seed=self.scene.seed,
            options=sampled.options(self.variant),
            controller=controller,
            ground=(SegmentationGrounder if method.privileged else AppearanceGrounder).from_info,
            replan=method.replan,
        )


def planning_seconds(outcomes: Sequence[LoopOutcome], column_of: Callable[[Any], str]) -> dict[str, dict[str, float]]:
    """Mean seconds of a plan, method -> column -> seconds."""
    seconds: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for o in outcomes:
        if o.planning_seconds is not None:
            seconds[o.episode.method][column_of(o.episode)].append(o.planning_seconds)
    return {method: {title: round(fmean(its), 3) for title, its in table.items()} for method, table in seconds.items()}


def timings(outcomes: Sequence[LoopOutcome], column_of: Callable[[Any], str]) -> dict[str, str]:
    """The file with `planning_seconds`, which is not `results.json`: that must come out the same again."""
    return {"timings.json": json.dumps(planning_seconds(outcomes, column_of), indent=2) + "\n"}
