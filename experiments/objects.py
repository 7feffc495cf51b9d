"""Objects: do the imagined masks stay on the things that the simulator says are there?

    python experiments/objects.py              # default: a few minutes on 2 cores
    python experiments/objects.py --quick      # a first look

Mask IoU (paper, section 4.3) and foreground ARI of what is imagined from one frame and a sentence, against the
simulator's segmentation of what the expert then did. Most objects stand still, so everything is measured once more on
the named block and the arm alone. `copy seed` is what standing still earns, `wrong text` what moving the wrong thing
earns, `true frames` what this parser can earn at best. Writes `results.json`, `report.html`, plots and clips.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch

from experiments.report.page import CardSpec, Clips, Figure, Section
from experiments.report.plots import picture_grid, plot_curves, plot_table
from experiments.report.results import Results
from experiments.report.rows import Key, Row, mean_row
from experiments.report.tables import Column, Line, TableSpec
from experiments.study.clips import PredictionClip, extreme_clips
from experiments.study.mask_metrics import MaskScores, mean_known, score_masks
from experiments.study.methods import HORIZON, METHODS, OURS_40, TRAINED_LITTLE, Model, lines
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import hold_last, predict, to_uint8
from experiments.study.run import Found, Part, Run, Study, start
from experiments.study.scenes import StudyScene, study_scenes
from planning import Instruction, SegmentationGrounder
from textocvp.metrics import slot_labels

SPLIT = "test"
FARTHEST = 40  # predicted frames, for models that can look as far
LENGTHS = (9, 19, HORIZON, FARTHEST)  # the paper's two, a whole episode, and far beyond it
MOMENTS = (0, 4, 9, 14, 19, 24)  # that a strip shows
OTHERS = ("true frames", "OCVP-Seq", "copy seed", "wrong text")
LINES = lines(["ours", OURS_40, *OTHERS])
# Metric -> field of `MaskScores`, and title of its column.
METRICS = {
    "iou": ("iou", "all"), "iou_moving": ("moving", "moving"), "iou_named_block": ("block", "named block"),
    "iou_arm": ("arm", "arm"), "iou_still": ("still", "still objects"), "iou_kept": ("kept", "kept slot"),
    "iou_kept_moving": ("kept_moving", "kept slot, moving"), "foreground_ari": ("ari", "foreground ARI"),
}  # fmt: skip
Outcomes = Sequence[Mapping[str, MaskScores]]
"""Of every scene by method. One that cannot look as far ahead as another has fewer frames."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: int  # of the test split
    clips: int  # how many best and how many worst scenes the report shows
    apart: int  # of how many of them every slot is drawn alone


QUICK, DEFAULT = Sizes(scenes=24, clips=10, apart=1), Sizes(scenes=100, clips=10, apart=2)


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ObjectScene:
    """A unit of work: one scene under all methods."""

    scene: StudyScene
    models: tuple[Model, ...]
    seed: int

    def run(self, worker: Worker) -> Mapping[str, MaskScores]:
        """Imagine it, play it, compare."""
        truth, predictions = predict(worker, self.scene, self.models, horizon=FARTHEST, seed=self.seed)
        labels = {one.method: slot_labels(one.rollout.masks[0]) for one in predictions if one.rollout is not None}
        longest = max(map(len, labels.values()))
        labels["copy seed"] = hold_last(labels["ours"][:1], longest)
        labels["true frames"] = hold_last(labels["true frames"], longest)
        true_THW, block = truth.segmentations_THW, truth.sampled.named_block
        return {key: score_masks(its, true_THW[: len(its)], block) for key, its in labels.items()}


@dataclass(frozen=True)
class SlotStrip:
    """A unit of work: what the camera sees, what is imagined, and every thing cut out of that, at some moments."""

    clip: PredictionClip  # of the same scene

    def run(self, worker: Worker) -> Figure:
        """Imagine and play it once more."""
        scene, seed, place = self.clip.scene, self.clip.seed, self.clip.place
        truth, (ours,) = predict(worker, scene, (), horizon=HORIZON, seed=seed, controls=False)
        assert ours.rollout is not None
        times = [t for t in MOMENTS if t < len(ours.frames_T3HW)]
        rows = {"camera": truth.frames_THW3[times], "imagined": to_uint8(ours.frames_T3HW[times])}
        objects_tK3HW, masks_tKHW = ours.rollout.decode_objects(times)[0], ours.rollout.decode_masks(times)[0]
        seen = SegmentationGrounder.from_info(truth.sampled.info)(ours.rollout)
        named = Instruction.parse(truth.text).things
        things = sorted(seen.things, key=lambda thing: (thing not in named, thing.kind, thing.color))
        slots = {f"{thing}{' (named)' if thing in named else ''}": seen.things[thing] for thing in things}
        for name, its in {**slots, "arm": seen.arm, "table": seen.background}.items():
            if its:
                rows[name] = _cut_out(objects_tK3HW[:, list(its)], masks_tKHW[:, list(its)])
        return picture_grid(
            f"objects-apart-{place.replace(' ', '-')}.png",
            [list(row) for row in rows.values()], list(rows), [f"frame {t}" for t in times],
            alt=f"{truth.text}: what each slot shows",
            caption=f"{place}: {truth.text}. Below the whole frames: each slot drawn alone, by its own mask.",
        )  # fmt: skip


