"""Robustness: what is lost when colours or the number of objects are new?

    python experiments/robustness.py              # default: some minutes on 2 cores
    python experiments/robustness.py --quick      # a first look

The paper's study (its section 4.5): scenes whose caption colours no training sentence had, and scenes of 8 objects,
against the test set of 6 objects in seen colours. Beyond the paper, masks, goals and the closed loop: a robot plans
with the imagined rollouts, PyBullet executes, and the simulator alone judges. Every figure stands with its relative
drop; TextOCVP stands beside OCVP-Seq, Non-OC and MAGE, and beside controls. The first table holds the bars: closed-loop
success of at least .75 and .80, and a drop in LPIPS (or ST-LPIPS, where the weights of AlexNet are not there) that is
smaller than MAGE's. A model that is not trained is absent with the command that trains it. Writes `results.json`,
`report.html`, plots and clips into `--out`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.report.page import Card, CardSpec, Clip, Clips, Section
from experiments.report.plots import plot_table
from experiments.report.results import Results
from experiments.report.rows import Key, Row, interval_row, mean_row, rate_row
from experiments.report.tables import DASH, Cell, Column, Table, TableRow, TableSpec, as_percent, columns
from experiments.study.clips import PredictionClip, best_and_worst, episode_clips, extreme_clips
from experiments.study.closed_loop import LoopEpisode, LoopOutcome
from experiments.study.frame_metrics import METRICS, PERCEPTUAL, FrameScores, Measures, Scorer
from experiments.study.frame_metrics import available_measures as available
from experiments.study.judge import judge_rollout
from experiments.study.mask_metrics import labels_of, score_masks
from experiments.study.methods import BASELINES, HORIZON, METHODS, PLANNERS, TRAINED_LITTLE, Model, lines
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import Prediction, predict, slots_of
from experiments.study.run import Found, Part, Run, ScenesArgs, Study, start
from experiments.study.scenes import StudyScene, study_scenes
from planning import AppearanceGrounder
from textocvp.metrics.intervals import Interval, ratio_interval, relative_change, wilson_interval

SPLITS = {"test": "test set", "unseen_colors": "unseen colours", "more_objects": "8 objects"}
"""Split -> name. The first is what the model was trained for; the others are what it was not."""
REFERENCE, *SHIFTED = SPLITS
LENGTHS = (9, 19)
SHORT = f"{LENGTHS[0]} frames"
WHOLE = "whole episode"
REPARSED = "ours, frames parsed"
DISTANCES = tuple(PERCEPTUAL)  # of these less is better: their drop is how much they grow
ACTING = tuple(key for key in PLANNERS if not METHODS[key].privileged)
IMAGINING = ("ours", *BASELINES, "true frames", "wrong text", "copy frame")
FRAME_LINES = lines(IMAGINING)
MASK_LINES = lines(["ours", REPARSED, *IMAGINING[1:], *ACTING[1:]])


# --- how much is measured ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes of each split."""

    imagined: int  # for frames and masks
    loop: int  # for the closed loop, ours and the expert
    controls: int  # for every other planner
    clips: int  # how many best and how many worst cases are shown
    acted: int  # how many episodes of the robot are shown


QUICK = Sizes(imagined=5, loop=8, controls=4, clips=3, acted=2)
DEFAULT = Sizes(imagined=50, loop=50, controls=25, clips=10, acted=6)


def sizes_of(args: ScenesArgs) -> Sizes:
    """How much a command line asks for."""
    sizes, most = QUICK if args.quick else DEFAULT, args.scenes
    return replace(sizes, imagined=most, loop=most, controls=min(most, sizes.controls)) if most else sizes


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RobustOutcome:
    """One scene, imagined by everybody and measured."""

    scene: StudyScene  # which
    scores: tuple[FrameScores, ...]  # of each prediction's frames
    # method -> (t,), mask IoU of the blocks and bowls that are seen, frame by frame (Hungarian)
    ious: Mapping[str, np.ndarray]
    # method -> whether its masks show what the sentence says; methods that look 24 frames ahead
    success: Mapping[str, bool]

    def mean(self, method: str, metric: str, length: int) -> float | None:
        """Mean over the first `length` frames after the observed one; None where it was not measured."""
        if metric == "iou":
            curve = self.ious.get(method, np.empty(0))
            return float(np.nanmean(curve[:length])) if len(curve) >= length else None
        return next((one.mean(metric, length) for one in self.scores if one.method == method), None)


