"""Prediction quality: how much do imagined frames look like what then happens?

    python experiments/prediction.py              # default: some minutes on 2 cores
    python experiments/prediction.py --quick      # a first look

The paper's first study (its section 4.2), on held-out scenes: PSNR, SSIM, LPIPS, ST-LPIPS and JEDi over 9, 19 and 24
frames (a whole episode), and frame by frame up to 40. `copy frame` is what standing still earns, `wrong text` what
moving the wrong thing earns, `true frames` what this renderer can earn at best. LPIPS needs the weights of AlexNet and
JEDi those of V-JEPA 2; without them the report says what to fetch. Writes `results.json`, `report.html`, plots, clips.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.report.page import CardSpec, Clips, Figure, Section
from experiments.report.plots import plot_curves, plot_table
from experiments.report.results import Results
from experiments.report.rows import Key, Row, interval_row, mean_row
from experiments.report.tables import Column, Line, TableSpec
from experiments.study.clips import PredictionClip, best_and_worst, extreme_clips
from experiments.study.frame_metrics import BOTTOM_ROWS, METRICS, PSNR_CAP, UPPER, FrameScores, Measures, Scorer
from experiments.study.frame_metrics import available_measures as available
from experiments.study.methods import BASELINES, HORIZON, METHODS, OURS_40, TRAINED_LITTLE, Model, lines
from experiments.study.pool import Unit, Worker
from experiments.study.predictions import predict
from experiments.study.run import Found, Part, Run, ScenesArgs, Study, start
from experiments.study.scenes import StudyScene, study_scenes
from textocvp.metrics.jedi import VJEPA, jedi

SPLIT = "test"
LENGTHS = (9, 19, HORIZON)  # the paper's two, and a whole episode
FARTHEST = 40  # how far the curves go, for models that can look as far
IMAGINING = ("ours", OURS_40, *BASELINES, "true frames", "wrong text", "copy frame")
LINES = lines(IMAGINING)
SEER = "not run: 406 M parameters, fine-tuned from weights that cannot be rebuilt here"


@dataclass
class Args(ScenesArgs):
    """Arguments of the prediction study."""

    jedi: str = VJEPA
    """V-JEPA 2 for JEDi: a folder, or a hub id that this machine has fetched before. Its features take about half a
    minute a video on a CPU. A quick run leaves JEDi out."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    scenes: int  # of the test split
    clips: int  # how many best and how many worst cases are shown


QUICK, DEFAULT = Sizes(scenes=8, clips=4), Sizes(scenes=60, clips=10)


# --- units of work ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PredictionScene:
    """A unit of work: one scene, imagined by every model and every control."""

    scene: StudyScene
    models: tuple[Model, ...]
    measures: Measures
    seed: int

    def run(self, worker: Worker) -> tuple[FrameScores, ...]:
        """Imagine, watch, measure: every method in the order of the table; last, what JEDi needs of the truth."""
        truth, predictions = predict(worker, self.scene, self.models, horizon=FARTHEST, seed=self.seed)
        scorer = Scorer(truth.frames_T3HW, self.measures, upper=True)
        return *map(scorer.score, predictions), FrameScores("truth", {}, scorer.real_features())


def units(run: Run) -> dict[str, Part]:
    """The scenes."""
    scenes, seed = study_scenes(SPLIT, run.sizes.scenes, run.args.seed), run.args.seed
    work = [PredictionScene(scene, run.models, run.measures, seed) for scene in scenes]
    return {"scenes": Part(work, 4.0), "clips": Part(seconds=1.4, count=min(2 * run.sizes.clips, len(work)))}


def cases(run: Run, found: Found) -> dict[str, Sequence[Unit]]:
    """The best and the worst scenes, by how ours looks over the whole episode, or as far as it looks."""
    metric, seed = run.measures.main, run.args.seed
    means = [float(scores[0].curves[metric][:HORIZON].mean()) for scores in found["scenes"]]
    # An episode is over before it looks farther than ours.
    shown = tuple(model for model in run.models if model.key != OURS_40)
    clips = [
        PredictionClip(scene, shown, seed, "prediction", f"{METRICS[metric]} {mean:.3f}")
        for scene, mean in zip(study_scenes(SPLIT, len(means), seed), means, strict=True)
    ]
    return {"clips": extreme_clips(clips, [*map(run.measures.badness, means)], run.sizes.clips)}


