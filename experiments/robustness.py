"""Robustness: what is lost when colours, the number of objects, the light or the words are new?

    python experiments/robustness.py              # default: some minutes on 2 cores
    python experiments/robustness.py --quick      # a first look

The paper's study (its section 4.5): captions with colours that no training sentence had, and scenes of 8 objects,
against the test set. Beyond the paper: masks, goals and the closed loop, each figure with its relative drop, beside
baselines and controls. The first table holds the bars: closed-loop success, and a drop in LPIPS (or ST-LPIPS, where the
weights of AlexNet are not there) smaller than MAGE's. Writes `results.json`, `report.html`, plots and clips.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from experiments.report.page import CardSpec, Clips, Section
from experiments.report.plots import plot_table
from experiments.report.results import EpisodeLine, Results
from experiments.report.rows import Key, Row, interval_row, mean_row, rate_row
from experiments.report.tables import DASH, Cell, Column, Table, TableRow, TableSpec, as_percent, columns
from experiments.study.clips import PredictionClip, best_and_worst, episode_clips, extreme_clips
from experiments.study.closed_loop import LoopEpisode
from experiments.study.frame_metrics import METRICS, PERCEPTUAL, Measures, Scorer
from experiments.study.frame_metrics import available_measures as available
from experiments.study.judge import judge_rollout
from experiments.study.mask_metrics import score_masks
from experiments.study.methods import BASELINES, HORIZON, METHODS, PLANNERS, TRAINED_LITTLE, Model, lines
from experiments.study.pictures import CHANGES, WORDS, ChangedScene, change_rows, change_tables
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import Prediction, predict, slots_of
from experiments.study.run import Found, Part, Run, ScenesArgs, Study, start
from experiments.study.scenes import StudyScene, place_of, scene_hash, study_scenes
from experiments.study.wordings import FREE
from planning import AppearanceGrounder
from textocvp.metrics import slot_labels
from textocvp.metrics.intervals import Interval, ratio_interval, relative_change, wilson_interval

SPLITS = {"test": "test set", "unseen_colors": "unseen colours", "more_objects": "8 objects"}
"""Split -> name. The first is what the model was trained for; the others are what it was not."""
REFERENCE, *SHIFTED = SPLITS
LENGTHS = (9, 19)
SHORT = f"{LENGTHS[0]} frames"
WHOLE = "whole episode"
Name = tuple[str, str, str]
Values = Mapping[str, np.ndarray]
"""Name of a figure: (method, variant, metric) of `Row`; and its values: split -> (N,), one a scene."""
REPARSED = "ours, frames parsed"
DISTANCES = tuple(PERCEPTUAL)  # of these less is better: their drop is how much they grow
ACTING = tuple(key for key in PLANNERS if not METHODS[key].privileged)
IMAGINING = ("ours", *BASELINES, "true frames", "wrong text", "copy frame")
FRAME_LINES = lines(IMAGINING)
MASK_LINES = lines(["ours", REPARSED, *IMAGINING[1:], *ACTING[1:]])


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes of each split."""

    imagined: int  # for frames and masks
    loop: int  # for the closed loop, ours and the expert
    controls: int  # for every other planner
    changed: int  # for every change of light or camera; of the test set only
    clips: int  # how many best and how many worst cases are shown
    acted: int  # how many episodes of the robot are shown


QUICK = Sizes(imagined=5, loop=8, controls=4, changed=8, clips=3, acted=2)
DEFAULT = Sizes(imagined=50, loop=50, controls=25, changed=40, clips=10, acted=6)


