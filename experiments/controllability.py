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

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.protocol.arguments import StudyArgs, UsageError, start
from experiments.protocol.closed_loop import LoopEpisode, LoopOutcome, Method
from experiments.protocol.controllability_report import build_report, loop_table, predicted_table
from experiments.protocol.figures import mean_row, rate_row
from experiments.protocol.gallery import Picture, choose_loop, choose_predicted
from experiments.protocol.predicted import HORIZON, PredictedOutcome, PredictedScene
from experiments.protocol.running import StudyRun
from experiments.protocol.scenes import LONG_GOALS, LOOP_COLUMNS, LoopColumn, test_scenes
from experiments.protocol.workers import LoadWorldModel, Unit
from experiments.reporting import Results, Row, StudyProgress

VARIANTS = 3
PREDICTED_METHODS = ("ours", "true frames", "wrong text", "copy frame")
LOOP_METHODS: tuple[Method, ...] = ("ours", "ours, privileged", "expert", "random candidate")


@dataclass
class Args(StudyArgs):
    """Controllability study: predicted and in the closed loop."""

    out: Path = Path("results/controllability")
    """Folder for results.json, report.html, plots and clips."""
    full: bool = False
    """100 scenes x 4 instructions x 5 slot seeds, as the paper; takes about an hour."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quick and self.full:
            raise UsageError("--quick and --full exclude each other")

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        return QUICK if self.quick else FULL if self.full else DEFAULT


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes.

    Attributes:
        predicted: of the predicted study. slot_seeds: slot-sampling seeds of each of them.
        loop: of each column of the closed loop with the controllability scenes, for ours and the expert.
        other: of each other column with goals of one step. long: of each column with longer goals.
        controls: at most this many in any column for privileged grounding and the random candidate.
        clips: how many best and how many worst cases the report shows.
    """

    predicted: int
    slot_seeds: int
    loop: int
    other: int
    long: int
    controls: int
    clips: int

    def scenes(self, column: LoopColumn, method: Method) -> int:
        """How many scenes a method plays in a column of the closed loop."""
        steps = LONG_GOALS.get(column.split, 1)
        most = self.long if steps > 1 else self.loop if column.split == "controllability" else self.other
        if method in ("ours", "expert"):
            return most
        return min(most, self.controls if steps == 1 else (self.controls + 1) // 2)


QUICK = Sizes(predicted=12, slot_seeds=1, loop=8, other=4, long=1, controls=3, clips=3)
DEFAULT = Sizes(predicted=100, slot_seeds=1, loop=60, other=30, long=10, controls=20, clips=3)
FULL = Sizes(predicted=100, slot_seeds=5, loop=100, other=100, long=100, controls=100, clips=6)
# Rough seconds of one unit on one core; they only weigh the parts in the progress bar.
SECONDS = {"predicted study": 2.6, "closed loop": 0.8, "long goals": 5.0, "pictures": 1.5}


def main(args: Args, load: LoadWorldModel | None = None, sizes: Sizes | None = None) -> Results:
    """Run the study and write its folder.

    Args:
        args: the command line.
        load: makes the world model; by default loads `args.checkpoint`.
        sizes: how much is measured; by default what `args` ask for.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, before any work is done.
    """
    run, sizes = StudyRun.open("controllability", args, load, HORIZON), sizes or args.sizes
    pool = run.pool
    slot_seeds = tuple(range(args.seed, args.seed + sizes.slot_seeds))
    scenes = test_scenes("controllability", sizes.predicted, args.seed)
    predicted_units = [PredictedScene(scene, VARIANTS, slot_seeds) for scene in scenes]
    episodes = loop_episodes(sizes, args.seed)
    single = [episode for episode in episodes if episode.scene.steps == 1]
    long = [episode for episode in episodes if episode.scene.steps > 1]
    parts = {
        "predicted study": len(predicted_units),
        "closed loop": len(single),
        "long goals": len(long),
        "pictures": 4 * sizes.clips,
    }
    rows: list[Row] = []
    predicted: list[PredictedOutcome] = []
    loop: list[LoopOutcome] = []
    with StudyProgress({part: (n, SECONDS[part]) for part, n in parts.items()}) as progress:
        for outcome in progress.track("predicted study", pool.run(predicted_units)):
            predicted.append(outcome)
            rows = predicted_rows(predicted)
            progress.show(predicted_table(rows))
        for part, some in (("closed loop", single), ("long goals", long)):
            for episode in progress.track(part, pool.run(some)):
                loop.append(episode)
                if len(loop) % 5 == 0:
                    progress.show(predicted_table(rows), loop_table(loop_rows(loop)))
        rows += loop_rows(loop)
        columns = {(column.split, column.variant): column.name for column in LOOP_COLUMNS}
        imagined = choose_predicted(predicted, VARIANTS, slot_seeds[0], sizes.clips)
        acted = choose_loop(loop, columns, sizes.clips)
        progress.expect("pictures", len(imagined) + len(acted))
        units: list[Unit[Picture]] = [*imagined, *acted]
        pictures = list(progress.track("pictures", pool.run(units)))
    results = run.results(rows, headline(rows), seeds_used(slot_seeds, predicted_units, episodes))
    shown = pictures[: len(imagined)], pictures[len(imagined) :]
    report = build_report(results, predicted, timings(loop), *shown, run.command)
    # Times are not in results.json, which must come out the same when a study is repeated.
    run.write(report, {"timings.json": json.dumps(timings(loop), indent=2) + "\n"})
    run.close(progress, results, [predicted_table(rows), loop_table(rows)])
    return results


def loop_episodes(sizes: Sizes, seed: int) -> list[LoopEpisode]:
    """Every episode of the closed loop, column by column."""
    episodes = []
    for column in LOOP_COLUMNS:
        variants = VARIANTS if column.split == "controllability" else 0
        for i, scene in enumerate(test_scenes(column.split, sizes.scenes(column, "ours"), seed)):
            for method in LOOP_METHODS:
                if i < sizes.scenes(column, method):
                    episodes.append(LoopEpisode(method, scene, column.variant, variants, seed))
    return episodes


def predicted_rows(outcomes: Sequence[PredictedOutcome]) -> list[Row]:
    """Success of each method: original, each variant, and the mean of the variants."""
    rows = []
    for method in PREDICTED_METHODS:
        success_NSV = np.stack([outcome.verdicts(method).success_SV for outcome in outcomes])
        for v in range(VARIANTS + 1):
            name = "original" if v == 0 else f"variant {v}"
            rows.append(rate_row(method, "controllability", name, "predicted_success", success_NSV[:, :, v]))
        for name, part in (("variants mean", success_NSV[:, :, 1:]), ("all", success_NSV)):
            rows.append(rate_row(method, "controllability", name, "predicted_success", part))
    return rows


def loop_rows(outcomes: Sequence[LoopOutcome]) -> list[Row]:
    """Success, steps and ranking of each method in each column, as far as there are outcomes."""
    rows = []
    for method in LOOP_METHODS:
        mine = [outcome for outcome in outcomes if outcome.episode.method == method]
        for column in LOOP_COLUMNS:
            here = [
                o
                for o in mine
                if (o.episode.scene.split, o.episode.variant) == (column.split, column.variant)
            ]
            if not here:
                continue
            split, name = column.split, column.name
            rows.append(rate_row(method, split, name, "closed_loop_success", [o.success for o in here]))
            rows.append(mean_row(method, split, name, "steps", [o.steps for o in here]))
            if all(o.ranked_first is not None for o in here):
                rows.append(
                    rate_row(method, split, name, "candidate_ranking", [o.ranked_first for o in here])
                )
        rows += pooled_rows(method, mine)
    return rows


def pooled_rows(method: str, outcomes: Sequence[LoopOutcome]) -> list[Row]:
    """Means over the variants, and over all instructions of the controllability scenes, by scene."""
    by_scene: dict[int, list[LoopOutcome]] = {}
    for outcome in outcomes:
        if outcome.episode.scene.split == "controllability":
            by_scene.setdefault(outcome.episode.scene.seed, []).append(outcome)
    scenes = [scene for scene in by_scene.values() if len(scene) == VARIANTS + 1]
    if not scenes:
        return []
    split = "controllability"
    variants = [[o.success for o in scene if o.episode.variant > 0] for scene in scenes]
    rows = [rate_row(method, split, "variants mean", "closed_loop_success", variants)]
    if all(o.ranked_first is not None for scene in scenes for o in scene):
        ranked = [[o.ranked_first for o in scene] for scene in scenes]
        rows.append(rate_row(method, split, "all", "candidate_ranking", ranked))
    return rows


def headline(rows: Sequence[Row]) -> dict[str, float]:
    """The figures that are asked for by name."""
    wanted = {
        "predicted_original": ("ours", "original", "predicted_success"),
        "predicted_variants_mean": ("ours", "variants mean", "predicted_success"),
        "wrong_text": ("wrong text", "all", "predicted_success"),
        "copy_frame": ("copy frame", "all", "predicted_success"),
        "true_frames": ("true frames", "all", "predicted_success"),
        "closed_loop_original": ("ours", "original", "closed_loop_success"),
        "closed_loop_variants_mean": ("ours", "variants mean", "closed_loop_success"),
        "closed_loop_random": ("random candidate", "original", "closed_loop_success"),
        "candidate_ranking": ("ours", "all", "candidate_ranking"),
    }
    found = {(row.method, row.variant, row.metric): row.value for row in rows}
    return {name: round(found[key], 4) for name, key in wanted.items()}


def seeds_used(
    slot_seeds: Sequence[int], predicted: Sequence[PredictedScene], episodes: Sequence[LoopEpisode]
) -> dict[str, list[int]]:
    """Every seed, by what it was used for."""
    seeds = {"slots": list(slot_seeds), "predicted scenes": [unit.scene.seed for unit in predicted]}
    for episode in episodes:
        known = seeds.setdefault(f"closed loop, {episode.scene.split}", [])
        if episode.scene.seed not in known:
            known.append(episode.scene.seed)
    return seeds


def timings(outcomes: Sequence[LoopOutcome]) -> dict[str, dict[str, float]]:
    """Mean planning seconds, method -> column -> seconds."""
    table: dict[str, dict[str, float]] = {}
    for method in LOOP_METHODS:
        for column in LOOP_COLUMNS:
            seconds = [
                o.planning_seconds
                for o in outcomes
                if (o.episode.method, o.episode.scene.split, o.episode.variant)
                == (method, column.split, column.variant)
                and o.planning_seconds is not None
            ]
            if seconds:
                table.setdefault(method, {})[column.name] = round(float(np.mean(seconds)), 3)
    return table


if __name__ == "__main__":
    start(main, Args)
