"""Prediction quality: how much do imagined frames look like what then happens?

    python experiments/prediction.py              # default: some minutes on 2 cores
    python experiments/prediction.py --quick      # a first look

The paper's first study (its section 4.2), on held-out scenes of the tabletop: PSNR, SSIM, LPIPS, ST-LPIPS and JEDi over
9, 19 and 24 frames (a whole episode), and frame by frame up to 40. TextOCVP stands beside OCVP-Seq (slots, no text),
Non-OC and MAGE (text, no slots), and beside three controls: the first frame repeated, ours with a wrong sentence, and
parser and renderer on the true frames. A model that is not trained and a metric whose weights are not on this machine
are absent with the reason. Writes `results.json`, `report.html`, plots and clips into `--out`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.protocol.arguments import StudyArgs, UsageError, start
from experiments.protocol.contenders import FAR, Contender, LoadVideo, LoadVideoModel, find_contenders, hashes
from experiments.protocol.film_gallery import FilmPicture, extremes, halves
from experiments.protocol.frame_scores import METRICS, Measures, available_measures
from experiments.protocol.prediction import (
    LENGTHS,
    SPLIT,
    PredictionOutcome,
    PredictionScene,
    frame_rows,
    jedi_rows,
    length_rows,
)
from experiments.protocol.prediction_report import build_report, episode_table, paper_table, upper_table
from experiments.protocol.running import StudyRun
from experiments.protocol.scenes import test_scenes
from experiments.protocol.workers import LoadWorldModel
from experiments.reporting import Results, Row, StudyProgress
from textocvp.metrics.jedi import VJEPA

# Who is in the headline figures, by the ending of their names.
NAMED = {
    "ours": "",
    "OCVP-Seq": "_ocvp_seq",
    "Non-OC": "_non_oc",
    "MAGE": "_mage",
    "copy frame": "_copy_frame",
}
SECONDS = {"scenes": 6.0, "pictures": 2.0}  # of one unit on one core; they only weigh the progress bar


@dataclass
class Args(StudyArgs):
    """Prediction quality: imagined frames against what the expert then does in the simulator.

    Read the tables from below: `copy frame` is what standing still earns, `wrong text` what moving the wrong thing
    earns, `true frames` what this renderer can earn at best. LPIPS needs the weights of AlexNet and JEDi those of
    V-JEPA 2; without them the report says what to fetch, and ST-LPIPS, whose weights are installed, is measured anyway.
    """

    out: Path = Path("results/prediction")
    """Folder for results.json, report.html, plots and clips."""
    scenes: int = 0
    """Scenes of the test split; 0 for 60, or 8 with --quick."""
    far: str = FAR.checkpoint
    """A checkpoint of ours that looks 40 frames ahead, for the curves."""
    ocvp_seq: str = "ocvp-seq-small"
    """Checkpoint of OCVP-Seq: a bundled name, a folder or a hub id."""
    non_oc: str = "non-oc-small"
    """Checkpoint of Non-OC."""
    mage: str = "mage-small"
    """Checkpoint of MAGE."""
    jedi: str = VJEPA
    """V-JEPA 2 for JEDi: a folder, or a hub id that this machine has fetched before. Its features take about half a
    minute a film on a CPU. A quick run leaves JEDi out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scenes < 0:
            raise UsageError(f"--scenes must be at least 0, got {self.scenes}")

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        sizes = QUICK if self.quick else DEFAULT
        return Sizes(self.scenes or sizes.scenes, sizes.clips)


@dataclass(frozen=True)
class Sizes:
    """How much is measured: scenes of the test split, and how many best and how many worst cases are shown."""

    scenes: int
    clips: int


QUICK = Sizes(scenes=8, clips=4)
DEFAULT = Sizes(scenes=60, clips=10)