@dataclass(frozen=True)
class RobustScene:
    """A unit of work: one scene, imagined by every model and every control."""

    scene: StudyScene
    models: tuple[Model, ...]
    measures: Measures
    seed: int

    def run(self, worker: Worker) -> RobustOutcome:
        """Imagine, watch, measure."""
        truth, predictions = predict(worker, self.scene, self.models, horizon=HORIZON, seed=self.seed)
        scorer = Scorer(truth.frames_T3HW[: LENGTHS[-1] + 1], self.measures, upper=False)
        ground = AppearanceGrounder.from_info(truth.sampled.info)
        ious, success = {}, {}
        # Ours once more, judged as the models without slots must be: our parser reads the masks off its frames.
        for one in [*predictions, Prediction(REPARSED, predictions[0].frames_T3HW)]:
            rollout = slots_of(worker, one, self.seed)
            labels_THW = labels_of(rollout)[0]
            true_THW = truth.segmentations_THW[: len(labels_THW)]
            ious[one.method] = score_masks(labels_THW, true_THW, truth.sampled.named_block).iou[1:]
            if len(labels_THW) > HORIZON:
                success[one.method] = judge_rollout(rollout, ground, truth.text)
        scores = tuple(
            scorer.score(Prediction(one.method, one.frames_T3HW[: LENGTHS[-1] + 1])) for one in predictions
        )
        return RobustOutcome(self.scene, scores, ious, success)


