"""Robustness: what is lost when colours or the number of objects are new?

    python experiments/robustness.py              # default: some minutes on 2 cores
    python experiments/robustness.py --quick      # a first look

The paper's study (its section 4.5): scenes whose caption colours no training sentence had, and scenes of 8 objects,
against the test set of 6 objects in seen colours. Beyond the paper, masks, goals and the closed loop: a robot plans
with the imagined rollouts, PyBullet executes, and the simulator alone judges. Every figure stands with its relative
drop; TextOCVP stands beside OCVP-Seq, Non-OC and MAGE, and beside controls. Writes `results.json`, `report.html`, plots
and clips into `--out`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.protocol.arguments import StudyArgs, UsageError, start
from experiments.protocol.closed_loop import LoopEpisode, LoopOutcome
from experiments.protocol.contenders import Contender, LoadVideo, LoadVideoModel, find_contenders, hashes
from experiments.protocol.film_gallery import FilmPicture, extremes, halves
from experiments.protocol.frame_scores import METRICS, Measures, available_measures
from experiments.protocol.gallery import choose_loop
from experiments.protocol.predicted import HORIZON
from experiments.protocol.robustness import (
    LENGTHS,
    LOOP_METHODS,
    SHIFTED,
    SPLITS,
    WHOLE,
    RobustOutcome,
    RobustScene,
    difference_rows,
    imagined_columns,
    loop_columns,
    rows_of,
)
from experiments.protocol.robustness_report import bars_table, build_report, frame_table, mask_table
from experiments.protocol.running import StudyRun
from experiments.protocol.scenes import test_scenes
from experiments.protocol.workers import LoadWorldModel
from experiments.reporting import Results, Row, StudyProgress

# Rough seconds of one unit on one core; they only weigh the parts in the progress bar.
SECONDS = {"frames and masks": 4.0, "closed loop": 0.8, "films": 2.0, "robot's films": 1.5}


@dataclass
class Args(StudyArgs):
    """Robustness: unseen caption colours and 8 objects, against the test set.

    The first table holds the bars: closed-loop success of at least .75 and .80, and a drop in LPIPS (or ST-LPIPS, where
    the weights of AlexNet are not there) that is smaller than MAGE's. A model that is not trained is absent with the
    command that trains it.
    """

    out: Path = Path("results/robustness")
    """Folder for results.json, report.html, plots and clips."""
    scenes: int = 0
    """Scenes of each kind, for frames and masks and for the closed loop; 0 for 50, or with --quick 5 and 8."""
    ocvp_seq: str = "ocvp-seq-small"
    """Checkpoint of OCVP-Seq: a bundled name, a folder or a hub id."""
    non_oc: str = "non-oc-small"
    """Checkpoint of Non-OC."""
    mage: str = "mage-small"
    """Checkpoint of MAGE."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scenes < 0:
            raise UsageError(f"--scenes must be at least 0, got {self.scenes}")

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        sizes = QUICK if self.quick else DEFAULT
        most = self.scenes
        return sizes if not most else Sizes(most, most, min(most, sizes.controls), sizes.clips, sizes.acted)


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes of each split.

    Attributes:
        imagined: for frames and masks. loop: for the closed loop, ours and the expert.
        controls: for the random candidate.
        clips: how many best and how many worst cases are shown. acted: how many episodes of the robot.
    """

    imagined: int
    loop: int
    controls: int
    clips: int
    acted: int


QUICK = Sizes(imagined=5, loop=8, controls=4, clips=3, acted=2)
DEFAULT = Sizes(imagined=50, loop=50, controls=25, clips=10, acted=6)


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
        measures: what is measured of frames; by default all that this machine can.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, before any work is done.
    """
    run, sizes = StudyRun.open("robustness", args, load, HORIZON), sizes or args.sizes
    named = {"OCVP-Seq": args.ocvp_seq, "Non-OC": args.non_oc, "MAGE": args.mage}
    loads = {method: LoadVideo(name) for method, name in named.items()} if baselines is None else baselines
    contenders, absent = find_contenders(loads)
    measures = measures or available_measures(None, ())
    pool = run.pool
    scenes = [
        RobustScene(scene, tuple(contenders), measures, args.seed)
        for split in SPLITS
        for scene in test_scenes(split, sizes.imagined, args.seed)
    ]
    episodes = [
        LoopEpisode(method, scene, seed=args.seed)
        for split in SPLITS
        for i, scene in enumerate(test_scenes(split, sizes.loop, args.seed))
        for method in LOOP_METHODS
        if method != "random candidate" or i < sizes.controls
    ]
    parts = {
        "frames and masks": len(scenes),
        "closed loop": len(episodes),
        "films": 2 * min(sizes.clips, sizes.imagined),
        "robot's films": sizes.acted,
    }
    outcomes: list[RobustOutcome] = []
    acted: list[LoopOutcome] = []
    rows: list[Row] = []
    with StudyProgress({part: (n, SECONDS[part]) for part, n in parts.items()}) as progress:
        for outcome in progress.track("frames and masks", pool.run(scenes)):
            outcomes.append(outcome)
            if len(outcomes) % 5 == 0:
                rows = rows_of(imagined_columns(outcomes, measures.metrics))
                progress.show(*(frame_table(rows, split, absent, measures) for split in SPLITS))
        columns = imagined_columns(outcomes, measures.metrics)
        rows = [*rows_of(columns), *difference_rows(columns)]
        for episode in progress.track("closed loop", pool.run(episodes)):
            acted.append(episode)
            if len(acted) % 5 == 0:
                now = [*rows, *rows_of(loop_columns(acted))]
                progress.show(*(mask_table(now, split, absent) for split in SPLITS))
        rows += rows_of(loop_columns(acted))
        films = choose_films(outcomes, contenders, measures, args.seed, sizes.clips)
        names = {(split, 0): name for split, name in SPLITS.items()}
        robot = choose_loop(acted, names, sizes.acted // 2)
        progress.expect("films", len(films))
        progress.expect("robot's films", len(robot))
        clips = list(progress.track("films", pool.run(films)))
        pictures = list(progress.track("robot's films", pool.run(robot)))
    seeds = {"slots": [args.seed], **_seeds(scenes, episodes)}
    results = run.results(rows, headline(rows, measures), seeds, hashes(contenders))
    report = build_report(results, absent, measures, *halves(clips), pictures, run.command)
    run.write(report)
    tables = [
        table
        for split in SPLITS
        for table in (frame_table(rows, split, absent, measures), mask_table(rows, split, absent))
    ]
    remarks = [*(one.text for one in absent), measures.absent]
    run.close(progress, results, [*tables, bars_table(results, measures)], remarks)
    return results


def choose_films(
    outcomes: Sequence[RobustOutcome],
    contenders: Sequence[Contender],
    measures: Measures,
    seed: int,
    count: int,
) -> list[FilmPicture]:
    """The best and then the worst cases of the new kinds of scenes: failures, then by how ours looks."""
    metric = measures.main
    cases, badness = [], []
    for outcome in outcomes:
        if outcome.scene.split not in SHIFTED:
            continue
        ours = outcome.scores[0]
        mean = float(ours.curves[metric].mean())
        good = outcome.success.get("ours")
        cases.append((outcome, mean, good))
        # A failure is worse than any success; the metrics stay well below 1.
        badness.append((-mean if metric == "ssim" else mean) + (10.0 if good is False else 0.0))
    pictures = []
    for best, chosen in zip((True, False), extremes(cases, badness, count), strict=True):
        for rank, (outcome, mean, good) in enumerate(chosen, start=1):
            word = "" if good is None else "success; " if good else "failure; "
            caption = f"{SPLITS[outcome.scene.split]}; {word}{METRICS[metric]} {mean:.3f}"
            scene = outcome.scene
            pictures.append(
                FilmPicture(scene, tuple(contenders), seed, "robustness", rank, best, caption, good)
            )
    return pictures


def headline(rows: Sequence[Row], measures: Measures) -> dict[str, float]:
    """The figures that are asked for by name. Drops in LPIPS are there only with LPIPS or ST-LPIPS."""
    found = {(row.method, row.split, row.variant, row.metric): row.value for row in rows}
    wanted = {f"closed_loop_{split}": ("ours", split, WHOLE, "closed_loop_success") for split in SPLITS}
    if measures.perceptual:
        for split in SHIFTED:
            for method, ending in (("ours", ""), ("MAGE", "_mage")):
                key = (method, split, f"{LENGTHS[0]} frames", f"{measures.main}_drop")
                wanted[f"lpips_drop_{split}{ending}"] = key
    return {name: round(found[key], 4) for name, key in wanted.items() if key in found}


def _seeds(scenes: Sequence[RobustScene], episodes: Sequence[LoopEpisode]) -> dict[str, list[int]]:
    """Every scene's seed, by split and what it was used for."""
    seeds: dict[str, list[int]] = {}
    for split in SPLITS:
        seeds[f"frames and masks, {SPLITS[split]}"] = [u.scene.seed for u in scenes if u.scene.split == split]
        played = [u.scene.seed for u in episodes if u.scene.split == split]
        seeds[f"closed loop, {SPLITS[split]}"] = list(dict.fromkeys(played))
    return seeds


if __name__ == "__main__":
    start(main, Args)
