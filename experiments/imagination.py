"""Imagination: does it help a robot to foresee what a sentence leads to, where that is not what the sentence says?

    python experiments/imagination.py              # default: about 25 minutes on 2 cores
    python experiments/imagination.py --quick      # a first look
    python experiments/imagination.py --retrained runs/outcome-1/checkpoint --retrained runs/outcome-2/checkpoint
    python experiments/imagination.py --scene cliport --scenes 10   # on CLIPort's table, 10 scenes of each family

Goals in `RearrangeBlocks-v0`: blocks in bowls that are taken, blocks that carry another, blocks that are to change
places, towers, and pictures of other arrangements. Ours searches sequences of sentences, and asks the world model where
each leads. Beside it: the goal's own sentences without any imagination; the same search by a robot that believes every
sentence; any sentence at random; and a search in the simulator itself. The simulator alone judges, strictly: what
carries what, everything at rest, the gripper back home. `--retrained` measures checkpoints of other training seeds in
the same scenes. `--scene cliport` asks all this on CLIPort's table, seen by its camera; a model that foresees no
outcome in one step then foresees by whole films. Writes `results.json`, `timings.json`, `report.html`, plots and clips
into `--out`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import attrgetter
from pathlib import Path
from statistics import fmean
from time import perf_counter
from typing import Any, Literal, cast

import gymnasium as gym
import numpy as np
import tyro

from envs import Expert
from envs.scenes import SCENES
from envs.splits import SPLITS
from envs.tabletop import TabletopEnv
from envs.tasks.rearrange import FAMILIES
from experiments.report.gif import gif
from experiments.report.page import CardSpec, Clip, Clips, Section
from experiments.report.plots import plot_table
from experiments.report.results import Results
from experiments.report.rows import Key, Row, by_key, mean_row, rate_row
from experiments.report.tables import Column, Line, TableSpec, columns
from experiments.study.clips import tone
from experiments.study.closed_loop import LoopEpisode, LoopOutcome, timings
from experiments.study.foresight import (
    BUDGETS,
    CASES,
    CURVE,
    LINES,
    OURS,
    SENTENCES,
    ByFilms,
    Foresight,
    Searcher,
    foresight,
)
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import to_uint8
from experiments.study.run import Found, Part, Run, ScenesArgs, Study, StudyArgs, UsageError, start
from experiments.study.scenes import SCENES_PER_SEED, StudyScene
from planning import (
    AnyGoal,
    AppearanceGrounder,
    EpisodeResult,
    Goal,
    LiteralController,
    PictureGoal,
    SegmentationGrounder,
    observe,
    places,
    run_episode,
)
from planning.planners import HORIZON, frames_ahead
from textocvp.checkpoint import WEIGHTS_FILE
from textocvp.protocols import LoadCheckpoint

FIRST, APART = 5_000, 500  # seeds of the test split that no other study uses: so many for each family
OUTCOMES = "outcomes"  # the part of sentences whose ends are foreseen
FIRST_OUTCOME = 8_500
ATTEMPTS = {"plain": 2, "occupied": 3, "covered": 3, "swap": 4, "tower": 3, "picture": 5}
"""Pick-and-places at most: one more than the goals of the family need at least (of a picture: at most)."""
SUCCESS, RIGHT = "closed_loop_success", "outcome_right"
TIMED, TIMES = 30, 15  # so many sentences, so often
SIDE, CLOSE_SIDE = 336, 64  # pixels of a side of the pictures: of scenes `cliport`, and `simple`
CURVE_FAMILIES = ("swap", "picture")  # whose search is also measured with smaller budgets
SEEDS = "ours, over training seeds"


@dataclass
class Args(ScenesArgs):
    """Arguments of this study."""

    scene: Literal["simple", "cliport"] = "simple"
    """Of the environments. With `cliport` checkpoint and folder are by default `cliport` and imagination-cliport."""
    retrained: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Folder of a checkpoint of another training seed, to measure beside the first."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scene == "cliport" and self.checkpoint == StudyArgs.checkpoint:
            self.checkpoint = "cliport"
        for name in self.retrained:
            if not (Path(name) / WEIGHTS_FILE).is_file():
                raise UsageError(f"--retrained must be the folder of a checkpoint, and {name} has no {WEIGHTS_FILE}")

    @property
    def others(self) -> dict[str, LoadCheckpoint]:
        """The checkpoints of other training seeds: key of the line -> makes the model."""
        return {f"retrained {i}": LoadCheckpoint(name) for i, name in enumerate(self.retrained, 1)}

    def folder(self, study: str) -> Path:
        """See `StudyArgs.folder`; each scene has its own."""
        return super().folder(study if self.scene == "simple" else f"{study}-{self.scene}")


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: int  # of each family
    outcomes: int  # scenes in which sentences are foreseen
    clips: int  # episodes that are shown

    @classmethod
    def of(cls, args: Args) -> Sizes:
        """How much a command line asks for: `--scenes` of each family, and as many again to foresee sentences in."""
        base = cls(4, 12, 4) if args.quick else cls(60, 100, 12)
        return replace(base, scenes=args.scenes, outcomes=args.scenes) if args.scenes else base


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Episode(LoopEpisode):
    """A unit of work: one searcher, one scene."""

    @property
    def who(self) -> str:
        """The line; each training seed has its own."""
        return self.method

    @property
    def place(self) -> str:
        """The family of the scene."""
        return str(dict(self.scene.options)["family"])

    @property
    def searcher(self) -> Searcher:
        """Who acts."""
        return {**LINES, **CURVE}[self.method if self.load is None else OURS]

    def run(self, worker: Worker) -> LoopOutcome:
        """Play it."""
        env = worker.environment(self.scene, record=False)
        observation, info = env.reset(seed=self.scene.seed, options=dict(self.scene.options))
        goal = info["instruction"]
        if self.searcher.plan is None:
            said, expert, base = [], Expert(env), cast(TabletopEnv, env.unwrapped)
            for pair in expert.search()[: ATTEMPTS[self.place]]:
                said.append(base.task.scene(base.scene.objects, (pair,)).instruction)
                info = env.step(expert.primitive(pair))[4]
            return LoopOutcome(self, goal, bool(info["is_success"]), 0.0, None, tuple(said))
        result = self.search(worker, env, goal_of(observation, info))
        return LoopOutcome.of(self, goal, result)

    def search(self, worker: Worker, env: gym.Env[Any, Any], goal: AnyGoal) -> EpisodeResult:
        """Plan and act; see `run_episode`."""
        searcher = self.searcher
        assert searcher.plan is not None
        model = worker.model(self.load)
        return run_episode(
            env,
            searcher.plan(foresight(model), self.scene.seed),
            goal,
            ground=(SegmentationGrounder if searcher.privileged else AppearanceGrounder).from_info,
            controller=LiteralController,
            seed=self.scene.seed,
            options=dict(self.scene.options),
            max_actions=ATTEMPTS[self.place],
        )


def goal_of(observation: Mapping[str, Any], info: Mapping[str, Any]) -> AnyGoal:
    """What the environment asks for."""
    if observation["goal_rgb"].any():
        return PictureGoal(observation["goal_rgb"])
    return Goal.parse(info["instruction"])


@dataclass(frozen=True)
class ConsequenceClip:
    """A unit of work: the film of the obvious sentence as imagined, beside what ours does and what the camera sees."""

    played: LoopOutcome
    rank: int

    def run(self, worker: Worker) -> Clip:
        """Play it once more, and imagine both films."""
        episode = cast(Episode, self.played.episode)
        env = worker.environment(episode.scene)
        observation, info = env.reset(seed=episode.scene.seed, options=dict(episode.scene.options))
        goal, model = goal_of(observation, info), worker.world_model
        horizon = frames_ahead(model)
        if episode.scene.look == "simple":  # in others the arm takes longer
            horizon = min(HORIZON, horizon)
        if said_at_once := isinstance(goal, Goal):
            first = to_uint8(model.rollout(observation["rgb"], goal.instructions[0].text, horizon=horizon).frames[0])
        else:
            first = goal.rgb[None]
        result = episode.search(worker, env, goal)
        taken = [model.rollout(one.rgb, one.instruction.text, horizon=horizon) for one in result.attempts]
        films = [
            first,
            np.concatenate([to_uint8(one.frames[0]) for one in taken] or [result.frames[:1]]),
            result.frames,
        ]
        said = "; ".join(text.removeprefix("put ") for text in self.played.instructions) or "nothing"
        scale = 2 if episode.scene.image_size == CLOSE_SIDE else 1
        return Clip(
            name=f"imagination-{self.rank}.gif",
            gif=gif([[film[::2] for film in films]], seconds_a_frame=0.2, scale=scale),
            panels=("the goal, said at once" if said_at_once else "the goal", "the plan", "what happened"),
            title=self.played.text,
            caption=f"{episode.place}, seed {episode.scene.seed}; said: {said}",
            badge="success" if result.success else "failure",
            tone=tone(result.success),
        )


def family_scene(family: str, number: int, look: str = "simple", side: int = CLOSE_SIDE) -> StudyScene:
    """A scene of a family, from the seeds of the test split, seen in pictures of so many pixels a side."""
    split = SPLITS["test"]
    options = (("color_split", "seen"), ("family", family), ("n_objects", 6))
    return StudyScene("test", split.seed(number), options, 1, look, side, "RearrangeBlocks-v0")


def ground_of(run: Run) -> tuple[str, int]:
    """What the scenes look like, and the pixels of a side of the pictures: such as the model takes."""
    look, own = cast(Args, run.args).scene, run.world_model.image_size[0]
    if look == "simple":
        return look, CLOSE_SIDE
    return look, SIDE if SIDE % own == 0 else own


def units(run: Run) -> dict[str, Part]:
    """Every episode, family by family, and the sentences that are foreseen."""
    parts, seed, ground = {}, run.args.seed, ground_of(run)
    others = cast(Args, run.args).others
    for place, family in enumerate(FAMILIES):
        first = SCENES_PER_SEED * seed + FIRST + APART * place
        scenes = [family_scene(family, first + i, *ground) for i in range(run.sizes.scenes)]
        asked = [*LINES.values(), *(CURVE.values() if family in CURVE_FAMILIES else ())]
        keys = [one.key for one in asked if one.pictures or family != "picture"] + [*others]
        episodes = [Episode(key, scene, seed=seed, load=others.get(key)) for scene in scenes for key in keys]
        parts[family] = Part(episodes, 0.7)
    first, names = SCENES_PER_SEED * seed + FIRST_OUTCOME, list(FAMILIES)
    scenes = [family_scene(names[i % len(names)], first + i, *ground) for i in range(run.sizes.outcomes)]
    foreseen = [Foresight(scene, seed, key, others.get(key)) for scene in scenes for key in (OURS, *others)]
    parts[OUTCOMES] = Part(foreseen, 0.6)
    return {**parts, "clips": Part(seconds=2.0, count=run.sizes.clips)}


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """Of each family in turn, ours: first a failure, then a success."""
    ours = [[one for one in found[family] if one.episode.method == OURS] for family in FAMILIES]
    chosen = [sorted(its, key=lambda one: one.success)[:1] for its in ours]
    chosen += [sorted(its, key=lambda one: -one.success)[:1] for its in ours]
    unique = dict.fromkeys(one for its in chosen for one in its)
    return {"clips": [ConsequenceClip(one, rank) for rank, one in enumerate(unique, 1)][: run.sizes.clips]}


# --- rows -------------------------------------------------------------------------------------------------------------


def rows(run: Run, found: Found) -> list[Row]:
    """Success and sentences of every line and family; how often the end of a sentence was foreseen."""
    made, others = [], cast(Args, run.args).others
    for family, key in product(FAMILIES, [*LINES, *CURVE, *others]):
        here = [one for one in found[family] if one.episode.method == key]
        if not here:
            continue
        made.append(rate_row(key, "test", family, SUCCESS, [one.success for one in here]))
        made.append(mean_row(key, "test", family, "sentences", [one.steps for one in here]))
        if key not in ("simulator", "random"):
            beliefs = [one.believes_reached != one.success for one in here]
            made.append(rate_row(key, "test", family, "wrong_belief", beliefs))
        if key == OURS and family in CURVE_FAMILIES:
            made.append(rate_row(f"budget {BUDGETS[-1]}", "test", family, SUCCESS, [one.success for one in here]))
    for case, key in product(CASES, (OURS, *others)):
        scenes = [one.right[case] for one in found[OUTCOMES] if one.method == key and one.right[case]]
        if scenes:
            made.append(rate_row(key, "test", case, RIGHT, [float(np.mean(its)) for its in scenes]))
    known = by_key(made)
    for place in [(family, SUCCESS) for family in FAMILIES] + [(case, RIGHT) for case in CASES]:
        rates = [known[it].value for one in (OURS, *others) if (it := (one, "test", *place)) in known]
        if others and len(rates) == 1 + len(others):
            # Not an interval of scenes: the lowest and the highest seed.
            made.append(Row(SEEDS, "test", *place, fmean(rates), min(rates), max(rates), len(rates)))
    return [*made, mean_row(OURS, "test", f"{TIMED} sentences", "milliseconds", run.prepared)]


def milliseconds(run: Run) -> list[float]:
    """How long it takes to foresee where sentences lead, and to read the places of all things off the ends.

    UsageError if a model of the scene `simple` cannot do it.
    """
    (look, side), model = ground_of(run), foresight(run.world_model)
    if isinstance(model, ByFilms):
        problem = f"{run.args.checkpoint} cannot foresee outcomes in one step"
        if look == "simple":
            raise UsageError(f"{problem}, which this study is about")
        run.remarks.append(f"{problem}: it foresees by whole films.")
    run.remarks += [f"Careful: {missing}."] if (missing := SCENES[look].missing) else []
    run.remarks.append(f"Scenes {look}, {side}x{side} pixels.")
    scene = family_scene("plain", FIRST, look, side)
    env = scene.make(record=False)
    observation, info = env.reset(seed=scene.seed, options=dict(scene.options))
    goal, grounder = goal_of(observation, info), AppearanceGrounder.from_info(info)
    parsed, grounding = observe(model, observation["rgb"], goal, grounder)
    sentences = [one.text for one in grounding.instructions()]
    said = (sentences * TIMED)[:TIMED]
    taken = []
    for _ in range(TIMES + 1):
        began = perf_counter()
        places(model.outcome(parsed, said), grounding, sorted(grounding.things))
        taken.append(1000 * (perf_counter() - began))
    env.close()
    return taken[1:]  # the first warms up


HEADLINE: dict[str, Key] = {
    f"{family}{'' if key == OURS else '_' + key.replace(' ', '_')}": (key, "test", family, SUCCESS)
    for family in FAMILIES
    for key in (OURS, "no imagination", "believes", "random", "simulator")
    if (key, family) != ("no imagination", "picture")
}
HEADLINE |= {f"outcome_{case}": (OURS, "test", case, RIGHT) for case in CASES[:3]}
HEADLINE["milliseconds_30_sentences"] = OURS, "test", f"{TIMED} sentences", "milliseconds"


# --- tables and page --------------------------------------------------------------------------------------------------

COLUMNS = {family: ("test", family) for family in FAMILIES}
GOALS = TableSpec("Goal reached", columns(SUCCESS, COLUMNS), [*LINES.values()])
ENDS = TableSpec(
    "The end of a sentence foreseen",
    [Column(case, "test", case, RIGHT) for case in CASES],
    [Line(key=OURS, note="every block carried by what it was foreseen to be carried by")],
)
DETAILS = TableSpec(
    "Sentences and beliefs",
    columns("", COLUMNS),
    [
        Line(key=key, kind=LINES[key].kind, metric=metric, label=f"{label}, {key}", digits=digits)
        for key, (metric, label, digits) in product(
            (OURS, "believes"), (("sentences", "sentences", 1), ("wrong_belief", "wrong belief", 2))
        )
    ],
)
OVER_SEEDS = [
    TableSpec(f"{spec.title}, over training seeds", spec.columns, [Line(key=SEEDS, note="mean, lowest, highest")])
    for spec in (GOALS, ENDS)
]
BUDGET = TableSpec(
    "Goal reached, by budget",
    columns(SUCCESS, {family: COLUMNS[family] for family in CURVE_FAMILIES}),
    [Line(key=f"budget {budget}", label=f"{budget} sentences") for budget in BUDGETS],
)


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures, (look, side) = list(results.rows), ground_of(run)
    goals, ends = (replace(one, title=f"{one.title}, scenes {look}") for one in (GOALS, ENDS))
    other_seeds = Section(
        "Other training seeds",
        "Beside the model above others of the same recipe, whose predictors were trained with other seeds.",
        [spec.table(figures) for spec in OVER_SEEDS],
    )
    return [
        Section(
            "Goals that need foresight",
            f"Scenes {look}, {side}x{side} pixels. {' '.join(run.remarks[:-1])} "
            "In plain scenes the sentence names the answer. In the others it does not: a block put into a taken bowl "
            "comes to rest on the block in it, and who picks a block that carries another takes that one. Every "
            "line may act once more than the fewest sentences demand, looks again after each action, and acts "
            "alike: it picks where the named block is seen and lets go over where the target is seen.",
            [goals.table(figures), plot_table("success.png", goals, figures, label="goal reached")],
        ),
        Section(
            "What was foreseen",
            f"{SENTENCES} random sentences in a row in scenes of all families. Plain: nothing on the block, nothing at "
            "its target. Occupied: something is at the target. Covered: something is on the block.",
            [ends.table(figures), DETAILS.table(figures)],
        ),
        *([other_seeds] if cast(Args, run.args).retrained else []),
        Section(
            "How much search it takes",
            "The same planner, with fewer sentences to imagine for each plan.",
            [BUDGET.table(figures)],
        ),
        Section(
            "The obvious sentence, the plan, and the camera",
            "Left: the goal's first sentence as the model imagines it, or the goal's picture. Middle: the sentences of "
            "the plan, imagined one after another. Right: the camera.",
            [Clips(found["clips"])] if found["clips"] else [],
        ),
    ]


STUDY = Study(
    name="imagination",
    args=Args,
    prepare=milliseconds,
    inputs=lambda args: [Path(name) / WEIGHTS_FILE for name in args.retrained],
    again="The same seed gives the same figures, but for the milliseconds.",
    title="Imagination",
    question="Does it help to foresee what a sentence leads to, where that is not what the sentence says?",
    sizes=Sizes.of,
    units=units,
    cases=cases,
    rows=rows,
    tables=(GOALS, ENDS, BUDGET),
    page=page,
    cards=[
        CardSpec(label, LINES[key], Column("", "test", family, SUCCESS), text)
        for label, key, family, text in (
            ("Bowl taken", OURS, "occupied", "bar 0.90"),
            ("Bowl taken, no imagination", "no imagination", "occupied", "the floor"),
            ("Block covered", OURS, "covered", "bar 0.90"),
            ("Block covered, believes", "believes", "covered", "the floor"),
            ("Two blocks change bowls", OURS, "swap", "bar 0.80"),
            ("As in the picture", OURS, "picture", "bar 0.75"),
        )
    ],
    headline=HEADLINE,
    first=("plain", "occupied", "covered", "swap", "tower", "picture"),
    files=lambda run, found: timings([one for family in FAMILIES for one in found[family]], attrgetter("place")),
)

if __name__ == "__main__":
    start(STUDY)
