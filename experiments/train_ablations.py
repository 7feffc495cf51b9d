"""Train every model of the ablation study, one after another.

    python experiments/train_ablations.py --data data/tabletop-train.h5 --val data/tabletop-val.h5
    python experiments/train_ablations.py --list                # what there is, and what is still to be trained
    python experiments/train_ablations.py --only layers-1 --only residual-off

What is trained with which settings stands in `experiments/protocol/ablation_runs.py`. Stop it at any moment and start
it again: finished runs are skipped, an unfinished one goes on where it was. The episodes are parsed once, and all
predictor runs share those slots. Afterwards `python experiments/ablations.py` measures what was trained.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Container, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import tyro
from rich.console import Console

from experiments.protocol.ablation_runs import (
    PARSER_BATCH,
    PARSER_CLIP,
    PARSER_STEPS,
    PREDICTOR_BATCH,
    PREDICTOR_STEPS,
    RUNS,
    AblationRun,
    find_run,
    run_named,
)
from experiments.reporting import Cell, Table, TableRow
from textocvp.checkpoint import CheckpointError
from textocvp.data.cache import cached_slots
from textocvp.data.episodes import EpisodeFile
from textocvp.model import TextOCVP
from textocvp.training.parser import ParserTraining
from textocvp.training.parser import train as train_parser
from textocvp.training.predictor import PredictorTraining
from textocvp.training.predictor import train as train_predictor
from textocvp.world_model import DEFAULT_CHECKPOINT, bundled_checkpoints

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
    """Checkpoint whose parser and renderer all predictor runs share: bundled name or folder."""
    only: tuple[str, ...] = ()
    """Train only the runs of these names."""
    list: bool = False
    """Say what there is, and train nothing."""
    steps: int = PREDICTOR_STEPS
    """Updates of each predictor run."""
    parser_steps: int = PARSER_STEPS
    """Updates of each parser run."""
    episodes: int | None = None
    """Train on the first so many episodes of the file only."""
    seed: int = 0
    """Seed of weights and data order."""


def main(args: Args) -> int:
    """Train what is missing; the exit status, 1 if a run failed (the others are trained all the same).

    Raises:
        KeyError: if there is no run of a name in `args.only`.
        OSError, ValueError: if the episodes cannot be read.
        CheckpointError: if there is no such parser.
    """
    console = Console()
    chosen = [run_named(name) for name in args.only] or list(RUNS)
    if args.list:
        console.print(states_table(chosen, args.out).to_rich())
        return 0
    for path in (args.data, args.val):
        EpisodeFile(path).close()
    failed: dict[str, str] = {}
    with ExitStack() as stack:
        parser = parser_folder(args.parser, stack)
        for number, run in enumerate(chosen, start=1):
            heading = f"{run.name} ({number} of {len(chosen)}): {run.label}"
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
                failed[run.name] = str(error)
                console.print(f"[red]{run.name} failed:[/] {error}", highlight=False)
            else:
                console.print(f"{run.name}: {time.monotonic() - began:.0f} s", highlight=False)
    console.print(states_table(chosen, args.out, failed).to_rich())
    for name, problem in failed.items():
        console.print(f"{name}: {problem}", highlight=False)
    return 1 if failed else 0


def train(run: AblationRun, args: Args, parser: Path) -> None:
    """Train one run, or go on with it."""
    out = args.out / run.name
    if run.stage == "parser":
        train_parser(
            ParserTraining(
                data=args.data,
                val=args.val,
                out=out,
                preset=run.preset,
                set=run.settings,
                steps=args.parser_steps,
                batch=PARSER_BATCH,
                clip=PARSER_CLIP,
                warmup=min(ParserTraining.warmup, args.parser_steps // 4),
                episodes=args.episodes or ParserTraining.episodes,
                seed=args.seed,
            )
        )
        return
    share_slots(parser, args, out)
    train_predictor(
        PredictorTraining(
            parser=parser,
            data=args.data,
            val=args.val,
            out=out,
            preset=run.preset,
            set=run.settings,
            episodes=args.episodes,
            steps=args.steps,
            batch=PREDICTOR_BATCH,
            warmup=min(PredictorTraining.warmup, args.steps // 4),
            autoregressive=1.0,
            seed=args.seed,
        )
    )


def share_slots(parser: Path, args: Args, out: Path) -> None:
    """Put the slots of all episodes into a run's folder; they are parsed for the first run only.

    Raises:
        CacheError: if the shared slots are those of another parser or of other episodes.
    """
    shared = args.out / "slots"
    model = TextOCVP.from_pretrained(parser)
    out.mkdir(parents=True, exist_ok=True)
    for name, path, first in zip(SLOTS, (args.data, args.val), (args.episodes, None), strict=True):
        with EpisodeFile(path, first=first) as episodes:
            cached_slots(model, episodes, shared / name)
        shutil.rmtree(out / name, ignore_errors=True)
        shutil.copytree(shared / name, out / name, copy_function=_link)


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)


def parser_folder(name: str, stack: ExitStack) -> Path:
    """The folder of a checkpoint, which stays there while `stack` is open.

    Raises:
        CheckpointError: if there is no such checkpoint.
    """
    if name in bundled_checkpoints():
        return stack.enter_context(as_file(files("textocvp") / "checkpoints" / name))
    if not Path(name).is_dir():
        raise CheckpointError(
            f"unknown checkpoint {name!r}: give a folder, or one of {', '.join(bundled_checkpoints())}"
        )
    return Path(name)


def states_table(runs: Sequence[AblationRun], out: Path, failed: Container[str] = ()) -> Table:
    """What there is of each run."""
    lines = []
    for run in runs:
        found = find_run(run, out)
        state = "failed" if run.name in failed else found.state
        updates = Cell("" if found.updates is None else f"{found.updates}")
        lines.append(TableRow(run.name, [Cell(run.stage), Cell(state), updates]))
    return Table(f"Runs in {out}", ["stage", "state", "updates"], lines)


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except KeyError as error:
        sys.exit(f"error: {error.args[0]}")
    except (OSError, CheckpointError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("stopped; start it again to go on")