# --- rows -------------------------------------------------------------------------------------------------------------


def frame_rows(outcomes: Sequence[Sequence[FrameScores]]) -> list[Row]:
    """Means over the first so many frames, with and without the bottom rows; then every frame alone."""
    lengths, alone = [], []
    for scores in zip(*outcomes, strict=True):
        place = scores[0].method, SPLIT
        for metric in scores[0].curves:
            curves_NT = np.stack([one.curves[metric] for one in scores])
            means = {n: curves_NT[:, :n].mean(axis=1) for n in LENGTHS if n <= curves_NT.shape[1]}
            lengths += [mean_row(*place, f"{n} frames", metric, means_N) for n, means_N in means.items()]
            if not metric.endswith(UPPER):
                alone += [mean_row(*place, f"frame {t}", metric, its) for t, its in enumerate(curves_NT.T, 1)]
    return [*lengths, *alone]


def jedi_rows(outcomes: Sequence[Sequence[FrameScores]]) -> list[Row]:
    """JEDi at each length; none where its features were not computed."""
    made = []
    for scores in zip(*(outcome[:-1] for outcome in outcomes), strict=True):
        for length in scores[0].features:
            imagined_ND = np.stack([one.features[length] for one in scores])
            distance = jedi(imagined_ND, np.stack([outcome[-1].features[length] for outcome in outcomes]))
            made.append(interval_row(scores[0].method, SPLIT, f"{length} frames", "jedi", distance))
    return made


def headline(run: Run) -> dict[str, Key]:
    """Every metric of whole frames at every length, of ours, the baselines and the first frame repeated."""
    return {
        f"{metric}_{length}{METHODS[method].ending}": (method, SPLIT, f"{length} frames", metric)
        for metric in (*run.measures.metrics, "jedi")
        for length in LENGTHS
        for method in ("ours", *BASELINES, "copy frame")
    }


# --- tables and page --------------------------------------------------------------------------------------------------


def _columns(metrics: Sequence[str], lengths: Sequence[int], view: str = "") -> list[Column]:
    return [
        Column(f"{METRICS[m]} {n}", SPLIT, f"{n} frames", m + view, 2 if m in ("psnr", "jedi") else 3)
        for n in lengths
        for m in metrics
    ]


SHOWN = ("ssim", "lpips", "st_lpips", "jedi")
PAPER_TABLE = TableSpec(
    "9 and 19 frames",
    _columns(SHOWN, LENGTHS[:2]),
    [*LINES[:-3], Line(key="SEER", kind="baseline", note=SEER), *LINES[-3:]],
    "Means over the first 9 and the first 19 imagined frames. SSIM: higher is better; the others: lower.",
)
EPISODE_TABLE = TableSpec(
    "Whole episodes, and PSNR",
    [*_columns(["psnr"], LENGTHS), *_columns(SHOWN, [HORIZON])],
    LINES,
    f"PSNR in dB, higher is better, averaged frame by frame; equal frames count as {PSNR_CAP:g} dB. "
    f"An episode has {HORIZON} frames after the first.",
)
UPPER_TABLE = TableSpec(
    "Without the bottom rows", _columns(SHOWN[:3], LENGTHS, UPPER), LINES,
    f"The same without the lowest {BOTTOM_ROWS} rows of pixels. The robot stands beyond the upper edge and hardly ever "
    "reaches down there. So these rows are mostly still table, which is easy.",
)  # fmt: skip