def _cut_out(objects_tk3HW: torch.Tensor, masks_tkHW: torch.Tensor) -> np.ndarray:
    """Some slots together on nothing: (t, H, W, 4) uint8, as transparent as the other slots cover them."""
    alpha_t1HW = masks_tkHW.sum(1, keepdim=True)
    color_t3HW = (objects_tk3HW * masks_tkHW[:, :, None]).sum(1) / alpha_t1HW.clamp_min(1e-6)
    return to_uint8(torch.cat([color_t3HW, alpha_t1HW], dim=1).clamp(0, 1))


def units(run: Run) -> dict[str, Part]:
    """The scenes."""
    scenes, sizes = study_scenes(SPLIT, run.sizes.scenes, run.args.seed), run.sizes
    return {
        "scenes": Part([ObjectScene(scene, run.models, run.args.seed) for scene in scenes], 0.7),
        "clips": Part(seconds=0.2, count=min(2 * sizes.clips, len(scenes))),
        "slots apart": Part(seconds=0.5, count=min(2 * sizes.apart, len(scenes))),
    }


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """The best and the worst scenes by the overlap of what moves; of the first of them, every slot drawn alone."""
    moving = [float(np.nanmean(scores["ours"].moving[1:])) for scores in found["scenes"]]
    clips = [
        PredictionClip(scene, (), run.args.seed, "objects", f"block and arm overlap by {value:.2f}")
        for scene, value in zip(study_scenes(SPLIT, len(moving), run.args.seed), moving, strict=True)
    ]
    clips = extreme_clips(clips, [-value for value in moving], run.sizes.clips)
    strips = [SlotStrip(clip) for clip in clips if clip.rank <= run.sizes.apart]
    return {"clips": clips, "slots apart": strips}


# --- rows -------------------------------------------------------------------------------------------------------------


def method_rows(found: Outcomes, metrics: Iterable[str], lengths: Sequence[int] = LENGTHS) -> list[Row]:
    """Every method's figures: the mean up to each length, and that frame alone, as far as it can look ahead."""
    made = []
    for line, metric in product(LINES, metrics):
        curves_NT = _predicted(found, line.key, metric)
        for n in (n for n in lengths if n <= curves_NT.shape[1]):
            means_N, alone_N = mean_known(curves_NT[:, :n], axis=1), curves_NT[:, n - 1]
            for variant, values_N in ((f"frames 1-{n}", means_N), (f"frame {n}", alone_N)):
                if not np.isnan(values_N).all():  # something was seen
                    made.append(mean_row(line.key, SPLIT, variant, metric, values_N))
    return made


def difference_rows(found: Outcomes) -> list[Row]:
    """Ours minus each other method, within each scene."""
    made = []
    for method, metric in product(OTHERS, ("iou", "iou_moving")):
        ours, other = (_predicted(found, one, metric) for one in ("ours", method))
        for n in (n for n in LENGTHS if n <= min(ours.shape[1], other.shape[1])):
            values_N = mean_known(ours[:, :n], axis=1) - mean_known(other[:, :n], axis=1)
            made.append(mean_row(f"ours minus {method}", SPLIT, f"frames 1-{n}", metric, values_N))
    return made


def _predicted(found: Outcomes, method: str, metric: str) -> np.ndarray:
    """(N, T) a metric of every scene in every predicted frame; T is 0 for a method that was not measured."""
    curves = [getattr(scores[method], METRICS[metric][0])[1:] for scores in found if method in scores]
    return np.stack(curves) if curves else np.empty((0, 0))


def headline(run: Run) -> dict[str, Key]:
    """The means over the first 9, 19 and 24 frames."""
    metrics = {"iou": "iou", "iou_moving": "iou_moving", "ari": "foreground_ari"}
    wanted = product(metrics, ("ours", "copy seed", "true frames", "wrong text"))
    return {
        f"{name}{METHODS[key].ending}_{n}": (key, SPLIT, f"frames 1-{n}", metrics[name])
        for name, key in (*wanted, ("iou", "OCVP-Seq"))
        for n in LENGTHS[:3]
    }


# --- tables and page --------------------------------------------------------------------------------------------------


