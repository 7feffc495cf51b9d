"""Controllability: does the imagined scene obey the sentence, and does a robot that trusts it reach the goal?

    python experiments/controllability.py              # default: under 6 minutes on 2 cores
    python experiments/controllability.py --quick      # a first look
    python experiments/controllability.py --full       # 100 scenes x 4 instructions x 5 slot seeds

The predicted study is the paper's (section 4.4): the original instruction of a scene and three variants that
name another target bowl are imagined and judged on the imagined masks. The closed loop goes beyond the paper:
a planner imagines every instruction that the scene allows, picks the one whose imagined end fits the goal
best, its motion is carried out in PyBullet, and the simulator alone judges. Writes `results.json`,
`timings.json`, `report.html`, plots and clips into `--out`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from experiments.report.page import CardSpec, Clips, Figure, Section
from experiments.report.plots import curve_plot, plot_table
from experiments.report.results import EpisodeLine, Results
from experiments.report.rows import Row, figure_rows, mean_row, rate_row
from experiments.report.tables import Column, Line, TableSpec, columns
from experiments.study.clips import PredictionClip, episode_clips, extremes_by_scene
from experiments.study.closed_loop import LoopEpisode, LoopOutcome, planning_seconds, timings
from experiments.study.judge import Verdicts, find_things, first_frame, imagine_and_trace, judge, stack, trace
from experiments.study.methods import HORIZON, METHODS, PLANNERS, lines
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import hold_last
from experiments.study.run import Found, FullArgs, Part, Run, Study, start
from experiments.study.scenes import (
    LONG_GOALS,
    StudyScene,
    place_of,
    play_expert,
    sample_scene,
    scene_hash,
    study_scenes,
)
from planning import RELATIONS, THRESHOLDS, AppearanceGrounder, Instruction

VARIANTS = 3
SPLIT = "controllability"
PREDICTED = ("ours", "true frames", "wrong text", "copy frame")
PREDICTED_PLACES = {name: (SPLIT, name) for name in ("original", "variant 1", "variant 2", "variant 3")}
OTHER_SPLITS = {
    "unseen_colors": "unseen colours", "more_objects": "8 objects",
    "two_steps": "two steps", "three_steps": "three steps",
}  # fmt: skip
LOOP_PLACES = {**PREDICTED_PLACES, **{name: (split, name) for split, name in OTHER_SPLITS.items()}}
"""Columns of the closed loop: title -> (split, variant)."""
FARTHEST = 64  # pixels along a side of the frame


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes."""

    predicted: int  # of the predicted study
    slot_seeds: int  # slot-sampling seeds of each of them
    loop: int  # of each column of the closed loop with the controllability scenes, for ours and the expert
    other: int  # of each other column with goals of one step
    long: int  # of each column with longer goals
    controls: int  # at most this many in any column for every other method
    clips: int  # how many best and how many worst cases the report shows

    def scenes(self, split: str, method: str) -> int:
        """How many scenes of a split a method plays."""
        most = self.long if split in LONG_GOALS else self.loop if split == SPLIT else self.other
        if method in ("ours", "expert"):
            return most
        return min(most, (self.controls + 1) // 2 if split in LONG_GOALS else self.controls)


QUICK = Sizes(predicted=12, slot_seeds=1, loop=8, other=4, long=1, controls=3, clips=3)
DEFAULT = Sizes(predicted=100, slot_seeds=1, loop=60, other=30, long=10, controls=20, clips=3)
FULL = Sizes(predicted=100, slot_seeds=5, loop=100, other=100, long=100, controls=100, clips=6)


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PredictedOutcome:
    """Everything that was judged in one scene."""

    scene: StudyScene  # which
    texts: tuple[str, ...]  # its V instructions, original first
    # method -> its verdicts. `wrong text` is judged for another instruction than it was imagined with; `copy
    # frame` is the first frame repeated; `true frames` is the parser on the expert's motion, S = 1.
    verdicts: Mapping[str, Verdicts]
    imagined_TV: np.ndarray  # block to bowl distance in pixels over time for the first slot seed
    true_TV: np.ndarray  # the same of the true frames

    @property
    def lines(self) -> list[EpisodeLine]:
        """For `results.json`."""
        scene, metric = self.scene, "predicted_success"
        return [
            EpisodeLine(method, place_of(scene, v), metric, scene_hash(scene), scene.seed, text, float(rate))
            for method, verdicts in self.verdicts.items()
            for v, (text, rate) in enumerate(zip(self.texts, verdicts.success_SV.mean(0), strict=True))
        ]


@dataclass(frozen=True)
class PredictedScene:
    """A unit of work: one scene, its original instruction and its variants, several slot-sampling seeds."""

    scene: StudyScene
    variants: int
    slot_seeds: tuple[int, ...]

    def run(self, worker: Worker) -> PredictedOutcome:
        """Imagine, judge, and judge the controls."""
        env = worker.environment(self.scene)
        sampled = sample_scene(env, self.scene, self.variants)
        texts, ground = list(sampled.texts), AppearanceGrounder.from_info(sampled.info)
        instructions = [Instruction.parse(text) for text in texts]
        judged: dict[str, list] = {"ours": [], "wrong text": [], "copy frame": []}
        imagined = []
        for seed in self.slot_seeds:
            _, ours, wrong = imagine_and_trace(worker.world_model, sampled.observation["rgb"], ground, texts, seed)
            imagined.append(ours)
            for method, traced in (("ours", ours), ("wrong text", wrong), ("copy frame", first_frame(ours))):
                judged[method].append(judge(traced))
        true = []
        for variant, instruction in enumerate(instructions):
            played = play_expert(env, sampled, variant)
            parsed = worker.world_model.parse(played.frames, seed=self.slot_seeds[0])
            true.append(trace(parsed, find_things(parsed, ground, [instruction]), [instruction]))
        judged["true frames"] = [[torch.cat(column) for column in zip(*map(judge, true), strict=True)]]
        return PredictedOutcome(
            scene=self.scene,
            texts=tuple(texts),
            verdicts={method: stack(parts) for method, parts in judged.items()},
            imagined_TV=imagined[0].distance_Bt.T.numpy(),
            # An episode that is over sooner ends in a block that lies still.
            true_TV=np.stack([hold_last(one.distance_Bt[0].numpy(), HORIZON + 1) for one in true], axis=1),
        )


def units(run: Run) -> dict[str, Part]:
    """The scenes of the predicted study; every episode of the closed loop, column by column."""
    sizes, seed = run.sizes, run.args.seed
    slot_seeds = tuple(range(seed, seed + sizes.slot_seeds))
    scenes = study_scenes(SPLIT, sizes.predicted, seed)
    episodes = []
    for number, (split, _) in enumerate(LOOP_PLACES.values()):
        variant, variants = (number, VARIANTS) if split == SPLIT else (0, 0)
        for i, scene in enumerate(study_scenes(split, sizes.scenes(split, "ours"), seed)):
            for method in PLANNERS:
                if i < sizes.scenes(split, method):
                    episodes.append(LoopEpisode(method, scene, variant, variants, seed))
    return {
        "predicted study": Part([PredictedScene(scene, VARIANTS, slot_seeds) for scene in scenes], 0.8),
        "closed loop": Part([one for one in episodes if one.scene.steps == 1], 0.25),
        "long goals": Part([one for one in episodes if one.scene.steps > 1], 0.9),
        "pictures": Part(seconds=0.5, count=4 * sizes.clips),
    }


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """Pictures of the best and worst predicted cases and of the closed loop."""
    count, seed = run.sizes.clips, run.args.seed
    predicted = predicted_clips(found["predicted study"], seed, count)
    return {"pictures": [*predicted, *episode_clips(_loop(found), column_of, count)]}


def predicted_clips(outcomes: Sequence[PredictedOutcome], seed: int, count: int) -> list[PredictionClip]:
    """The `count` best and `count` worst cases of the first slot seed, each of another scene."""
    clips, badness = [], []
    for outcome in outcomes:
        ours = outcome.verdicts["ours"]
        pairs = zip(ours.success_SV[0].tolist(), ours.miss_SV[0].tolist(), strict=True)
        for v, (success, miss) in enumerate(pairs):
            ends = f"block ends {miss:.1f} px from the bowl's centre" if np.isfinite(miss) else "not found"
            caption = f"{'original' if v == 0 else f'variant {v}'}; {ends}"
            clips.append(PredictionClip(outcome.scene, (), seed, "predicted", caption, success, v, VARIANTS))
            badness.append((not success, miss))
    return extremes_by_scene(clips, badness, count)


# --- rows -------------------------------------------------------------------------------------------------------------


def rows(run: Run, found: Found) -> list[Row]:
    """Every figure, as far as there are outcomes."""
    predicted = ((SPLIT, predicted_figures(one)) for one in found["predicted study"])
    return [*figure_rows(predicted), *loop_rows(_loop(found))]


def predicted_figures(outcome: PredictedOutcome) -> dict[tuple[str, str, str], np.ndarray]:
    """Success of each method: original, each variant, the mean of the variants, and all together."""
    places = {name: slice(v, v + 1) for v, name in enumerate(PREDICTED_PLACES)}
    places |= {"variants mean": slice(1, None), "all": slice(None)}
    return {
        (method, place, "predicted_success"): outcome.verdicts[method].success_SV[:, some]
        for method in PREDICTED
        for place, some in places.items()
    }


def loop_rows(outcomes: Sequence[LoopOutcome]) -> list[Row]:
    """Success, steps and ranking of each method in each column, and pooled over the controllability scenes."""
    figures = []
    for method in PLANNERS:
        mine = [outcome for outcome in outcomes if outcome.episode.method == method]
        for title, (split, variant) in LOOP_PLACES.items():
            place, here = (method, split, variant), [o for o in mine if column_of(o.episode) == title]
            if here:
                figures.append(rate_row(*place, "closed_loop_success", [o.success for o in here]))
                figures.append(mean_row(*place, "steps", [o.steps for o in here]))
                figures += _ranking(place, [[o] for o in here])
        by_scene: dict[int, list[LoopOutcome]] = {}
        for outcome in mine:
            if outcome.episode.scene.split == SPLIT:
                by_scene.setdefault(outcome.episode.scene.seed, []).append(outcome)
        if scenes := [scene for scene in by_scene.values() if len(scene) == VARIANTS + 1]:
            variants = [[o.success for o in scene if o.episode.variant > 0] for scene in scenes]
            figures.append(rate_row(method, SPLIT, "variants mean", "closed_loop_success", variants))
            figures += _ranking((method, SPLIT, "all"), scenes)
    return figures


def _ranking(place: tuple[str, str, str], scenes: Sequence[Sequence[LoopOutcome]]) -> list[Row]:
    """How often the candidate that was asked for came first; nothing for a method that does not rank."""
    ranked = [[o.ranked_first for o in scene] for scene in scenes]
    known = all(one is not None for scene in ranked for one in scene)
    return [rate_row(*place, "candidate_ranking", ranked)] if known else []


def _loop(found: Found) -> list[LoopOutcome]:
    return [*found["closed loop"], *found["long goals"]]


def column_of(episode: LoopEpisode) -> str:
    """Title of its column."""
    split = episode.scene.split
    return list(PREDICTED_PLACES)[episode.variant] if split == SPLIT else OTHER_SPLITS[split]


# --- tables and page --------------------------------------------------------------------------------------------------

PREDICTED_TABLE = TableSpec(
    "Predicted success",
    columns("predicted_success", {**PREDICTED_PLACES, "variants mean": (SPLIT, "variants mean")}),
    lines(
        PREDICTED,
        {
            "ours": "imagined with the sentence, judged on the imagined masks",
            "true frames": "the parser on the simulator's frames: the ceiling",
            "wrong text": "imagined with another sentence, judged for this one: must be near 0",
            "copy frame": "the first frame repeated: must be near 0",
        },
    ),
)
LOOP_TABLE = TableSpec(
    "Closed-loop success",
    columns("closed_loop_success", LOOP_PLACES),
    lines(
        PLANNERS,
        {
            "ours": "imagine every instruction, score, act, look, replan; nothing from the simulator's state",
            "random candidate": "the same loop with a random instruction instead of the best-scored one",
        },
    ),
)
DETAILS_TABLE = TableSpec(
    "Ranking, steps and planning time",
    columns("", LOOP_PLACES),
    [
        Line(key="ours", metric="candidate_ranking", label="candidate ranking, ours",
             note="the best-scored is the one that was asked for"),
        Line(key="ours, privileged", metric="candidate_ranking", label="candidate ranking, privileged",
             kind="ceiling"),
        Line(key="ours", metric="steps", digits=1, label="pick-and-places, ours", note="mean of all episodes"),
        Line(key="expert", metric="steps", digits=1, label="pick-and-places, expert", kind="ceiling"),
        Line(key="random candidate", metric="steps", digits=1, label="pick-and-places, random", kind="control"),
        Line(key="ours", metric="seconds", label="seconds a plan, ours",
             note="parse, imagine all candidates, score; one core, not in results.json"),
    ],
)  # fmt: skip


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    limits, figures = THRESHOLDS, list(results.rows)
    seconds = [
        Row("ours", *LOOP_PLACES[title], "seconds", value, value, value, 1)
        for title, value in planning_seconds(_loop(found), column_of).get("ours", {}).items()
    ]
    pictures = found["pictures"]
    imagined = [clip for clip in pictures if clip.name.startswith("predicted")]
    acted = [clip for clip in pictures if not clip.name.startswith("predicted")]
    return [
        Section(
            "Predicted: does the imagined scene obey the sentence?",
            "Each scene is imagined with its own instruction and with three that name another bowl. A rollout "
            f"counts when the arm stays within {limits.contact_px:g} px of the named block for "
            f"{limits.contact_frames} frames and the block ends within {RELATIONS['in'].within_px:g} px of the named "
            f"bowl's centre in the last {limits.settle_frames} frames, all read off the masks. The thresholds "
            "were calibrated on the simulator's masks, never on predictions.",
            [
                PREDICTED_TABLE.table(figures),
                plot_table("predicted.png", PREDICTED_TABLE, figures, label="predicted success"),
                _distance_plot(found["predicted study"]),
            ],
        ),
        Section(
            "Imagined beside real",
            "The best cases and the worst ones by where the block ends. Below the pictures: the slots' masks "
            "beside the simulator's segmentation, one colour a thing.",
            [Clips(imagined)],
        ),
        Section(
            "Closed loop: does a robot that trusts it reach the goal?",
            "The planner sees a picture and a goal, imagines the candidates, and the best one's masks become a "
            "pick-and-place. PyBullet executes it and the simulator alone judges. Afterwards the planner looks "
            "again and replans while it does not see the goal reached, up to three times for each block.",
            [
                LOOP_TABLE.table(figures),
                plot_table("closed_loop.png", LOOP_TABLE, figures, label="closed-loop success",
                           caption="Dots with 95 % intervals over scenes, judged by the simulator."),
                DETAILS_TABLE.table([*figures, *seconds]),
            ],
        ),
        Section(
            "Planned beside executed",
            "Long goals, and failures where there are any. Left: each chosen plan, imagined. Right: the camera.",
            [Clips(acted)],
        ),
    ]  # fmt: skip


def _distance_plot(outcomes: Sequence[PredictedOutcome]) -> Figure:
    curves = []
    for title, name in (("imagined", "imagined_TV"), ("true frames", "true_TV")):
        # Without the observed frame.
        distances = np.stack([column[1:] for outcome in outcomes for column in getattr(outcome, name).T])
        distances[~np.isfinite(distances)] = FARTHEST  # what cannot be seen is farther off than what can
        low, middle, high = np.quantile(distances, (0.1, 0.5, 0.9), axis=0)
        curves.append((title, np.stack([middle, low, high], axis=1)))
    caption = (
        "Distance of the named block to the named bowl: median, and the middle 80 % of all cases. One that "
        f"cannot be seen counts as {FARTHEST} px."
    )
    marks = [(RELATIONS["in"].within_px, "counts as in the bowl")]
    label = "block to bowl, px"
    return curve_plot("distance.png", curves, label=label, across="frame", caption=caption, marks=marks)


HEADLINE = {
    "predicted_original": ("ours", SPLIT, "original", "predicted_success"),
    "predicted_variants_mean": ("ours", SPLIT, "variants mean", "predicted_success"),
    "wrong_text": ("wrong text", SPLIT, "all", "predicted_success"),
    "copy_frame": ("copy frame", SPLIT, "all", "predicted_success"),
    "true_frames": ("true frames", SPLIT, "all", "predicted_success"),
    "closed_loop_original": ("ours", SPLIT, "original", "closed_loop_success"),
    "closed_loop_variants_mean": ("ours", SPLIT, "variants mean", "closed_loop_success"),
    "closed_loop_random": ("random candidate", SPLIT, "original", "closed_loop_success"),
    "candidate_ranking": ("ours", SPLIT, "all", "candidate_ranking"),
}
STUDY = Study(
    name="controllability",
    title="Controllability",
    question="Change the sentence and nothing else: does the world model imagine what it says, and can a robot that "
    "plans with it do it?",
    args=FullArgs,
    sizes=lambda args: QUICK if args.quick else FULL if args.full else DEFAULT,
    horizon=HORIZON,
    methods=(*PREDICTED, *PLANNERS),
    units=units,
    cases=cases,
    rows=rows,
    tables=(PREDICTED_TABLE, LOOP_TABLE),
    page=page,
    cards=[
        CardSpec(label, METHODS[method], Column("", SPLIT, variant, metric), compare)
        for label, method, variant, metric, compare in (
            ("Predicted, original instruction", "ours", "original", "predicted_success", ""),
            ("Predicted, three other bowls", "ours", "variants mean", "predicted_success", ""),
            ("Closed loop, original instruction", "ours", "original", "closed_loop_success", "not in the paper"),
            ("Closed loop, three other bowls", "ours", "variants mean", "closed_loop_success", "not in the paper"),
            ("Best-scored candidate is the right one", "ours", "all", "candidate_ranking", "not in the paper"),
            ("True frames, parsed", "true frames", "all", "predicted_success", "the ceiling"),
            ("Wrong text", "wrong text", "all", "predicted_success", "should be near 0"),
            ("Closed loop, random candidate", "random candidate", "original", "closed_loop_success", "the floor"),
        )
    ],
    headline=HEADLINE,
    first=(
        "predicted_original", "predicted_variants_mean", "closed_loop_original", "closed_loop_variants_mean",
    ),
    files=lambda run, found: timings(_loop(found), column_of),
)  # fmt: skip

if __name__ == "__main__":
    start(STUDY)
