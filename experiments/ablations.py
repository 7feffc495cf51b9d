"""Ablations: what each choice of architecture is worth, every one trained from the same slots with as many updates.

    python experiments/train_ablations.py --data data/tabletop-train.h5 --val data/tabletop-val.h5   # trains the runs
    python experiments/ablations.py --runs runs/ablations              # default: about 15 minutes on 2 cores
    python experiments/ablations.py --runs runs/ablations --quick      # a first look

Depth, residual connection, text encoder, first slots and decoder, and the number of slots at test time, in the layout
of the paper's tables; and what a robot does that plans with each. `RUNS` lists the models: `train_ablations` trains
them, this study measures them, on scenes that no training has seen. A run that is not there is a row that says so and
names the command that trains it. Writes `results.json`, `report.html`, plots and clips into `--out`.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from experiments.report.page import CardSpec, Clips, Section
from experiments.report.results import Results
from experiments.report.rows import Key, Row, figure_rows
from experiments.report.tables import Column, Line, TableSpec
from experiments.study.ablation_runs import PARSERS, PREDICTORS, PRESETS, RUNS, find_run, load_run, runs_table
from experiments.study.clips import PredictionClip, extreme_clips
from experiments.study.closed_loop import LoopEpisode
from experiments.study.frame_metrics import METRICS, Measures, Scorer, available_measures
from experiments.study.judge import imagine_and_trace, judge
from experiments.study.mask_metrics import score_masks
from experiments.study.methods import HORIZON, Model, lines
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import Prediction, to_tensor
from experiments.study.run import Found, Part, Run, Study, StudyArgs, start
from experiments.study.scenes import StudyScene, play_expert, sample_scene, study_scenes
from planning import AppearanceGrounder
from textocvp.checkpoint import CONFIG_FILE, WEIGHTS_FILE
from textocvp.metrics import slot_labels
from textocvp.metrics.frames import psnr
from textocvp.protocols import LoadModel
from textocvp.training.evaluate_predictor import PIXEL, REACHED

# --- units of work ----------------------------------------------------------------------------------------------------

VARIANTS = 3
NEAR = REACHED / PIXEL  # pixels of 64
ENDS = f"ends_within_{NEAR:g}_px"  # the metric: the block's mask ends that near to the bowl's
LENGTH = 9  # frames that pictures are compared over: the paper's shorter length
PICTURES = f"{LENGTH} frames"
SHIPPED = "shipped"
SLOT_COUNTS = (8, 10, 12, 14, 16)
SHOWN = ("base", "layers-1", "residual-off", "lexicon-no-bias")
"""Runs whose imagined frames are shown, one of each kind."""


@dataclass
class Args(StudyArgs):
    """Measure the ablation runs."""

    runs: Path = Path("runs/ablations")
    """Folder of the runs, from `python experiments/train_ablations.py`."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes."""

    following: int  # of the predictors, with four instructions each
    unseen: int  # of unseen caption colours, with one
    acted: int  # of those with four instructions, how many the robot plays with each predictor
    parsing: int  # episodes that the parsers take apart
    slots: int  # of each number of objects, for every slot count
    clips: int  # how many best and how many worst cases are shown
    slot_counts: tuple[int, ...] = SLOT_COUNTS  # that the parser is given at test time


QUICK = Sizes(following=6, unseen=4, acted=2, parsing=3, slots=3, clips=2)
DEFAULT = Sizes(following=40, unseen=30, acted=20, parsing=20, slots=20, clips=10)