def _table(title: str, metric: str, variants: Iterable[str], caption: str = "") -> TableSpec:
    return TableSpec(title, [Column(v, SPLIT, v, metric, 3) for v in variants], LINES, caption)


MEANS, ALONE = [f"frames 1-{n}" for n in LENGTHS], [f"frame {n}" for n in LENGTHS]
IOU = _table("Mask IoU, all blocks and bowls", "iou", MEANS)
MOVING = _table("Mask IoU, named block and arm", "iou_moving", MEANS)
ARI = _table("Foreground ARI", "foreground_ari", MEANS)


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures, missing = list(results.rows), run.missing
    measured = [variant for variant in MEANS if results.find("ours", variant, "iou")]
    titles = {metric: title for metric, (_, title) in METRICS.items()}
    apart = TableSpec(
        f"Apart, mean of {measured[-1]}",
        [Column(titles[metric], SPLIT, measured[-1], metric, 3) for metric in list(METRICS)[2:]],
        LINES,
        "Kept slot: each object against the one slot that had it in the first frame.",
    )
    differences = TableSpec(
        "Mask IoU, difference",
        [Column(f"{titles[m]}, {v}", SPLIT, v, m, 3) for m in ("iou", "iou_moving") for v in measured],
        [Line(key=f"ours minus {method}", kind=METHODS[method].kind) for method in OTHERS],
        "Differences within the same scene, so their intervals are narrower than those of the figures.",
    )

    def curves(metric: str, label: str) -> Figure:
        every = range(1, FARTHEST + 1)
        spec = _table("", metric, [f"frame {n}" for n in every], "Mean over scenes, 95 % intervals.")
        return plot_curves(f"{metric}.png", spec, method_rows(found["scenes"], [metric], every), label=label)

    return [
        Section(
            "Mask IoU against the simulator",
            "Slots are matched to the blocks and bowls that are seen, anew in every frame (Hungarian), and overlaps "
            "are averaged over objects, frames, and then scenes. The paper's figures come from another renderer of the "
            "task, at 336x336, so their order matters more than their height. When an episode is over, its last frame "
            f"stays. {TRAINED_LITTLE} {' '.join(run.remarks)}",
            [
                _table("All blocks and bowls", "iou", [*MEANS, *ALONE]).table(figures, missing),
                plot_table("iou_dots.png", IOU, figures, label="mask IoU"),
                curves("iou", "mask IoU, all objects"),
            ],
        ),
        Section(
            "Only what moves",
            "Most objects stand still, and copying the first frame is right about those. What the sentence decides is "
            "where the named block and the arm go.",
            [
                _table("Named block and arm", "iou_moving", [*MEANS, *ALONE]).table(figures, missing),
                curves("iou_moving", "mask IoU, block and arm"),
                differences.table(figures, missing),
            ],
        ),
        Section(
            "Foreground ARI, and object by object",
            blocks=[apart.table(figures, missing), curves("foreground_ari", "foreground ARI")],
        ),
        Section(
            "Every slot drawn alone",
            "What the renderer makes of one slot, cut out by its mask; named after the simulator's segmentation.",
            found["slots apart"],
        ),
        Section(
            "Imagined beside real",
            "The best and the worst scenes by the overlap of block and arm. Below: masks, one colour a thing.",
            [Clips(found["clips"])],
        ),
    ]


STUDY = Study(
    name="objects",
    title="Objects",
    question="Do the imagined masks stay on the objects, and does the one that is named go where it should?",
    sizes=lambda args: QUICK if args.quick else DEFAULT,
    methods=[line.key for line in LINES],
    units=units,
    cases=cases,
    rows=lambda run, found: [*method_rows(found["scenes"], METRICS), *difference_rows(found["scenes"])],
    tables=(IOU, MOVING, ARI),
    page=page,
    cards=[
        CardSpec(label, METHODS[key], spec.columns[column], compare)
        for label, key, spec, column, compare in (
            ("Mask IoU, 9 frames", "ours", IOU, 0, ""),
            ("Mask IoU, 19 frames", "ours", IOU, 1, ""),
            ("Copy-Seed, 19 frames", "copy seed", IOU, 1, ""),
            ("Parser on true frames, 19", "true frames", IOU, 1, "paper 0.553; the ceiling"),
            ("Block and arm, 19 frames", "ours", MOVING, 1, "not in the paper"),
            ("Block and arm, Copy-Seed", "copy seed", MOVING, 1, "the floor"),
            ("Block and arm, wrong text", "wrong text", MOVING, 1, "should be low"),
            ("Foreground ARI, 19 frames", "ours", ARI, 1, "not in the paper"),
        )
    ],
    headline=headline,
    first=("iou_9", "iou_copy_seed_9", "iou_true_frames_9", "iou_moving_9", "ari_9"),
)

if __name__ == "__main__":
    start(STUDY)
