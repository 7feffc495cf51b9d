"""Train every model of the ablation study, one after another.

    python experiments/train_ablations.py --data data/tabletop-train.h5 --val data/tabletop-val.h5
    python experiments/train_ablations.py --list                # what there is, and what is still to be trained
    python experiments/train_ablations.py --only layers-1 --only residual-off

What is trained with which settings stands in `experiments/study/ablation_runs.py`; `experiments/ablations.py` measures
it afterwards. Stop at any moment and start again: finished runs are skipped, an unfinished one goes on where it was.
The episodes are parsed once, and all predictor runs share those slots.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from experiments.study.ablation_runs import RUNS, AblationRun, find_run, runs_table
from textocvp.checkpoint import DEFAULT_CHECKPOINT, resolve_checkpoint
from textocvp.data import open_episodes
from textocvp.data.cache import cached_slots
from textocvp.model import TextOCVP
from textocvp.training.parser import ParserTraining
from textocvp.training.parser import train as train_parser
from textocvp.training.predictor import PredictorTraining
from textocvp.training.predictor import train as train_predictor

SLOTS = ("slots-train", "slots-val")  # as `textocvp.training.predictor` names them


@dataclass
class Args:
    """Train every model of the ablation study."""

    data: Path = Path("data/tabletop-train.h5")
    """Training episodes, from `python -m envs.collect --split train`."""
    val: Path = Path("data/tabletop-val.h5")
    """Held-out episodes for the figures during training. The study measures on other scenes."""
    out: Path = Path("runs/ablations")
    """Folder of all runs."""
    parser: str = DEFAULT_CHECKPOINT
    """Checkpoint whose parser and renderer all predictor runs share: bundled name, folder or hub id."""
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Train only the runs of these names."""
    list: bool = False
    """Say what there is, and train nothing."""
    steps: int = 500
    """Updates of each predictor run."""
    parser_steps: int = 200
    """Updates of each parser run."""
    episodes: int | None = None
    """Train on the first so many episodes of the file only."""
    seed: int = 0
    """Seed of weights and data order."""


def main(args: Args) -> int:
    """Train what is missing; the exit status, 1 if a run failed (the others are trained all the same).

    Raises:
        OSError, ValueError: if the episodes cannot be read, or there is no such parser or run.
    """
    console, failed = Console(), dict[str, str]()
    chosen = [run_named(name) for name in args.only] or RUNS
    if not args.list:
        for path in (args.data, args.val):
            open_episodes(path).close()
        with resolve_checkpoint(args.parser) as parser:
            for number, run in enumerate(chosen, start=1):
                heading = f"{run.key} ({number} of {len(chosen)}): {run.label}"
                found = find_run(run, args.out)
                if found.state == "trained":
                    console.print(f"{heading}: trained already", highlight=False)
                    continue
                console.rule(heading)
                began = time.monotonic()
                try:
                    if found.state == "other settings":
                        raise ValueError(f"{found.folder} holds a run with other settings: {found.detail}")
                    train(run, args, parser)
                except (ValueError, RuntimeError, OSError, ImportError) as error:
                    # One encoder that cannot be had here must not cost the night's other runs.
                    failed[run.key] = str(error)
                    console.print(f"[red]{run.key} failed:[/] {error}", highlight=False)
                else:
                    console.print(f"{run.key}: {time.monotonic() - began:.0f} s", highlight=False)
    table = runs_table((find_run(run, args.out) for run in chosen), failed)
    console.print(*table.to_terminal(console.width))
    for name, problem in failed.items():
        console.print(f"{name}: {problem}", highlight=False)
    return 1 if failed else 0


def run_named(name: str) -> AblationRun:
    """The run of that name. ValueError if there is none; the message lists those that exist."""
    runs = {run.key: run for run in RUNS}
    if name not in runs:
        raise ValueError(f"unknown run {name!r}; known: {', '.join(runs)}")
    return runs[name]


def train(run: AblationRun, args: Args, parser: Path) -> None:
    """Train one run, or go on with it. All runs of a stage learn from the same episodes in the same order."""
    out = args.out / run.key
    shared: dict[str, Any] = {"data": args.data, "val": args.val, "out": out, "seed": args.seed}
    shared |= {"preset": run.preset, "set": run.settings}
    if run.stage == "parser":
        shared |= {"steps": args.parser_steps, "warmup": min(ParserTraining.warmup, args.parser_steps // 4)}
        episodes = args.episodes or ParserTraining.episodes
        train_parser(ParserTraining(**shared, batch=16, clip=2, episodes=episodes))
    else:
        share_slots(parser, args, out)
        shared |= {"steps": args.steps, "warmup": min(PredictorTraining.warmup, args.steps // 4)}
        shared |= {"parser": parser, "episodes": args.episodes}
        train_predictor(PredictorTraining(**shared, batch=32, autoregressive=1.0))


def share_slots(parser: Path, args: Args, out: Path) -> None:
    """Link the slots of all episodes into a run's folder; they are parsed for the first run only.

    Raises:
        CacheError: if the shared slots are those of another parser or of other episodes.
    """
    shared, model = args.out / "slots", TextOCVP.from_pretrained(parser)
    out.mkdir(parents=True, exist_ok=True)
    for name, path, first in zip(SLOTS, (args.data, args.val), (args.episodes, None), strict=True):
        with open_episodes(path, first=first) as episodes:
            cached_slots(model, episodes, shared / name)
        if not (out / name).exists():
            (out / name).symlink_to((shared / name).absolute())


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except (OSError, ValueError) as error:  # CheckpointError is a ValueError
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("stopped; start it again to go on")
