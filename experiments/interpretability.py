"""Interpretability: does the slot of the thing that a sentence names attend to the word that names it?

    python experiments/interpretability.py              # default: a few minutes on 2 cores
    python experiments/interpretability.py --quick      # a first look

Reads the text-to-slot attention of imagined rollouts (paper, section 4.5): which words each slot listens to, head by
head and over time, and one number, how often the slot of the named block (bowl) is the one that attends most to its
colour word. Beside it: chance, the same slots under a sentence that names something else, and the model with its
colour-matching term switched off, because that term alone could decide. Writes `results.json`, `report.html`, plots
and clips into `--out`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.protocol.arguments import StudyArgs, UsageError, start
from experiments.protocol.listening import ROLES
from experiments.protocol.listening_gallery import ListeningPictures, choose_listening
from experiments.protocol.listening_report import attends_table, build_report
from experiments.protocol.listening_rows import COLUMNS, head_rows, headline, listening_rows
from experiments.protocol.listening_scenes import ListeningOutcome, ListeningScene
from experiments.protocol.running import StudyRun
from experiments.protocol.scenes import test_scenes
from experiments.protocol.workers import LoadWorldModel
from experiments.reporting import Results, StudyProgress
from textocvp import WorldModel

VARIANTS = 3
VARIED = "controllability"  # the split whose scenes have enough bowls for other instructions
SECONDS = {"scenes": 1.0, "pictures": 1.5}  # of one unit on one core; they only weigh the progress bar


@dataclass
class Args(StudyArgs):
    """Interpretability study: which words the slots of named and unnamed things attend to.

    Scenes of three splits are imagined with their instruction: test, controllability (also with three other target
    bowls) and unseen_colors, whose captions also use colour names that no training caption had. Which slot is
    which thing is told by the simulator's segmentation, for measuring only; a second row tells it by appearance.
    """

    out: Path = Path("results/interpretability")
    """Folder for results.json, report.html, plots and clips."""

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        return QUICK if self.quick else DEFAULT


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        scenes: of each split.
        clips: how many best and how many worst cases the report shows.
    """

    scenes: int
    clips: int


QUICK = Sizes(scenes=30, clips=10)
DEFAULT = Sizes(scenes=150, clips=10)


def main(args: Args, load: LoadWorldModel | None = None, sizes: Sizes | None = None) -> Results:
    """Run the study and write its folder.

    Args:
        args: the command line.
        load: makes the world model; by default loads `args.checkpoint`.
        sizes: how much is measured; by default what `args` ask for.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, before any work is done.
        UsageError: if the checkpoint hears no text.
    """
    run, sizes = StudyRun.open("interpretability", args, load), sizes or args.sizes
    model = run.world_model
    if isinstance(model, WorldModel) and not model.model.predictor.uses_text:
        raise UsageError(f"{args.checkpoint} hears no text, so there is no attention to read")
    pool = run.pool
    splits = dict.fromkeys(split for split, _ in COLUMNS.values())
    units = [
        ListeningScene(scene, VARIANTS if split == VARIED else 0, args.seed)
        for split in splits
        for scene in test_scenes(split, sizes.scenes, args.seed)
    ]
    parts = {"scenes": len(units), "pictures": 2 * min(sizes.clips, len(units))}
    outcomes: list[ListeningOutcome] = []
    with StudyProgress({part: (n, SECONDS[part]) for part, n in parts.items()}) as progress:
        for outcome in progress.track("scenes", pool.run(units)):
            outcomes.append(outcome)
            if len(outcomes) % 5 == 0:
                rows = listening_rows(outcomes)
                progress.show(*(attends_table(rows, role) for role in ROLES))
        chosen = choose_listening(outcomes, VARIANTS, args.seed, sizes.clips)
        pictures: list[ListeningPictures] = list(progress.track("pictures", pool.run(chosen)))
    rows = [*listening_rows(outcomes), *head_rows(outcomes, VARIED)]
    results = run.results(rows, headline(rows), seeds_used(args.seed, units))
    run.write(build_report(results, outcomes, pictures, VARIED, run.command))
    run.close(progress, results, [attends_table(rows, role) for role in ROLES])
    return results


def seeds_used(slots: int, units: Sequence[ListeningScene]) -> dict[str, list[int]]:
    """Every seed, by what it was used for."""
    seeds: dict[str, list[int]] = {"slots": [slots]}
    for unit in units:
        seeds.setdefault(f"scenes, {unit.scene.split}", []).append(unit.scene.seed)
    return seeds


if __name__ == "__main__":
    start(main, Args)
