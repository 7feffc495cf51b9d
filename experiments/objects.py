"""Objects: do the imagined masks stay on the things that the simulator says are there?

    python experiments/objects.py              # default: a few minutes on 2 cores
    python experiments/objects.py --quick      # a first look

Mask IoU (paper, section 4.3) and foreground ARI of what is imagined from one frame and a sentence, against the
simulator's segmentation of what the expert then did. Beside it: the first frame's masks held still (Copy-Seed), the
parser on the true frames (the ceiling), OCVP-Seq, which hears no text, and the same model under a wrong sentence. Since
most objects stand still, everything is measured once more on the named block and the arm alone. Writes `results.json`,
`report.html`, plots and clips into `--out`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from experiments.protocol.arguments import StudyArgs, start
from experiments.protocol.contenders import FAR, Absent, LoadVideo, find_contenders
from experiments.protocol.figures import mean_row
from experiments.protocol.object_gallery import ObjectPictures, choose_objects
from experiments.protocol.object_report import (
    METHODS,
    METRICS,
    MINUS,
    SPLIT,
    build_report,
    frame_at,
    iou_table,
    mean_to,
)
from experiments.protocol.object_scenes import LENGTHS, MaskScores, ObjectOutcome, ObjectScene
from experiments.protocol.running import StudyRun
from experiments.protocol.scenes import test_scenes
from experiments.protocol.workers import LoadWorldModel
from experiments.reporting import Results, Row, StudyProgress


@dataclass
class Args(StudyArgs):
    """Object study: mask IoU and foreground ARI of imagined masks against the simulator's segmentation.

    Scenes come from the test seeds; the expert plays each, the model imagines it from the first frame and the sentence.
    Read the table's rows from below: `copy seed` is what standing still earns, `wrong text` what moving the wrong thing
    earns, `true frames` what this parser can earn at best. Further than 24 frames is measured where the checkpoint can
    look as far: a causal predictor stops at what it was trained for, the published moving window at 40.
    """

    out: Path = Path("results/objects")
    """Folder for results.json, report.html, plots and clips."""
    ocvp_seq: str = "ocvp-seq-small"
    """Checkpoint of OCVP-Seq, the baseline without text: a bundled name, a folder or a hub id."""
    far: str = FAR.checkpoint
    """A checkpoint of ours that looks 40 frames ahead, for the curves."""

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        return QUICK if self.quick else DEFAULT

    def others(self) -> tuple[dict[str, LoadWorldModel], list[Absent]]:
        """The other models that imagine, and those that are not there."""
        found, absent = find_contenders(
            {FAR.method: LoadVideo(self.far), "OCVP-Seq": LoadVideo(self.ocvp_seq)}
        )
        # Both have slots, so what loads is a world model.
        loads = {one.method: cast(LoadWorldModel, one.load) for one in found}
        return loads, absent


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        scenes: of the test split.
        clips: how many best and how many worst scenes the report shows.
        apart: of how many of them every slot is drawn alone.
    """

    scenes: int
    clips: int
    apart: int


QUICK = Sizes(scenes=24, clips=10, apart=1)
DEFAULT = Sizes(scenes=100, clips=10, apart=2)
SECONDS = {"scenes": 4.0, "pictures": 2.0}  # of one unit on one core; they only weigh the progress bar


