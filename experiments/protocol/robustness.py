"""The robustness study's unit of work, and its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.protocol.closed_loop import LoopOutcome, Method
from experiments.protocol.contenders import Contender
from experiments.protocol.figures import interval_row, mean_row, rate_row
from experiments.protocol.films import Film, film, slots_of
from experiments.protocol.frame_scores import FrameScores, Measures, Scorer
from experiments.protocol.object_scenes import named_block, score_masks, winners
from experiments.protocol.predicted import HORIZON, judge_rollout
from experiments.protocol.scenes import TestScene
from experiments.protocol.workers import Worker
from experiments.reporting import Row
from planning import PinholeCamera
from textocvp.metrics.intervals import Interval, ratio_interval, relative_change, wilson_interval

#: Split -> name. The first is what the model was trained for; the others are what it was not.
SPLITS = {"test": "test set", "unseen_colors": "unseen colours", "more_objects": "8 objects"}
REFERENCE, *SHIFTED = SPLITS
LENGTHS = (9, 19)
WHOLE = "whole episode"
#: Ours once more, judged as the models without slots must be: our parser reads the masks off the imagined frames.
REREAD = "ours, frames parsed"
LOOP_METHODS: tuple[Method, ...] = ("ours", "expert", "random candidate")
#: Of these less is better: their drop is how much they grow.
DISTANCES = ("lpips", "st_lpips")


@dataclass(frozen=True, eq=False)
class RobustOutcome:
    """One scene, imagined by everybody and measured.

    Attributes:
        scene, text: the scene and its instruction.
        scores: of each film.
        ious: method -> (t,), mask IoU of the blocks and bowls that are seen, frame by frame (Hungarian).
        success: method -> whether its masks show what the sentence says; methods that look 24 frames ahead.
    """

    scene: TestScene
    text: str
    scores: tuple[FrameScores, ...]
    ious: Mapping[str, np.ndarray]
    success: Mapping[str, bool]

    def mean(self, method: str, metric: str, length: int) -> float | None:
        """Mean over the first `length` frames after the observed one; None where it was not measured."""
        if metric == "iou":
            curve = self.ious.get(method, np.empty(0))
            return float(np.nanmean(curve[:length])) if len(curve) >= length else None
        return next((one.mean(metric, length) for one in self.scores if one.method == method), None)


@dataclass(frozen=True)
class RobustScene:
    """A unit of work: one scene, imagined by every model and every control.

    Attributes:
        scene: which. contenders: the baselines. measures: what is measured of frames.
        seed: of the slots.
    """

    scene: TestScene
    contenders: tuple[Contender, ...]
    measures: Measures
    seed: int

    def run(self, worker: Worker) -> RobustOutcome:
        """Imagine, watch, measure."""
        happened, films = film(worker, self.scene, self.contenders, horizon=HORIZON, seed=self.seed)
        scorer = Scorer(happened.film[: LENGTHS[-1] + 1], self.measures, upper=False)
        camera = PinholeCamera.from_info(happened.drawn.info["camera"])
        moved = named_block(happened.drawn)
        ious, success = {}, {}
        for one in [*films, Film(REREAD, films[0].frames)]:
            rollout = slots_of(worker, one, self.seed)
            labels_THW = winners(rollout)[0]
            truth_THW = happened.segmentations[: len(labels_THW)]
            ious[one.method] = score_masks(labels_THW, truth_THW, moved).iou[1:]
            if len(labels_THW) > HORIZON:
                success[one.method] = judge_rollout(rollout, camera, happened.text)
        return RobustOutcome(
            scene=self.scene,
            text=happened.text,
            scores=tuple(scorer.score(Film(one.method, one.frames[: LENGTHS[-1] + 1])) for one in films),
            ious=ious,
            success=success,
        )


@dataclass(frozen=True, eq=False)
class Column:
    """One figure of one method on every split: its rows, and how far it falls.

    Attributes:
        method, variant, metric: what it is.
        values: split -> (N,), one value a scene.
    """

    method: str
    variant: str
    metric: str
    values: Mapping[str, np.ndarray]

    def rows(self) -> list[Row]:
        """A row for each split, and one with the drop for each split that the model was not trained for."""
        make = rate_row if self.metric.endswith("success") else mean_row
        rows = [
            make(self.method, split, self.variant, self.metric, values)
            for split, values in self.values.items()
            if len(values)
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
    ours: Column, other: Column, split: str, *, resamples: int = 2000, seed: int = 0
) -> Interval | None:
    """How much less ours drops than another method, with a bootstrap interval; None where one was not measured.

    Both imagined the same scenes, and which scenes are hard is most of what makes a drop uncertain. So a scene is drawn
    with the figures of both.
    """
    found = [
        [column.values.get(name, np.empty(0)) for name in (REFERENCE, split)] for column in (ours, other)
    ]
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


def difference_rows(columns: Sequence[Column]) -> list[Row]:
    """How much less ours drops than every baseline that was measured in the same way."""
    found = {(column.method, column.variant, column.metric): column for column in columns}
    rows = []
    for (method, variant, metric), other in found.items():
        if metric not in (*DISTANCES, "ssim") or method not in ("OCVP-Seq", "Non-OC", "MAGE"):
            continue
        for split in SHIFTED:
            difference = drop_difference(found["ours", variant, metric], other, split)
            if difference is not None:
                name = f"ours minus {method}"
                rows.append(interval_row(name, split, variant, f"{metric}_drop_difference", difference))
    return rows


def imagined_columns(outcomes: Sequence[RobustOutcome], metrics: Sequence[str]) -> list[Column]:
    """Frames and masks: `metrics` and mask IoU at both lengths, predicted success."""
    by_split = {split: [o for o in outcomes if o.scene.split == split] for split in SPLITS}
    columns = []
    for method in dict.fromkeys(method for outcome in outcomes for method in outcome.ious):
        for metric in (*metrics, "iou"):
            for length in LENGTHS:
                found = {
                    split: [v for o in mine if (v := o.mean(method, metric, length)) is not None]
                    for split, mine in by_split.items()
                }
                columns.append(_column(method, f"{length} frames", metric, found))
        judged = {
            split: [o.success[method] for o in mine if method in o.success]
            for split, mine in by_split.items()
        }
        columns.append(_column(method, WHOLE, "predicted_success", judged))
    return columns


def loop_columns(outcomes: Sequence[LoopOutcome]) -> list[Column]:
    """Success of the robot, judged by the simulator."""
    columns = []
    for method in LOOP_METHODS:
        found = {
            split: [
                o.success for o in outcomes if (o.episode.method, o.episode.scene.split) == (method, split)
            ]
            for split in SPLITS
        }
        columns.append(_column(method, WHOLE, "closed_loop_success", found))
    return columns


def _column(method: str, variant: str, metric: str, values: Mapping[str, Sequence[float]]) -> Column:
    return Column(
        method, variant, metric, {s: np.asarray(v, dtype=np.float64) for s, v in values.items() if len(v)}
    )


def rows_of(columns: Sequence[Column]) -> list[Row]:
    """All rows of all columns."""
    return [row for column in columns for row in column.rows()]