@dataclass(frozen=True)
class Entrant:
    """A model that is measured."""

    name: str  # of its row
    load: LoadModel | None = None  # makes it; None for the study's own
    num_slots: int | None = None  # that its parser uses, background included; None for its own number


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a scene."""

    scene: StudyScene
    figures: Mapping[tuple[str, str, str], Any]  # see `figure_rows`


@dataclass(frozen=True)
class FollowingScene:
    """A unit of work: does what each model imagines obey the sentence, and does it look like what happened?"""

    scene: StudyScene
    entrants: tuple[Entrant, ...]
    variants: int  # how many further instructions, with another target bowl each
    seed: int  # of the slots
    measures: Measures | None = None  # of pictures; None to compare none, which saves the expert's motion

    def run(self, worker: Worker) -> Outcome:
        """Imagine and judge, with every model."""
        env = worker.environment(self.scene)
        sampled = sample_scene(env, self.scene, self.variants)
        seen_1HW3, ground = sampled.observation["rgb"][None], AppearanceGrounder.from_info(sampled.info)
        scorer = None
        if self.measures is not None:
            real_T3HW = to_tensor(play_expert(env, sampled).frames[: LENGTH + 1])
            scorer = Scorer(real_T3HW, self.measures, upper=False)
        figures: dict[tuple[str, str, str], Any] = {}
        for one in self.entrants:
            with warnings.catch_warnings():
                # That a text encoder has never met a colour's name is what the unseen colours are about.
                warnings.filterwarnings("ignore", "the text encoder has never met", UserWarning)
                model = worker.model(one.load)
                parsed = model.parse(seen_1HW3, seed=self.seed, num_slots=one.num_slots)
                rollout, ours, wrong = imagine_and_trace(model, parsed, ground, sampled.texts, self.seed)
            (success_V, miss_V), (_, wrong_miss_V) = (
                [its.numpy() for its in judge(traced)] for traced in (ours, wrong)
            )
            for metric, good_V in ((ENDS, miss_V < NEAR), ("predicted_success", success_V)):
                figures[one.name, "original", metric] = good_V[0]
                if self.variants:
                    figures[one.name, "variants mean", metric] = good_V[1:]
            if self.variants:
                figures[one.name, "wrong text", ENDS] = wrong_miss_V < NEAR
            if scorer is not None:
                frames_T3HW = rollout.select(0).decode_frames(range(LENGTH + 1))[0]
                for metric, curve in scorer.score(Prediction(one.name, frames_T3HW)).curves.items():
                    figures[one.name, PICTURES, metric] = float(curve.mean())
        return Outcome(self.scene, figures)


@dataclass(frozen=True)
class ParsingScene:
    """A unit of work: how well does each parser take the expert's episode apart? Figures are means over its frames."""

    scene: StudyScene
    entrants: tuple[Entrant, ...]
    seed: int

    def run(self, worker: Worker) -> Outcome:
        """Play the episode and parse it with every model."""
        env = worker.environment(self.scene)
        sampled = sample_scene(env, self.scene)
        played = play_expert(env, sampled)
        figures = {}
        for one in self.entrants:
            parsed = worker.model(one.load).parse(played.frames, seed=self.seed, num_slots=one.num_slots)
            scores = score_masks(slot_labels(parsed.masks[0]), played.segmentations, sampled.named_block)
            for metric, curve in (("miou", scores.iou), ("kept", scores.kept), ("ari", scores.ari)):
                figures[one.name, "true frames", metric] = float(np.nanmean(curve))
            redrawn_T = psnr(parsed.frames[0], to_tensor(played.frames))
            figures[one.name, "true frames", "psnr"] = float(redrawn_T.mean())
        return Outcome(self.scene, figures)


def entrants(run: Run, stage: str) -> tuple[Entrant, ...]:
    """The shipped model and the trained runs of a stage."""
    found = (one for one in run.prepared if one.state == "trained" and one.run.stage == stage)
    return (Entrant(SHIPPED), *(Entrant(one.run.key, one.checkpoint) for one in found))


def slots_name(count: int) -> str:
    """The method that is the shipped model with so many slots."""
    return f"{SHIPPED}, {count} slots"