def units(run: Run) -> dict[str, Part]:
    """The scenes of every split, for frames and masks and for the closed loop."""
    sizes, seed = run.sizes, run.args.seed
    scenes = [
        RobustScene(scene, run.models, run.measures, seed)
        for split in SPLITS
        for scene in study_scenes(split, sizes.imagined, seed)
    ]
    episodes = [
        LoopEpisode(method, scene, seed=seed)
        for split in SPLITS
        for i, scene in enumerate(study_scenes(split, sizes.loop, seed))
        for method in ACTING
        if method in ("ours", "expert") or i < sizes.controls
    ]
    return {
        "frames and masks": Part(scenes, 2.8),
        "closed loop": Part(episodes, 0.25),
        "imagined clips": Part(seconds=1.4, count=2 * min(sizes.clips, sizes.imagined)),
        "robot clips": Part(seconds=0.3, count=sizes.acted),
    }


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """The best and worst imagined scenes, and episodes of the robot."""
    imagined, acted = found["frames and masks"], found["closed loop"]
    clips = imagined_clips(imagined, run.models, run.measures, run.args.seed, run.sizes.clips)
    robot = episode_clips(acted, lambda episode: SPLITS[episode.scene.split], run.sizes.acted // 2)
    return {"imagined clips": clips, "robot clips": robot}


def imagined_clips(
    outcomes: Sequence[RobustOutcome], models: Sequence[Model], measures: Measures, seed: int, count: int
) -> list[PredictionClip]:
    """The best and then the worst cases of the new kinds of scenes: failures, then by how ours looks."""
    metric = measures.main
    shifted = [outcome for outcome in outcomes if outcome.scene.split in SHIFTED]
    means = [float(outcome.scores[0].curves[metric].mean()) for outcome in shifted]
    # A failure is worse than any success; the metrics stay well below 1.
    badness = [
        (-mean if metric == "ssim" else mean) + (10.0 if outcome.success.get("ours") is False else 0.0)
        for outcome, mean in zip(shifted, means, strict=True)
    ]

    clips = []
    for outcome, mean in zip(shifted, means, strict=True):
        caption = f"{SPLITS[outcome.scene.split]}; {METRICS[metric]} {mean:.3f}"
        good = outcome.success.get("ours")
        clips.append(PredictionClip(outcome.scene, tuple(models), seed, "robustness", caption, good))
    return extreme_clips(clips, badness, count)


# --- rows -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Figures:
    """One figure of one method on every split: its rows, and how far it falls."""

    method: str  # see `Row`
    variant: str  # see `Row`
    metric: str  # see `Row`
    values: Mapping[str, np.ndarray]  # split -> (N,), one value a scene

    @classmethod
    def of(
        cls, method: str, variant: str, metric: str, values: Sequence[tuple[str, float | None]]
    ) -> Figures:
        """Of (split, value) a scene; None where it was not measured."""
        by_split = {split: [v for one, v in values if one == split and v is not None] for split in SPLITS}
        arrays = {split: np.asarray(its, dtype=np.float64) for split, its in by_split.items() if its}
        return cls(method, variant, metric, arrays)

    def rows(self) -> list[Row]:
        """A row for each split, and one with the drop for each split that the model was not trained for."""
        make = rate_row if self.metric.endswith("success") else mean_row
        rows = [
            make(self.method, split, self.variant, self.metric, its) for split, its in self.values.items()
        ]
        for split in SHIFTED:
            if (found := self.drop(split)) is not None:
                rows.append(interval_row(self.method, split, self.variant, f"{self.metric}_drop", found))
        return rows

    def drop(self, split: str) -> Interval | None:
        """How much worse than on the test set, relative to it: .1 for 10 %; None without figures to compare."""
        reference, values = (self.values.get(name, np.empty(0)) for name in (REFERENCE, split))
        if not len(values) or not len(reference) or reference.mean() == 0:
            return None
        if self.metric.endswith("success"):
            # A bootstrap of rates of 1 would be sure that nothing is lost.
            rates = [wilson_interval(float(part.sum()), len(part)) for part in (values, reference)]  # type: ignore[arg-type]
            ratio = ratio_interval(*rates)
            change = Interval(ratio.value - 1, ratio.low - 1, ratio.high - 1, ratio.n)
        else:
            change = relative_change(values, reference)
        if self.metric in DISTANCES:
            return change
        return Interval(-change.value, -change.high, -change.low, change.n)


def drop_difference(
    ours: Figures, other: Figures, split: str, *, resamples: int = 2000, seed: int = 0
) -> Interval | None:
    """How much less ours drops than another method, with a bootstrap interval; None where one was not measured.

    Both imagined the same scenes, and which scenes are hard is most of what makes a drop uncertain. So a scene is drawn
    with the figures of both.
    """
    found = [[one.values.get(name, np.empty(0)) for name in (REFERENCE, split)] for one in (ours, other)]
    sizes = [len(values) for values in found[0]]
    if 0 in sizes or [len(values) for values in found[1]] != sizes:
        return None
    rng = np.random.default_rng(seed)
    drawn = [np.vstack([np.arange(n), rng.integers(n, size=(resamples, n))]) for n in sizes]
    changes = []
    for reference, values in found:
        changes.append(values[drawn[1]].mean(axis=1) / reference[drawn[0]].mean(axis=1) - 1)
    sign = 1 if ours.metric in DISTANCES else -1
    difference_S = sign * (changes[0] - changes[1])
    low, high = np.quantile(difference_S[1:], [0.025, 0.975])
    return Interval(float(difference_S[0]), float(low), float(high), min(sizes))


def difference_rows(figures: Sequence[Figures]) -> list[Row]:
    """How much less ours drops than every baseline that was measured in the same way."""
    found = {(one.method, one.variant, one.metric): one for one in figures}
    rows = []
    for (method, variant, metric), other in found.items():
        if metric not in (*DISTANCES, "ssim") or method not in BASELINES:
            continue
        for split in SHIFTED:
            difference = drop_difference(found["ours", variant, metric], other, split)
            if difference is not None:
                name = f"ours minus {method}"
                rows.append(interval_row(name, split, variant, f"{metric}_drop_difference", difference))
    return rows


def imagined_figures(outcomes: Sequence[RobustOutcome], metrics: Sequence[str]) -> list[Figures]:
    """Frames and masks: `metrics` and mask IoU at both lengths, predicted success."""
    figures = []
    for method in dict.fromkeys(method for outcome in outcomes for method in outcome.ious):
        for metric in (*metrics, "iou"):
            for length in LENGTHS:
                means = [(o.scene.split, o.mean(method, metric, length)) for o in outcomes]
                figures.append(Figures.of(method, f"{length} frames", metric, means))
        judged = [(o.scene.split, o.success.get(method)) for o in outcomes]
        figures.append(Figures.of(method, WHOLE, "predicted_success", judged))
    return figures


def loop_figures(outcomes: Sequence[LoopOutcome]) -> list[Figures]:
    """Success of the robot, judged by the simulator."""
    figures = []
    for method in ACTING:
        won = [(o.episode.scene.split, o.success) for o in outcomes if o.episode.method == method]
        figures.append(Figures.of(method, WHOLE, "closed_loop_success", won))
    return figures


def rows(run: Run, found: Found) -> list[Row]:
    """Every figure, as far as there are outcomes."""
    imagined = imagined_figures(found["frames and masks"], run.measures.metrics)
    acted = loop_figures(found["closed loop"])
    made = [row for one in imagined for row in one.rows()]
    return [*made, *difference_rows(imagined), *(row for one in acted for row in one.rows())]


def headline(run: Run) -> dict[str, Key]:
    """Success of the robot, and the drop of ours and of MAGE if there is LPIPS or ST-LPIPS."""
    wanted = {f"closed_loop_{split}": ("ours", split, WHOLE, "closed_loop_success") for split in SPLITS}
    if run.measures.perceptual:
        for split in SHIFTED:
            for method, ending in (("ours", ""), ("MAGE", "_mage")):
                wanted[f"lpips_drop_{split}{ending}"] = (method, split, SHORT, f"{run.measures.main}_drop")
    return wanted


# --- bars -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bar:
    """What the study is held to. Reported, never tuned for."""

    name: str  # of the headline figure
    title: str  # in words
    split: str  # the scenes
    least: float | None = None  # the least success; or None for a drop that must be smaller than MAGE's


BARS = (
    Bar("closed_loop_unseen_colors", "closed-loop success, unseen colours", "unseen_colors", 0.75),
    Bar("closed_loop_more_objects", "closed-loop success, 8 objects", "more_objects", 0.80),
    Bar("lpips_drop_unseen_colors", "{} drop at 9 frames, unseen colours", "unseen_colors"),
    Bar("lpips_drop_more_objects", "{} drop at 9 frames, 8 objects", "more_objects"),
)


def verdict(bar: Bar, results: Results) -> str:
    """`pass`, `miss`, or that it cannot be decided."""
    ours = results.headline.get(bar.name)
    if bar.least is not None:
        return "not measured" if ours is None else "pass" if ours >= bar.least else "miss"
    mage = results.headline.get(f"{bar.name}_mage")
    if ours is None or mage is None:
        return "undecided: " + ("no LPIPS" if ours is None else "no MAGE")
    return "pass" if ours < mage else "miss"


def doubt(bar: Bar, results: Results, measures: Measures) -> str:
    """That the interval allows the other verdict too; empty where it does not."""
    if bar.least is not None:
        row, edge = results.find("ours", WHOLE, "closed_loop_success", bar.split), bar.least
    else:
        row, edge = _difference(bar, results, measures), 0.0
    return "within the interval" if row is not None and row.low < edge <= row.high else ""


def bars_table(results: Results, measures: Measures) -> Table:
    """Every bar, the figure that is held against it, and the verdict."""
    made = []
    for bar in BARS:
        ours, mage = (results.headline.get(name) for name in (bar.name, f"{bar.name}_mage"))
        if bar.least is not None:
            figure = Cell(DASH if ours is None else f"{ours:.2f}")
            wanted, between = f"at least {bar.least:.2f}", Cell("")
        else:
            figure = Cell(DASH if ours is None else as_percent(ours))
            wanted = f"less than MAGE: {DASH if mage is None else as_percent(mage)}"
            between = Cell.of(_difference(bar, results, measures), percent=True)
        judged = Cell(verdict(bar, results), doubt(bar, results, measures))
        title = bar.title.format(METRICS[measures.main])
        made.append(TableRow(title, [figure, Cell(wanted), between, judged], "ours"))
    caption = "The difference is taken scene by scene: which scenes are hard is most of what makes a drop uncertain."
    return Table("Bars", ("ours", "bar", "ours minus MAGE", "verdict"), made, caption)


def _difference(bar: Bar, results: Results, measures: Measures) -> Row | None:
    return results.find("ours minus MAGE", SHORT, f"{measures.main}_drop_difference", bar.split)


# --- tables and page --------------------------------------------------------------------------------------------------


def _with_drops(split: str, wanted: Sequence[tuple[str, str, str, int]]) -> list[Column]:
    """(title, variant, metric, digits) each, beside it how far it drops."""
    made = []
    for title, variant, metric, digits in wanted:
        made.append(Column(title, split, variant, metric, digits))
        if split != REFERENCE:
            made.append(Column("drop", split, variant, f"{metric}_drop", percent=True))
    return made


FRAME_TABLES = {
    split: TableSpec(
        f"Frames, {name}",
        _with_drops(
            split, [(f"{METRICS[m]} {n}", f"{n} frames", m, 3) for n in LENGTHS for m in ("ssim", *DISTANCES)]
        ),
        FRAME_LINES,
    )
    for split, name in SPLITS.items()
}
MASK_TABLES = {
    split: TableSpec(
        f"Masks and goals, {name}",
        _with_drops(
            split,
            [
                *((f"IoU {n}", f"{n} frames", "iou", 3) for n in LENGTHS),
                ("predicted", WHOLE, "predicted_success", 2),
                ("closed loop", WHOLE, "closed_loop_success", 2),
            ],
        ),
        MASK_LINES,
    )
    for split, name in SPLITS.items()
}
LOOP_TABLE = TableSpec(
    "Closed-loop success",
    columns("closed_loop_success", {name: (split, WHOLE) for split, name in SPLITS.items()}),
    lines(ACTING),
)
SHORT_TABLES = [
    TableSpec(
        f"{METRICS[metric]} of {SHORT}",
        [c for split, name in SPLITS.items() for c in _with_drops(split, [(name, SHORT, metric, 3)])],
        FRAME_LINES,
    )
    for metric in ("ssim", *DISTANCES)
]


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures, missing, measures = list(results.rows), run.missing_keys, run.measures
    name = METRICS[measures.main]
    drops = TableSpec(
        "",
        [
            Column(SPLITS[s], s, SHORT, f"{measures.main}_drop", percent=True, paper="lpips_drop")
            for s in SHIFTED
        ],
        FRAME_LINES,
    )
    bars = Section(
        "The bars",
        "Fixed before anything was measured, and reported whichever way it went. A drop is how much worse a figure is "
        f"than on the test set, relative to it; for {name}, how much it grows. {TRAINED_LITTLE}",
        [
            bars_table(results, measures),
            plot_table("drops.png", drops, figures, label=f"{name} drop at {SHORT}, %", limits=None),
            plot_table("closed_loop.png", LOOP_TABLE, figures, label="closed-loop success",
                       caption="Dots with 95 % intervals over scenes, judged by the simulator."),
        ],
    )  # fmt: skip
    texts = {
        "test": "Six objects, caption colours that were seen in training: what everything else is held against.",
        "unseen_colors": "Six objects. Captions name CLIPort's test colours, four of which no training sentence had: "
        "pink, purple, white and orange. Above: frames, in the layout of the paper's table, with its figures, whose "
        "order compares with ours and whose height does not. Below: masks against the simulator's, whether they show "
        "what the sentence says, and whether a robot that plans with them reaches the goal.",
        "more_objects": "Eight objects; training had six.",
    }
    splits = [
        Section(
            SPLITS[split].capitalize(),
            text,
            [FRAME_TABLES[split].table(figures, missing), MASK_TABLES[split].table(figures, missing)],
        )
        for split, text in texts.items()
    ]
    best, worst = best_and_worst(found["imagined clips"])
    acted = "Failures where there are any. Left: each chosen plan, imagined. Right: the camera."
    ranked = f"Both kinds of scenes, by whether ours shows what was asked, then by its {name} at {LENGTHS[-1]} frames."
    clips: list[tuple[str, str, Sequence[Clip]]] = [
        ("The best cases", f"{ranked} Below the pictures: masks, one colour a thing.", best),
        ("The worst cases", ranked, worst),
        ("Planned beside executed", acted, found["robot clips"]),
    ]
    galleries = [Section(title, text, [Clips(its)]) for title, text, its in clips]
    return [bars, *splits, *galleries, Section("What is absent", " ".join(run.remarks) or "Nothing.")]


def cards(run: Run, results: Results) -> list[CardSpec | Card]:
    """Success on every split against its bar, drops against MAGE's and the paper's, and the floor."""
    made: list[CardSpec | Card] = []
    for split, name in SPLITS.items():
        bar = next((bar for bar in BARS if bar.name == f"closed_loop_{split}"), None)
        compare = "" if bar is None else f"bar {bar.least:.2f}: {verdict(bar, results)}"
        column = Column("", split, WHOLE, "closed_loop_success")
        made.append(CardSpec(f"Closed loop, {name}", METHODS["ours"], column, compare))
    for split in SHIFTED:
        column = Column("", split, SHORT, f"{run.measures.main}_drop", percent=True)
        mage = results.find("MAGE", SHORT, column.metric, split)
        compare = f"MAGE {DASH if mage is None else as_percent(mage.value)}"
        paper = METHODS["ours"].paper
        if paper is not None:
            compare += f", paper {as_percent(paper.figures[split, SHORT, 'lpips_drop'])} (LPIPS)"
        label = f"{METRICS[run.measures.main]} drop at {SHORT}, {SPLITS[split]}"
        made.append(CardSpec(label, METHODS["ours"], column, compare))
    column, label = Column("", SHIFTED[0], WHOLE, "closed_loop_success"), SPLITS[SHIFTED[0]]
    made.append(
        CardSpec(f"Closed loop, random candidate, {label}", METHODS["random candidate"], column, "the floor")
    )
    return made


STUDY = Study(
    name="robustness",
    title="Robustness",
    question="Colours that no training sentence named, and two objects more than ever before: what is lost?",
    args=ScenesArgs,
    sizes=sizes_of,
    horizon=HORIZON,
    methods=(*IMAGINING, *ACTING),
    measures=lambda args: available(),
    units=units,
    cases=cases,
    rows=rows,
    tables=[*SHORT_TABLES, LOOP_TABLE],
    printed=lambda run, results: [bars_table(results, run.measures)],
    page=page,
    cards=cards,
    headline=headline,
    first=(
        "closed_loop_test", "closed_loop_unseen_colors", "closed_loop_more_objects",
        "lpips_drop_unseen_colors", "lpips_drop_more_objects",
    ),
)  # fmt: skip

if __name__ == "__main__":
    start(STUDY)
