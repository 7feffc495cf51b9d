"""Ablations: what each choice of architecture is worth, every one trained from the same slots with as many updates.

    python experiments/ablations.py --runs runs/ablations              # default: about 15 minutes on 2 cores
    python experiments/ablations.py --runs runs/ablations --quick      # a first look

    python experiments/train_ablations.py --data data/tabletop-train.h5 --val data/tabletop-val.h5   # trains the runs

Depth, residual connection, text encoder, first slots and decoder, and the number of slots at test time, in the layout
of the paper's tables; and what a robot does that plans with each. Measured on scenes that no training has seen; a run
that is not there is a row that says so and names the command that trains it. Writes `results.json`, `report.html`,
plots and clips into `--out`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.protocol.ablation_report import build_report, parser_table, predictor_table
from experiments.protocol.ablation_rows import (
    SHIPPED,
    SLOT_COUNTS,
    acted_rows,
    following_rows,
    headline,
    parsing_rows,
    slots_name,
)
from experiments.protocol.ablation_runs import RUNS, FoundRun, find_run
from experiments.protocol.ablation_scenes import (
    Entrant,
    FollowingOutcome,
    FollowingScene,
    ParsingOutcome,
    ParsingScene,
)
from experiments.protocol.arguments import StudyArgs, start
from experiments.protocol.closed_loop import LoopEpisode, LoopOutcome, Method
from experiments.protocol.contenders import Contender
from experiments.protocol.film_gallery import FilmPicture, extremes
from experiments.protocol.frame_scores import available_measures
from experiments.protocol.predicted import HORIZON
from experiments.protocol.running import StudyRun
from experiments.protocol.scenes import test_scenes
from experiments.protocol.workers import LoadCheckpoint
from experiments.reporting import Results, StudyProgress
from textocvp.checkpoint import CheckpointError

VARIANTS = 3
SHOWN = ("base", "layers-1", "residual-off", "lexicon-no-bias")
"""Runs whose films are shown, one of each kind."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes.

    Attributes:
        following: of the predictors, with four instructions each. unseen: of unseen caption colours, with one.
        acted: of those with four instructions, how many the robot plays with each predictor.
        parsing: episodes that the parsers take apart. slots: of each number of objects, for every slot count.
        clips: how many best and how many worst cases are shown.
    """

    following: int
    unseen: int
    acted: int
    parsing: int
    slots: int
    clips: int


QUICK = Sizes(following=6, unseen=4, acted=2, parsing=3, slots=3, clips=2)
DEFAULT = Sizes(following=40, unseen=30, acted=20, parsing=20, slots=20, clips=10)


@dataclass
class Args(StudyArgs):
    """Measure the ablation runs."""

    out: Path = Path("results/ablations")
    """Folder for results.json, report.html and plots."""
    runs: Path = Path("runs/ablations")
    """Folder of the runs, from `python experiments/train_ablations.py`."""


def main(args: Args, sizes: Sizes | None = None, slot_counts: Sequence[int] = SLOT_COUNTS) -> Results:
    """Run the study and write its folder.

    Args:
        args: the command line.
        sizes: how much is measured; by default what `args` ask for.
        slot_counts: numbers of slots that the parser is given at test time.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, or a run's configuration is damaged, before any work is done.
    """
    load = LoadCheckpoint(args.checkpoint)
    run, sizes = StudyRun.open("ablations", args, load, HORIZON), sizes or (QUICK if args.quick else DEFAULT)
    found, hashes = look(args.runs)
    shipped = Entrant(SHIPPED, load)
    entrants = {
        stage: (
            shipped,
            *(entrant_of(one) for one in found if one.run.stage == stage and one.state == "trained"),
        )
        for stage in ("predictor", "parser")
    }
    counts = tuple(Entrant(slots_name(k), load, k) for k in slot_counts)
    measures = available_measures(None, ())
    following = [
        *(
            FollowingScene(scene, entrants["predictor"], VARIANTS, args.seed, measures)
            for scene in test_scenes("controllability", sizes.following, args.seed)
        ),
        *(
            FollowingScene(scene, entrants["predictor"], 0, args.seed)
            for scene in test_scenes("unseen_colors", sizes.unseen, args.seed)
        ),
    ]
    parsing = [
        ParsingScene(scene, entrants["parser"], args.seed)
        for scene in test_scenes("test", sizes.parsing, args.seed)
    ]
    counted = [
        scene for split in ("test", "more_objects") for scene in test_scenes(split, sizes.slots, args.seed)
    ]
    players: list[tuple[str, Method, LoadCheckpoint | None]] = [
        ("random candidate", "random candidate", None),
        ("expert", "expert", None),
        *((entrant.name, "ours", entrant.load) for entrant in entrants["predictor"]),
    ]
    acting = [
        (name, LoopEpisode(method, scene, 0, VARIANTS, args.seed, maker))
        for scene in test_scenes("controllability", sizes.acted, args.seed)
        for name, method, maker in players
    ]
    acted: list[LoopOutcome] = []
    followed: list[FollowingOutcome] = []
    parsed: list[ParsingOutcome] = []
    pool = run.pool
    # Rough seconds of a unit on one core; they only weigh the parts in the progress bar.
    parts = {
        "predictors": (len(following), 0.6 * len(entrants["predictor"])),
        "closed loop": (len(acting), 2.0),
        "parsers": (len(parsing), 1.0 * len(entrants["parser"])),
        "slot counts, parsed": (len(counted), 0.5 * len(counts)),
        "slot counts, imagined": (len(counted), 0.2 * len(counts)),
        "pictures": (2 * min(sizes.clips, sizes.following // 2), 6.0),
    }
    with StudyProgress(parts) as progress:
        for outcome in progress.track("predictors", pool.run(following)):
            followed.append(outcome)
            progress.show(predictor_table(following_rows(followed), found))
        acted = list(progress.track("closed loop", pool.run([episode for _, episode in acting])))
        for parsing_outcome in progress.track("parsers", pool.run(parsing)):
            parsed.append(parsing_outcome)
            progress.show(parser_table(parsing_rows(parsed), found))
        units = [ParsingScene(scene, counts, args.seed) for scene in counted]
        parsed += progress.track("slot counts, parsed", pool.run(units))
        imagined = [FollowingScene(scene, counts, 0, args.seed) for scene in counted]
        followed += progress.track("slot counts, imagined", pool.run(imagined))
        films = choose_films(followed, entrants["predictor"], args.seed, sizes.clips)
        progress.expect("pictures", len(films))
        clips = list(progress.track("pictures", pool.run(films)))
    played = [(name, outcome) for (name, _), outcome in zip(acting, acted, strict=True)]
    rows = following_rows(followed) + acted_rows(played) + parsing_rows(parsed)
    versions = {f"run {name}": sha for name, sha in hashes.items()}
    seeds = seeds_used(args.seed, [*following, *parsing, *imagined])
    results = run.results(rows, headline(rows), seeds, versions)
    run.write(build_report(results, found, slot_counts, measures, clips, run.command))
    run.close(progress, results, [predictor_table(rows, found), parser_table(rows, found)])
    return results


def choose_films(
    outcomes: Sequence[FollowingOutcome], entrants: Sequence[Entrant], seed: int, count: int
) -> list[FilmPicture]:
    """The scenes in which most of the trained predictors reach the bowl, and those in which fewest do."""
    names = [entrant.name for entrant in entrants if entrant.name != SHIPPED]
    cases = [one for one in outcomes if one.scene.split == "controllability" and names]
    reached = [int(sum(one.models[name].ends_V[0] for name in names)) for one in cases]
    shown = tuple(
        Contender(one.name, one.load, True, one.name, "", None) for one in entrants if one.name in SHOWN
    )
    films = []
    ranked = extremes(list(zip(cases, reached, strict=True)), [-float(n) for n in reached], count)
    for best, chosen in zip((True, False), ranked, strict=True):
        for rank, (outcome, n) in enumerate(chosen, start=1):
            caption = f"{n} of {len(names)} runs end in the bowl"
            films.append(FilmPicture(outcome.scene, shown, seed, "ablations", rank, best, caption))
    return films


def look(runs: Path) -> tuple[list[FoundRun], dict[str, str]]:
    """What there is of every run, and the first 16 digits of the SHA-256 of those that can be measured.

    A trained run that cannot be loaded here (its text encoder may need a package) is in the state `unusable`.
    """
    found, hashes = [], {}
    for run in RUNS:
        one = find_run(run, runs)
        if one.state == "trained":
            try:
                hashes[run.name] = entrant_of(one).load().checkpoint.sha256[:16]
            except (CheckpointError, ImportError, OSError, RuntimeError) as error:
                one = FoundRun(run, one.folder, "unusable", str(error), one.updates)
        found.append(one)
    return found, hashes


def entrant_of(found: FoundRun) -> Entrant:
    """The model of a trained run."""
    return Entrant(found.run.name, LoadCheckpoint(str(found.checkpoint)))


def seeds_used(seed: int, units: Sequence[FollowingScene | ParsingScene]) -> dict[str, list[int]]:
    """Every seed, by what it was used for."""
    seeds: dict[str, list[int]] = {"slots": [seed]}
    for unit in units:
        known = seeds.setdefault(f"scenes, {unit.scene.split}", [])
        if unit.scene.seed not in known:
            known.append(unit.scene.seed)
    return seeds


if __name__ == "__main__":
    start(main, Args)