def main(
    args: Args,
    load: LoadWorldModel | None = None,
    sizes: Sizes | None = None,
    baselines: Mapping[str, LoadVideoModel] | None = None,
    measures: Measures | None = None,
) -> Results:
    """Run the study and write its folder.

    Args:
        args: the command line.
        load: makes the world model; by default loads `args.checkpoint`.
        sizes: how much is measured; by default what `args` ask for.
        baselines: method -> makes it; by default load the checkpoints that `args` name.
        measures: what is measured; by default all that this machine can.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, before any work is done.
    """
    run, sizes = StudyRun.open("prediction", args, load), sizes or args.sizes
    named = {FAR.method: args.far, "OCVP-Seq": args.ocvp_seq, "Non-OC": args.non_oc, "MAGE": args.mage}
    loads = {method: LoadVideo(name) for method, name in named.items()} if baselines is None else baselines
    contenders, absent = find_contenders(loads)
    if measures is None:
        measures = available_measures(None if args.quick else args.jedi, LENGTHS, "a quick run leaves it out")
    pool = run.pool
    units = [
        PredictionScene(scene, tuple(contenders), measures, args.seed)
        for scene in test_scenes(SPLIT, sizes.scenes, args.seed)
    ]
    parts = {"scenes": len(units), "pictures": min(2 * sizes.clips, len(units))}
    outcomes: list[PredictionOutcome] = []
    with StudyProgress({part: (n, SECONDS[part]) for part, n in parts.items()}) as progress:
        for outcome in progress.track("scenes", pool.run(units)):
            outcomes.append(outcome)
            if len(outcomes) % 4 == 0:
                progress.show(paper_table(length_rows(outcomes), absent))
        rows = [*length_rows(outcomes), *jedi_rows(outcomes), *frame_rows(outcomes, measures.metrics)]
        pictures = choose(outcomes, contenders, measures, args.seed, sizes.clips)
        clips = list(progress.track("pictures", pool.run(pictures)))
    seeds = {"slots": [args.seed], "scenes": [unit.scene.seed for unit in units]}
    results = run.results(rows, headline(rows, measures), seeds, hashes(contenders))
    report = build_report(results, contenders, absent, measures, *halves(clips), run.command)
    run.write(report)
    tables = [paper_table(rows, absent), episode_table(rows, absent), upper_table(rows, absent, measures)]
    run.close(progress, results, tables, [*(one.text for one in absent), measures.absent])
    return results


def choose(
    outcomes: Sequence[PredictionOutcome],
    contenders: Sequence[Contender],
    measures: Measures,
    seed: int,
    count: int,
) -> list[FilmPicture]:
    """The best cases and then the worst ones, by how ours looks over the whole episode, or as far as it looks."""
    metric = measures.main
    means = [float(outcome.of("ours").curves[metric][: LENGTHS[-1]].mean()) for outcome in outcomes]
    badness = [-mean if metric == "ssim" else mean for mean in means]
    cases = list(zip(outcomes, means, strict=True))
    # An episode has 24 frames, so ours is shown once.
    shown = tuple(contender for contender in contenders if contender.method != FAR.method)
    pictures = []
    for best, chosen in zip((True, False), extremes(cases, badness, count), strict=True):
        for rank, (outcome, mean) in enumerate(chosen, start=1):
            caption = f"{METRICS[metric]} {mean:.3f}"
            pictures.append(FilmPicture(outcome.scene, shown, seed, "prediction", rank, best, caption))
    return pictures


def headline(rows: Sequence[Row], measures: Measures) -> dict[str, float]:
    """The figures that are asked for by name: metric, frames, and who, where it is not ours."""
    found = {(row.method, row.variant, row.metric): row.value for row in rows}
    figures = {}
    for metric in (*measures.metrics, "jedi"):
        for length in LENGTHS:
            for method, ending in NAMED.items():
                value = found.get((method, f"{length} frames", metric))
                if value is not None:
                    figures[f"{metric}_{length}{ending}"] = round(value, 4)
    return figures


if __name__ == "__main__":
    start(main, Args)