def units(run: Run) -> dict[str, Part]:
    """Scenes for the predictors, the robot, the parsers, and the shipped model with other numbers of slots."""
    sizes, seed = run.sizes, run.args.seed
    predictors, parsers = entrants(run, "predictor"), entrants(run, "parser")
    counts = tuple(Entrant(slots_name(count), None, count) for count in sizes.slot_counts)
    varied = study_scenes("controllability", max(sizes.following, sizes.acted), seed)
    unseen = study_scenes("unseen_colors", sizes.unseen, seed)
    counted = [scene for split in OBJECTS.values() for scene in study_scenes(split, sizes.slots, seed)]
    players = [("random candidate", None), ("expert", None), *(("ours", one.load) for one in predictors)]
    following = [FollowingScene(s, predictors, VARIANTS, seed, run.measures) for s in varied[: sizes.following]]
    following += [FollowingScene(s, predictors, 0, seed) for s in unseen]
    acting = [LoopEpisode(who, s, 0, VARIANTS, seed, load) for s in varied[: sizes.acted] for who, load in players]
    parsed = [ParsingScene(s, parsers, seed) for s in study_scenes("test", sizes.parsing, seed)]
    few_and_many = [ParsingScene(s, counts, seed) for s in counted]
    imagined = [FollowingScene(s, counts, 0, seed) for s in counted]
    return {
        "predictors": Part(following, 0.6 * len(predictors)),
        "closed loop": Part(acting, 2.0),
        "parsers": Part(parsed, 1.0 * len(parsers)),
        "slot counts, parsed": Part(few_and_many, 0.5 * len(counts)),
        "slot counts, imagined": Part(imagined, 0.2 * len(counts)),
        "pictures": Part(seconds=6.0, count=2 * min(sizes.clips, sizes.following // 2)),
    }


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """The scenes in which most of the trained predictors reach the bowl, and those in which fewest do."""
    trained = entrants(run, "predictor")[1:]
    shown = tuple(Model(e.name, e.load, True, e.name, "", None) for e in trained if e.load and e.name in SHOWN)
    clips, missed = [], []
    for one in found["predictors"] if trained else ():
        if one.scene.split == "controllability":
            reached = sum(bool(one.figures[e.name, "original", ENDS]) for e in trained)
            caption = f"{reached} of {len(trained)} runs end in the bowl"
            clips.append(PredictionClip(one.scene, shown, run.args.seed, "ablations", caption))
            missed.append(-float(reached))
    return {"pictures": extreme_clips(clips, missed, run.sizes.clips)}


def rows(run: Run, found: Found) -> list[Row]:
    """Every figure, as far as there are outcomes."""
    name_of = {one.load: one.name for one in entrants(run, "predictor")}
    parts = ("predictors", "slot counts, imagined", "parsers", "slot counts, parsed")
    scenes = [(one.scene.split, one.figures) for part in parts for one in found[part]]
    for one in found["closed loop"]:
        who = name_of[one.episode.load] if one.episode.method == "ours" else one.episode.method
        scenes.append((one.episode.scene.split, {(who, "original", "closed_loop_success"): one.success}))
    return figure_rows(scenes)


def headline(run: Run) -> dict[str, Key]:
    """Following of every predictor, overlap of every parser and slot count, as far as they are measured."""
    shown = {**FOLLOWING, "miou": PARSING["miou"]}
    methods = {name.replace("-", "_"): (name, shown) for name in (SHIPPED, *(one.key for one in RUNS))}
    methods |= {f"slots_{count}": (slots_name(count), SLOTS) for count in run.sizes.slot_counts}
    return {
        f"{word}_{name}": (method, column.split, column.variant, column.metric)
        for word, (method, named) in methods.items()
        for name, column in named.items()
    }


# --- tables and page --------------------------------------------------------------------------------------------------

# Name in the headline -> column.
FOLLOWING = {
    name: Column(title, split, variant, metric)
    for name, title, split, variant, metric in (
        ("original", "original", "controllability", "original", ENDS),
        ("variants_mean", "three other bowls", "controllability", "variants mean", ENDS),
        ("wrong_text", "wrong text", "controllability", "wrong text", ENDS),
        ("unseen_colors", "unseen colours", "unseen_colors", "original", ENDS),
        ("closed_loop", "carried out", "controllability", "original", "closed_loop_success"),
        ("original_strict", "original, strict", "controllability", "original", "predicted_success"),
    )
}
PARSING = {
    metric: Column(title, "test", "true frames", metric, digits)
    for metric, title, digits in (
        ("miou", "mIoU", 3), ("kept", "kept slot", 3), ("ari", "foreground ARI", 3), ("psnr", "PSNR, redrawn", 1),
    )
}  # fmt: skip
OBJECTS = {"6": "test", "8": "more_objects"}
SLOTS = {
    f"{objects}_objects_{name}": Column(f"{title}, {objects} objects", split, variant, metric, digits)
    for name, title, variant, metric, digits in (
        ("miou", "mIoU", "true frames", "miou", 3),
        ("original", "following", "original", "predicted_success", 2),
    )
    for objects, split in OBJECTS.items()
}
STRICT = Column("other bowls, strict", "controllability", "variants mean", "predicted_success")
ALIKE = [
    Column(f"{label} {LENGTH}", "controllability", PICTURES, metric, 1 if metric == "psnr" else 3)
    for metric, label in METRICS.items()
]


def tables(runs: Iterable[Line], parsers: Iterable[Line], counts: Iterable[int]) -> list[TableSpec]:
    """One for the runs of each stage, with what to compare them with, and one for the numbers of slots."""
    shipped = Line(key=SHIPPED, kind="ceiling", note="the checkpoint that is given: trained for longer")
    counted = [Line(key=slots_name(count), label=f"{count} slots") for count in counts]
    compared = [shipped, *runs, *lines(("random candidate", "expert"))]
    return [
        TableSpec("Predictor and text encoder", [*FOLLOWING.values(), STRICT, *ALIKE], compared),
        TableSpec("First slots and decoder", list(PARSING.values()), [shipped, *parsers]),
        TableSpec("Slots at test time", list(SLOTS.values()), counted),
    ]


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    trained = sum(one.state == "trained" for one in run.prepared)
    predictors, parsers = ([one.line for one in run.prepared if one.run.stage == stage] for stage in PRESETS)
    following, parsing, slots = tables(predictors, parsers, run.sizes.slot_counts)
    shown = (
        "Where most runs reach the bowl (best), and where fewest do (worst). Pictures above masks, one colour a thing; "
        "named are the shipped model (ours) and one run of each kind."
    )
    return [
        Section(
            "Predictor and text encoder",
            f"{trained} of {len(run.prepared)} runs are trained. All predictors learned from the slots of the shipped "
            "parser, from the same episodes in the same order, so compare them with each other, and not with the "
            "shipped model. Measured on test scenes that no training has seen. Does the block end within "
            f"{NEAR:g} px of the named bowl, with the original instruction and with three that name another bowl; "
            "judged for another instruction than it was given (wrong text: must be near 0); with caption colours never "
            "named in training? Strict: the calibrated criterion of the controllability study, for which the arm must "
            "also carry the block and the block lie still. Carried out: a robot that plans with that predictor, judged "
            f"by the simulator; at most three attempts. And how alike are {LENGTH} imagined frames to the real ones? "
            "Runs with the lexicon also learn from scenes whose colour channels are permuted together with their "
            f"words, which other text encoders cannot. {run.measures.absent}",
            [following.table(results.rows)],
        ),
        *([Section("Imagined beside real", shown, [Clips(found["pictures"])])] if found["pictures"] else []),
        Section(
            "First slots and decoder",
            "Parsers on the expert's whole episodes of the test split. mIoU: of blocks and bowls, slots matched afresh "
            "in every frame. Kept slot: each thing held against the slot that had it in the first frame. The runs "
            "below the shipped parser have the published corrector. They differ in how slots start (clusters of colour "
            "and place, or samples of a learned Gaussian) and in whether the decoder knows a slot's place beforehand.",
            [parsing.table(results.rows)],
        ),
        Section(
            "More and fewer slots than in training",
            "The number of slots is free at test time. The background takes one and the arm at least one, so 6 objects "
            "need 8 slots and 8 objects 10.",
            [slots.table(results.rows)],
        ),
    ]


STUDY = Study(
    name="ablations",
    title="Ablations",
    question="Which choices of architecture make the model follow instructions, and which only cost time?",
    args=Args,
    sizes=lambda args: QUICK if args.quick else DEFAULT,
    horizon=HORIZON,
    prepare=lambda run: [load_run(find_run(one, cast(Args, run.args).runs)) for one in RUNS],
    inputs=lambda args: sorted(p for p in args.runs.glob("*/*/*") if p.name in (CONFIG_FILE, WEIGHTS_FILE)),
    versions=lambda run: {f"run {one.run.key}": one.sha256 for one in run.prepared if one.sha256},
    measures=lambda args: available_measures(),
    units=units,
    cases=cases,
    rows=rows,
    tables=tables(PREDICTORS, PARSERS, SLOT_COUNTS),
    printed=lambda run, results: [runs_table(run.prepared)],
    page=page,
    cards=[
        CardSpec(label, Line(key=key), column, compare)
        for label, key, column, compare in (
            ("Reference: three other bowls", "base", FOLLOWING["variants_mean"], "3 layers"),
            ("One layer", "layers-1", FOLLOWING["variants_mean"], "three other bowls"),
            ("No residual", "residual-off", FOLLOWING["variants_mean"], "three other bowls"),
            ("No colour bias", "lexicon-no-bias", FOLLOWING["variants_mean"], "three other bowls"),
            ("Unseen colours, colour bias", "base", FOLLOWING["unseen_colors"], "never named"),
            ("Unseen colours, transformer", "text-transformer", FOLLOWING["unseen_colors"], "never named"),
            ("mIoU, clusters", "savi-cluster-prior", PARSING["miou"], "published corrector"),
            ("mIoU, Gaussian", "savi-gaussian-prior", PARSING["miou"], "published corrector"),
        )
    ],
    headline=headline,
    first=[f"{run}_variants_mean" for run in ("base", "layers_1", "residual_off", "lexicon_no_bias")],
)

if __name__ == "__main__":
    start(STUDY)