def page(run: Run, results: Results, found: Found) -> list[Section]:
    """The sections of the report."""
    figures, metric = list(results.rows), run.measures.main
    paper, *more = run.tables(figures)
    by_length = TableSpec("", _columns([metric], LENGTHS), LINES)
    models = [("ours", run.checkpoint.name, run.world_model.longest_horizon)]
    models += [(one.key, one.checkpoint, one.longest) for one in run.models]
    ahead = "; ".join(f"{key} ({name}): {longest or 'any number'}" for key, name, longest in models)
    best, worst = best_and_worst(found["clips"])
    cases = f"By {METRICS[metric]} of ours over the whole episode. Below the pictures: the slots' masks beside the "
    cases += "simulator's segmentation, one colour a thing; for models without slots, what our parser sees."
    return [
        Section(
            "As in the paper's table",
            "Every model sees the first frame of a held-out scene and the sentence, and imagines; the expert carries "
            "the sentence out in the simulator; frames are compared one by one. The paper's figures come from other "
            f"pictures: compare orders and distances, not heights. {TRAINED_LITTLE} What a dash stands for is said in "
            "the last section.",
            [paper, plot_table("lengths.png", by_length, figures, label=_label(metric), limits=None), *more],
        ),
        Section(
            "Over time",
            f"Curves go to {FARTHEST} frames for models that can look as far. An episode is over after {HORIZON}; from "
            "then on the real video is its last frame, in which the arm rests: in the simulator, frames after the end "
            "differ from it by less than .2 of 255 grey levels in the mean. Frames that each model imagines at once: "
            f"{ahead}.",
            [_curves(figures, metric) for metric in run.measures.metrics],
        ),
        Section("The best cases", cases, [Clips(best)]),
        Section("The worst cases", cases, [Clips(worst)]),
        Section("What is absent", " ".join([*run.remarks, f"SEER is absent: {SEER}."])),
    ]


def _label(metric: str) -> str:
    better = "higher" if metric in ("psnr", "ssim") else "lower"
    return f"{METRICS[metric]}{' in dB' if metric == 'psnr' else ''}, {better} is better"


def _curves(figures: Sequence[Row], metric: str) -> Figure:
    over_time = [Column("", SPLIT, f"frame {t}", metric) for t in range(1, FARTHEST + 1)]
    spec = TableSpec("", over_time, LINES, "Bands: 95 % intervals over scenes.")
    return plot_curves(f"{metric}.png", spec, figures, label=_label(metric))


def cards(run: Run, results: Results) -> list[CardSpec]:
    """Ours at each length beside MAGE and the first frame repeated, and what it could reach at best and at worst."""

    def card(method: str, column: Column) -> CardSpec:
        rivals = [(m, results.find(m, column.variant, column.metric)) for m in ("MAGE", "copy frame")]
        compare = ", ".join(f"{m} {row.value:.{column.digits}f}" for m, row in rivals if row is not None)
        return CardSpec(f"{column.title} frames, {method}", METHODS[method], column, compare, bar=False)

    made = [card("ours", column) for column in _columns(("ssim", *run.measures.perceptual[-1:]), LENGTHS)]
    (whole,) = _columns([run.measures.main], [HORIZON])
    return [*made, card("true frames", whole), card("wrong text", whole)]


STUDY = Study(
    name="prediction",
    title="Prediction quality",
    question="One frame and a sentence: how much do the imagined frames look like what then happens?",
    args=Args,
    sizes=lambda args: replace(s := QUICK if args.quick else DEFAULT, scenes=args.scenes or s.scenes),
    methods=IMAGINING,
    measures=lambda args: available(
        jedi=None if args.quick else args.jedi, jedi_lengths=LENGTHS, without_jedi="a quick run leaves it out"
    ),
    units=units,
    cases=cases,
    rows=lambda run, found: [*frame_rows(found["scenes"]), *jedi_rows(found["scenes"])],
    tables=(PAPER_TABLE, EPISODE_TABLE, UPPER_TABLE),
    page=page,
    cards=cards,
    headline=headline,
    first=("ssim_9", "ssim_9_mage", "st_lpips_9", "st_lpips_9_mage"),
)

if __name__ == "__main__":
    start(STUDY)