def main(
    args: Args,
    load: LoadWorldModel | None = None,
    sizes: Sizes | None = None,
    others: Mapping[str, LoadWorldModel] | None = None,
) -> Results:
    """Run the study and write its folder.

    Args:
        args: the command line.
        load: makes the world model; by default loads `args.checkpoint`.
        sizes: how much is measured; by default what `args` ask for.
        others: method -> makes the model that it imagines with; by default those that `args` name.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, before any work is done.
    """
    run, sizes = StudyRun.open("objects", args, load), sizes or args.sizes
    absent: list[Absent] = []
    if others is None:
        others, absent = args.others()
    pool = run.pool
    named = tuple(others.items())
    units = [ObjectScene(scene, args.seed, named) for scene in test_scenes(SPLIT, sizes.scenes, args.seed)]
    parts = {"scenes": len(units), "pictures": 2 * min(sizes.clips, len(units))}
    outcomes: list[ObjectOutcome] = []
    with StudyProgress({part: (n, SECONDS[part]) for part, n in parts.items()}) as progress:
        for outcome in progress.track("scenes", pool.run(units)):
            outcomes.append(outcome)
            if len(outcomes) % 4 == 0:
                progress.show(iou_table(method_rows(outcomes, ["iou"]), "iou", "Mask IoU", single=False))
        chosen = choose_objects(outcomes, args.seed, sizes.clips, sizes.apart)
        pictures: list[ObjectPictures] = list(progress.track("pictures", pool.run(chosen)))
    rows = [*method_rows(outcomes, list(METRICS)), *difference_rows(outcomes)]
    seeds = {"slots": [args.seed], f"scenes, {SPLIT}": [unit.scene.seed for unit in units]}
    versions = {f"checkpoint of {method}": load().checkpoint.sha256 for method, load in named}
    results = run.results(rows, headline(rows), seeds, versions)
    run.write(build_report(results, outcomes, pictures, absent, run.command))
    tables = [
        iou_table(rows, "iou", "Mask IoU, all blocks and bowls", paper=True, single=False),
        iou_table(rows, "iou_moving", "Mask IoU, named block and arm", single=False),
    ]
    run.close(progress, results, tables, [one.text for one in absent])
    return results


def method_rows(outcomes: Sequence[ObjectOutcome], metrics: Sequence[str]) -> list[Row]:
    """Every method's figures: the mean up to each length, and that frame alone, as far as it can look ahead."""
    rows = []
    for method in METHODS:
        mine = [outcome.scores[method] for outcome in outcomes if method in outcome.scores]
        for metric in metrics:
            for length in LENGTHS:
                if not mine or len(mine[0].iou) <= length:
                    continue
                curves = np.stack([_curve(scores, metric)[: length + 1] for scores in mine])
                for variant, values in ((mean_to(length), _means(curves)), (frame_at(length), curves[:, -1])):
                    if not np.isnan(values).all():
                        rows.append(mean_row(method, SPLIT, variant, metric, values))
    return rows


def difference_rows(outcomes: Sequence[ObjectOutcome]) -> list[Row]:
    """Ours minus each other method, within each scene."""
    rows = []
    for method in METHODS:
        if method in ("ours", FAR.method) or any(method not in outcome.scores for outcome in outcomes):
            continue
        for metric in ("iou", "iou_moving"):
            for length in LENGTHS:
                pairs = [(outcome.scores["ours"], outcome.scores[method]) for outcome in outcomes]
                if min(len(scores.iou) for pair in pairs for scores in pair) <= length:
                    continue
                ours, other = (
                    _means(np.stack([_curve(scores, metric)[: length + 1] for scores in side]))
                    for side in zip(*pairs, strict=True)
                )
                rows.append(mean_row(MINUS + method, SPLIT, mean_to(length), metric, ours - other))
    return rows


def _curve(scores: MaskScores, metric: str) -> np.ndarray:
    curve: np.ndarray = getattr(scores, METRICS[metric])
    return curve


def _means(curves_NT: np.ndarray) -> np.ndarray:
    """Mean over the predicted frames in which there was something to see."""
    predicted = curves_NT[:, 1:]
    seen = ~np.isnan(predicted)
    sums = np.where(seen, predicted, 0.0).sum(axis=1)
    return np.where(seen.any(axis=1), sums / np.maximum(seen.sum(axis=1), 1), np.nan)


def headline(rows: Sequence[Row]) -> dict[str, float]:
    """The figures that are asked for by name; OCVP-Seq's only where it was measured."""
    found = {(row.method, row.variant, row.metric): row.value for row in rows}
    names = {
        "ours": "",
        "copy seed": "_copy_seed",
        "true frames": "_true_frames",
        "wrong text": "_wrong_text",
    }
    wanted = {
        f"{metric}{name}_{length}": (method, mean_to(length), key)
        for metric, key in (("iou", "iou"), ("iou_moving", "iou_moving"), ("ari", "foreground_ari"))
        for method, name in names.items()
        for length in LENGTHS[:3]
    }
    named = {name: round(found[key], 4) for name, key in wanted.items() if key in found}
    for length in LENGTHS[:3]:
        key = ("OCVP-Seq", mean_to(length), "iou")
        if key in found:
            named[f"iou_ocvp_seq_{length}"] = round(found[key], 4)
    return named


if __name__ == "__main__":
    start(main, Args)