def sizes_of(args: ScenesArgs) -> Sizes:
    """How much a command line asks for."""
    sizes, most = QUICK if args.quick else DEFAULT, args.scenes
    return replace(sizes, imagined=most, loop=most, controls=min(most, sizes.controls), changed=most) if most else sizes


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RobustOutcome:
    """One scene, imagined by everybody and measured."""

    scene: StudyScene  # which
    # method -> metric -> (t,): of the frames, and `iou` of the blocks and bowls that are seen (Hungarian)
    curves: Mapping[str, Mapping[str, np.ndarray]]
    # method -> whether its masks show what the sentence says; methods that look 24 frames ahead
    success: Mapping[str, bool]
    text: str = ""  # what was imagined

    @property
    def lines(self) -> list[EpisodeLine]:
        """For `results.json`."""
        scene = self.scene
        where = place_of(scene), "predicted_success", scene_hash(scene), scene.seed, self.text
        return [EpisodeLine(method, *where, float(good)) for method, good in self.success.items()]

    def figures(self) -> dict[Name, float]:
        """Means over the first frames after the observed one; and predicted success."""
        found = {}
        for method, curves in self.curves.items():
            for (metric, curve), length in product(curves.items(), LENGTHS):
                if len(curve) >= length:
                    found[method, f"{length} frames", metric] = float(np.nanmean(curve[:length]))
            if method in self.success:
                found[method, WHOLE, "predicted_success"] = float(self.success[method])
        return found


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
        early = [replace(one, frames_T3HW=one.frames_T3HW[: LENGTHS[-1] + 1]) for one in predictions]
        curves, success = {one.method: dict(scorer.score(one).curves) for one in early}, {}
        # Ours once more, judged as the models without slots must be: our parser reads the masks off its frames.
        for one in [*predictions, Prediction(REPARSED, predictions[0].frames_T3HW)]:
            rollout = slots_of(worker, one, self.seed)
            labels_THW = slot_labels(rollout.masks[0])
            true_THW = truth.segmentations_THW[: len(labels_THW)]
            scores = score_masks(labels_THW, true_THW, truth.sampled.named_block)
            curves.setdefault(one.method, {})["iou"] = scores.iou[1:]
            if len(labels_THW) > HORIZON:
                success[one.method] = judge_rollout(rollout, ground, truth.text)
        return RobustOutcome(self.scene, curves, success, truth.text)


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
    changed = [
        ChangedScene(scene, change, seed, words, number)
        for number, scene in enumerate(study_scenes(REFERENCE, sizes.changed, seed))
        for change, words in product(CHANGES, WORDS)
    ]
    return {
        "frames and masks": Part(scenes, 2.8),
        "closed loop": Part(episodes, 0.25),
        "other light and words": Part(changed, 0.04),
        "imagined clips": Part(seconds=1.4, count=2 * min(sizes.clips, sizes.imagined)),
        "robot clips": Part(seconds=0.3, count=sizes.acted),
    }


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """The best and worst scenes of the new kinds, failures last and then by how ours looks; episodes of the robot."""
    metric, clips, badness = run.measures.main, [], []
    for one in found["frames and masks"]:
        if one.scene.split in SHIFTED:
            mean, good = float(one.curves["ours"][metric].mean()), one.success.get("ours")
            caption = f"{SPLITS[one.scene.split]}; {METRICS[metric]} {mean:.3f}"
            clips.append(PredictionClip(one.scene, run.models, run.args.seed, "robustness", caption, good))
            # A failure is worse than any success; the metrics stay well below 1.
            badness.append(run.measures.badness(mean) + (10.0 if good is False else 0.0))
    episodes = episode_clips(found["closed loop"], lambda e: SPLITS[e.scene.split], run.sizes.acted // 2)
    return {"imagined clips": extreme_clips(clips, badness, run.sizes.clips), "robot clips": episodes}


# --- rows -------------------------------------------------------------------------------------------------------------


def by_name(scenes: Iterable[tuple[str, Mapping[Name, float]]]) -> dict[Name, Values]:
    """Every figure on every split, of the split and the figures of each scene."""
    found: dict[Name, dict[str, list[float]]] = {}
    for split, figures in scenes:
        for name, value in figures.items():
            found.setdefault(name, {}).setdefault(split, []).append(value)
    return {name: {s: np.array(its) for s, its in values.items()} for name, values in found.items()}


def rows_of(name: Name, values: Values) -> list[Row]:
    """A row for each split, and one with the drop for each split that the model was not trained for."""
    method, variant, metric = name
    make = rate_row if metric.endswith("success") else mean_row
    rows = [make(method, split, variant, metric, its) for split, its in values.items()]
    drops = {split: drop(metric, values, split) for split in SHIFTED}
    rows += [interval_row(method, s, variant, f"{metric}_drop", its) for s, its in drops.items() if its]
    return rows


def drop(metric: str, values: Values, split: str) -> Interval | None:
    """How much worse than on the test set, relative to it: .1 for 10 %; None without figures to compare."""
    reference, shifted = (values.get(name, np.empty(0)) for name in (REFERENCE, split))
    if not len(shifted) or not len(reference) or reference.mean() == 0:
        return None
    if metric.endswith("success"):
        # A bootstrap of rates of 1 would be sure that nothing is lost.
        rates = [wilson_interval(float(part.sum()), len(part)) for part in (shifted, reference)]  # type: ignore[arg-type]
        ratio = ratio_interval(*rates)
        change = Interval(ratio.value - 1, ratio.low - 1, ratio.high - 1, ratio.n)
    else:
        change = relative_change(shifted, reference)
    return change if metric in DISTANCES else Interval(-change.value, -change.high, -change.low, change.n)


def drop_difference(metric: str, ours: Values, other: Values, split: str) -> Interval | None:
    """How much less ours drops than another method, with a bootstrap interval; None where one was not measured.

    Both imagined the same scenes, and which scenes are hard is most of what makes a drop uncertain. So a scene is drawn
    with the figures of both.
    """
    found = [[values.get(name, np.empty(0)) for name in (REFERENCE, split)] for values in (ours, other)]
    sizes = [len(values) for values in found[0]]
    if 0 in sizes or [len(values) for values in found[1]] != sizes:
        return None
    rng = np.random.default_rng(0)
    first, second = (np.vstack([np.arange(n), rng.integers(n, size=(2000, n))]) for n in sizes)
    changes = [shifted[second].mean(axis=1) / reference[first].mean(axis=1) for reference, shifted in found]
    difference_S = (changes[0] - 1 - (changes[1] - 1)) * (1 if metric in DISTANCES else -1)
    low, high = np.quantile(difference_S[1:], [0.025, 0.975])
    return Interval(float(difference_S[0]), float(low), float(high), min(sizes))


def difference_rows(found: Mapping[Name, Values]) -> list[Row]:
    """How much less ours drops than every baseline that was measured in the same way."""
    made = []
    for ((method, variant, metric), other), split in product(found.items(), SHIFTED):
        if metric in (*DISTANCES, "ssim") and method in BASELINES:
            its = drop_difference(metric, found["ours", variant, metric], other, split)
            place = f"ours minus {method}", split, variant, f"{metric}_drop_difference"
            made += [interval_row(*place, its)] if its else []
    return made


def rows(run: Run, found: Found) -> list[Row]:
    """Every figure, as far as there are outcomes."""
    imagined = by_name((o.scene.split, o.figures()) for o in found["frames and masks"])
    acted = by_name(
        (o.episode.scene.split, {(o.episode.method, WHOLE, "closed_loop_success"): float(o.success)})
        for o in found["closed loop"]
    )
    first, last = ([row for one in its.items() for row in rows_of(*one)] for its in (imagined, acted))
    return [*first, *difference_rows(imagined), *last, *change_rows(found["other light and words"])]


def headline(run: Run) -> dict[str, Key]:
    """Success of the robot, and the drop of ours and of MAGE if there is LPIPS or ST-LPIPS."""
    wanted = {f"closed_loop_{split}": ("ours", split, WHOLE, "closed_loop_success") for split in SPLITS}
    for split, method in product(SHIFTED if run.measures.perceptual else (), ("ours", "MAGE")):
        name = f"lpips_drop_{split}{METHODS[method].ending}"
        wanted[name] = (method, split, SHORT, f"{run.measures.main}_drop")
    return wanted


# --- bars, tables and page --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bar:
    """What the study is held to. Reported, never tuned for."""

    split: str  # the scenes
    least: float | None = None  # closed-loop success; None for a drop that must be smaller than MAGE's

    @property
    def name(self) -> str:
        """Of its headline figure."""
        return f"{'lpips_drop' if self.least is None else 'closed_loop'}_{self.split}"

    def title(self, measures: Measures) -> str:
        """In words."""
        figure = f"{METRICS[measures.main]} drop at {SHORT}" if self.least is None else "closed-loop success"
        return f"{figure}, {SPLITS[self.split]}"

    def figures(self, results: Results) -> tuple[float | None, float | None]:
        """Ours, and what it is held against."""
        mage = results.headline.get(f"{self.name}_mage")
        return results.headline.get(self.name), mage if self.least is None else self.least


BARS = Bar("unseen_colors", 0.75), Bar("more_objects", 0.80), Bar("unseen_colors"), Bar("more_objects")


def verdict(bar: Bar, results: Results) -> str:
    """`pass`, `miss`, or that it cannot be decided."""
    ours, edge = bar.figures(results)
    if ours is None:
        return "undecided: no LPIPS" if bar.least is None else "not measured"
    if edge is None:
        return "undecided: no MAGE"
    return "pass" if (ours < edge if bar.least is None else ours >= edge) else "miss"


def bars_table(results: Results, measures: Measures) -> Table:
    """Every bar, the figure that is held against it, and the verdict; also whether the interval allows the other."""
    made = []
    for bar in BARS:
        drops, both = bar.least is None, bar.figures(results)
        ours, edge = (DASH if v is None else as_percent(v) if drops else f"{v:.2f}" for v in both)
        if drops:
            row = results.find("ours minus MAGE", SHORT, f"{measures.main}_drop_difference", bar.split)
        else:
            row = results.find("ours", WHOLE, "closed_loop_success", bar.split)
        doubtful = row is not None and row.low < (bar.least or 0.0) <= row.high
        cells = [
            Cell(ours),
            Cell(f"less than MAGE: {edge}" if drops else f"at least {edge}"),
            Cell.of(row, percent=True) if drops else Cell(""),
            Cell(verdict(bar, results), "within the interval" if doubtful else ""),
        ]
        made.append(TableRow(bar.title(measures), cells))
    caption = "The difference is taken scene by scene: which scenes are hard is most of what makes a drop uncertain."
    return Table("Bars", ("ours", "bar", "ours minus MAGE", "verdict"), made, caption)


def _with_drops(split: str, wanted: Sequence[tuple[str, str, str, int]]) -> list[Column]:
    """(title, variant, metric, digits) each, beside it how far it drops."""
    made = []
    for title, variant, metric, digits in wanted:
        made.append(Column(title, split, variant, metric, digits))
        if split != REFERENCE:
            made.append(Column("drop", split, variant, f"{metric}_drop", percent=True))
    return made


FRAME_COLUMNS = [(f"{METRICS[m]} {n}", f"{n} frames", m, 3) for n in LENGTHS for m in ("ssim", *DISTANCES)]
MASK_COLUMNS = [
    *((f"IoU {n}", f"{n} frames", "iou", 3) for n in LENGTHS),
    ("predicted", WHOLE, "predicted_success", 2), ("closed loop", WHOLE, "closed_loop_success", 2),
]  # fmt: skip
SPLIT_TABLES = {
    split: [
        TableSpec(f"Frames, {name}", _with_drops(split, FRAME_COLUMNS), FRAME_LINES),
        TableSpec(f"Masks and goals, {name}", _with_drops(split, MASK_COLUMNS), MASK_LINES),
    ]
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
    figures, missing = list(results.rows), run.missing
    name, metric = METRICS[run.measures.main], f"{run.measures.main}_drop"
    dropped = [Column(SPLITS[s], s, SHORT, metric, percent=True, paper="lpips_drop") for s in SHIFTED]
    drops = TableSpec("", dropped, FRAME_LINES)
    texts = {
        "test": "Six objects, caption colours that were seen in training: what everything else is held against.",
        "unseen_colors": "Captions name CLIPort's test colours; no training sentence had pink, purple, white and "
        "orange. The paper's figures come from other pictures: compare their order, not their height.",
        "more_objects": "Eight objects; training had six.",
    }
    best, worst = best_and_worst(found["imagined clips"])
    ranked = f"By whether ours shows what was asked, then by its {name} at {LENGTHS[-1]} frames."
    watched = "Failures where there are any. Left: each chosen plan, imagined. Right: the camera."
    light = (
        "The test set's first pictures, changed, and its sentences, reworded: another verb, preposition, noun, order, "
        "politeness, capitals for each scene. The true masks say which slots are block and bowl."
    )
    judged = "Dots with 95 % intervals over scenes, judged by the simulator."
    return [
        Section(
            "The bars",
            "Fixed before anything was measured. A drop is how much worse a figure is than on the test set, relative "
            f"to it; for {name}, how much it grows. {TRAINED_LITTLE}",
            [
                bars_table(results, run.measures),
                plot_table("drops.png", drops, figures, label=f"{name} drop at {SHORT}, %", limits=None),
                plot_table("closed_loop.png", LOOP_TABLE, figures, label="closed-loop success", caption=judged),
            ],
        ),
        *(
            Section(SPLITS[s].capitalize(), text, [spec.table(figures, missing) for spec in SPLIT_TABLES[s]])
            for s, text in texts.items()
        ),
        Section("Other light, other words", light, [spec.table(figures, missing) for spec in change_tables(REFERENCE)]),
        Section("The best cases", f"{ranked} Below: masks, one colour a thing.", [Clips(best)]),
        Section("The worst cases", ranked, [Clips(worst)]),
        Section("Planned beside executed", watched, [Clips(found["robot clips"])]),
        Section("What is absent", " ".join(run.remarks) or "Nothing."),
    ]


def cards(run: Run, results: Results) -> list[CardSpec]:
    """Success on every split against its bar, drops against MAGE's and the paper's, and the floor."""
    made, measures, ours = [], run.measures, METHODS["ours"]
    bars = {bar.split: f"bar {bar.least:.2f}: {verdict(bar, results)}" for bar in BARS if bar.least}
    success = {split: Column("", split, WHOLE, "closed_loop_success") for split in SPLITS}
    for split, name in SPLITS.items():
        made.append(CardSpec(f"Closed loop, {name}", ours, success[split], bars.get(split, "")))
    for bar in (bar for bar in BARS if bar.least is None):
        column = Column("", bar.split, SHORT, f"{measures.main}_drop", percent=True)
        mage = Cell.of(results.find("MAGE", SHORT, column.metric, bar.split), percent=True).text
        assert ours.paper is not None
        paper = as_percent(ours.paper.figures[bar.split, SHORT, "lpips_drop"])
        made.append(CardSpec(bar.title(measures), ours, column, f"MAGE {mage}, paper {paper} (LPIPS)"))
    floor, label = SHIFTED[0], f"Closed loop, random candidate, {SPLITS[SHIFTED[0]]}"
    return [*made, CardSpec(label, METHODS["random candidate"], success[floor], "the floor")]


STUDY = Study(
    name="robustness",
    title="Robustness",
    question="Colours that no training sentence named, and two objects more than ever before: what is lost?",
    args=ScenesArgs,
    sizes=sizes_of,
    horizon=HORIZON,
    methods=(*IMAGINING, *ACTING),
    measures=lambda args: available(),
    inputs=lambda args: [FREE],
    units=units,
    cases=cases,
    rows=rows,
    tables=[*SHORT_TABLES, LOOP_TABLE, *change_tables(REFERENCE)],
    printed=lambda run, results: [bars_table(results, run.measures)],
    page=page,
    cards=cards,
    headline=headline,
    first=(*(f"closed_loop_{split}" for split in SPLITS), *(f"lpips_drop_{split}" for split in SHIFTED)),
)

if __name__ == "__main__":
    start(STUDY)
