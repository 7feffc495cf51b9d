"""Long goals: can the world model imagine several steps ahead, and what does looking again buy?

    python experiments/long_horizon.py              # default: about 12 minutes on 2 cores
    python experiments/long_horizon.py --quick      # a first look
    python experiments/long_horizon.py --full       # 100 scenes a column

Goals of one, two and three steps, and goals whose order matters because a bowl is taken and must be emptied first.
Ours: the planner imagines sequences of instructions, each step from where the last imagined one ended, and carries
out the best; with replanning it looks again after every action. Beside it: the goal's own steps in random order, which
shows what carrying out alone achieves; random steps; and the scripted expert. The simulator alone judges.
Writes `results.json`, `timings.json`, `report.html`, plots and clips into `--out`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.protocol.arguments import StudyArgs, UsageError, start
from experiments.protocol.figures import mean_row, rate_row
from experiments.protocol.long_goals import (
    LONG_COLUMNS,
    METHODS,
    TAKEN,
    LongColumn,
    LongEpisode,
    LongMethod,
    LongOutcome,
    choose_long,
    long_scenes,
)
from experiments.protocol.long_horizon_report import build_report, goals_table, success_table
from experiments.protocol.predicted import HORIZON
from experiments.protocol.running import StudyRun
from experiments.protocol.workers import LoadWorldModel
from experiments.reporting import Results, Row, StudyProgress


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        one, two, three, taken: scenes of each column, for every method.
        clips: how many failures and how many successes the report shows at most.
    """

    one: int
    two: int
    three: int
    taken: int
    clips: int

    def scenes(self, column: LongColumn) -> int:
        """How many scenes every method plays in a column."""
        return {"test": self.one, "two_steps": self.two, "three_steps": self.three, TAKEN: self.taken}[
            column.split
        ]


QUICK = Sizes(one=4, two=4, three=3, taken=3, clips=2)
DEFAULT = Sizes(one=20, two=20, three=20, taken=20, clips=10)
FULL = Sizes(one=100, two=100, three=100, taken=100, clips=10)


@dataclass
class Args(StudyArgs):
    """Long goals in the closed loop."""

    out: Path = Path("results/long_horizon")
    """Folder for results.json, report.html, plots and clips."""
    full: bool = False
    """100 scenes a column; takes about an hour."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quick and self.full:
            raise UsageError("--quick and --full exclude each other")

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        return QUICK if self.quick else FULL if self.full else DEFAULT


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
    run, sizes = StudyRun.open("long_horizon", args, load, HORIZON), sizes or args.sizes
    pool = run.pool
    episodes = {column.name: column_episodes(column, sizes, args.seed) for column in LONG_COLUMNS}
    outcomes: list[LongOutcome] = []
    # Rough seconds of an episode on one core; they only weigh the columns in the progress bar.
    parts = {c.name: (len(episodes[c.name]), 1.0 * c.steps) for c in LONG_COLUMNS}
    with StudyProgress(parts | {"pictures": (2 * sizes.clips, 4.0)}) as progress:
        for name, units in episodes.items():
            for outcome in progress.track(name, pool.run(units)):
                outcomes.append(outcome)
                if len(outcomes) % len(METHODS) == 0:
                    progress.show(success_table(long_rows(outcomes)))
        rows = long_rows(outcomes)
        chosen = choose_long(outcomes, sizes.clips)
        progress.expect("pictures", len(chosen))
        pictures = list(progress.track("pictures", pool.run(chosen)))
    results = run.results(rows, headline(rows), seeds_used(episodes, args.seed))
    seconds = planning_seconds(outcomes)
    # Times are not in results.json, which must come out the same when a study is repeated.
    run.write(
        build_report(results, seconds, pictures, run.command),
        {"timings.json": json.dumps(seconds, indent=2) + "\n"},
    )
    run.close(progress, results, [success_table(rows), goals_table(rows)])
    return results


def column_episodes(column: LongColumn, sizes: Sizes, seed: int) -> list[LongEpisode]:
    """Every episode of a column, scene by scene, so that all methods fill up together."""
    return [
        LongEpisode(method, scene, seed)
        for scene in long_scenes(column, sizes.scenes(column), seed)
        for method in METHODS
        if method.plays(column)
    ]


def long_rows(outcomes: Sequence[LongOutcome]) -> list[Row]:
    """Every figure of every method and column, as far as there are outcomes."""
    rows = []
    for method in METHODS:
        for column in LONG_COLUMNS:
            here = [
                o for o in outcomes if o.episode.method == method and o.episode.scene.split == column.split
            ]
            if here:
                rows += column_rows(method, column, here)
    return rows


def column_rows(method: LongMethod, column: LongColumn, here: Sequence[LongOutcome]) -> list[Row]:
    """The figures of one method in one column."""
    place = method.name, column.split, column.name
    rows = [
        rate_row(*place, "closed_loop_success", [o.success for o in here]),
        rate_row(*place, "subgoals_reached", [o.gained for o in here]),
        mean_row(*place, "steps", [len(o.instructions) for o in here]),
    ]
    if all(o.believes_reached is not None for o in here):
        wrong = [o.believes_reached != o.success for o in here]
        rows.append(rate_row(*place, "wrong_belief", wrong))
    if column.split == TAKEN:
        rows.append(rate_row(*place, "empties_first", [o.empties_first for o in here]))
    return rows


def headline(rows: Sequence[Row]) -> dict[str, float]:
    """The figures that are asked for by name: success by method and column."""
    found = {(row.method, row.split): row.value for row in rows if row.metric == "closed_loop_success"}
    names = {
        "ours, replanning": "closed_loop",
        "ours, one plan": "closed_loop_one_plan",
        "random order, one plan": "random_order_one_plan",
        "random sequence, one plan": "random_sequence_one_plan",
        "expert": "expert",
    }
    columns = {"test": "one_step", "two_steps": "two_steps", "three_steps": "three_steps", TAKEN: TAKEN}
    return {
        f"{name}_{columns[split]}": round(found[method, split], 4)
        for method, name in names.items()
        for split in columns
        if (method, split) in found
    }


def seeds_used(episodes: dict[str, list[LongEpisode]], seed: int) -> dict[str, list[int]]:
    """Every seed, by what it was used for."""
    seeds = {"slots": [seed]}
    for name, units in episodes.items():
        if units:
            seeds[f"scenes, {name}"] = list(dict.fromkeys(unit.scene.seed for unit in units))
    return seeds


def planning_seconds(outcomes: Sequence[LongOutcome]) -> dict[str, dict[str, float]]:
    """Mean planning seconds, method -> column -> seconds."""
    table: dict[str, dict[str, float]] = {}
    for method in METHODS:
        for column in LONG_COLUMNS:
            seconds = [
                o.planning_seconds
                for o in outcomes
                if o.episode.method == method
                and o.episode.scene.split == column.split
                and o.planning_seconds is not None
            ]
            if seconds:
                table.setdefault(method.name, {})[column.name] = round(float(np.mean(seconds)), 3)
    return table


if __name__ == "__main__":
    start(main, Args)
