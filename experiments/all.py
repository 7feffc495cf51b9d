"""All studies, one after another, and one page that links their reports.

    python experiments/all.py                    # under an hour on 2 cores; stop it and start it again as you like
    python experiments/all.py --quick            # first looks, about 7 minutes
    python experiments/all.py --only runtime --only long_horizon --fresh

A study that this program has run is not run again while its command line, all weights that it reads and the code of
this repository are the same. One that fails is told on the page, the others are run all the same, and the exit status
is 1. Writes a folder a study into `--out`, `index.html`, and `summary.md`: tables for the README, made from the
`results.json` files.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from rich.console import Console

from experiments.protocol.arguments import StudyArgs, UsageError, start
from experiments.protocol.studies import STUDIES, Study, inputs_digest
from experiments.protocol.workers import LoadCheckpoint
from experiments.reporting import Checkpoint, OutputFolder, Results
from experiments.reporting.index import Entry, Index
from experiments.reporting.summary import study_markdown

RECORD = "all.json"
"""What each finished study was run with."""
SHOWN = 5  # headline figures a study on the index page
ROOT = Path(__file__).resolve().parents[1]


@dataclass
class Args(StudyArgs):
    """Run every study."""

    out: Path = Path("results")
    """Folder for index.html, summary.md and a folder a study."""
    only: tuple[str, ...] = ()
    """Run only the studies of these names. The page and the summary show what is there of all."""
    fresh: bool = False
    """Run studies again that are done already."""
    runs: Path = Path("runs/ablations")
    """Folder of the ablation runs."""


@dataclass(frozen=True)
class Outcome:
    """What came of a study in this run.

    Attributes:
        state: `done` now; `kept` from an earlier run; `failed`; or `not run`.
        problem: what went wrong, or empty.
    """

    study: Study
    state: str
    problem: str = ""


Run = Callable[[Study, Args], str]
"""Runs a study; returns what went wrong, or nothing."""


def main(args: Args, run: Run | None = None, studies: Sequence[Study] = STUDIES) -> int:
    """Run what is not done yet; the exit status, 1 if a study failed.

    Args:
        args: the command line.
        run: runs one study; by default as a program of its own, so that one that dies takes no other with it.
        studies: all there are, in order.

    Raises:
        OSError: if the folder cannot be written, before any work is done.
        CheckpointError: if there is no such checkpoint, before any work is done.
        UsageError: if there is no study of a name in `args.only`.
    """
    known = [study.name for study in studies]
    if wrong := [name for name in args.only if name not in known]:
        raise UsageError(f"unknown study {wrong[0]!r}; known: {', '.join(known)}")
    folder = OutputFolder(args.out)
    where = LoadCheckpoint(args.checkpoint)().checkpoint
    checkpoint = Checkpoint(where.name, where.sha256)
    console = Console()
    outcomes: list[Outcome] = []
    for study in studies:
        outcomes.append(_one(study, args, checkpoint, run or run_program, console))
        # After every study, so that there is something to look at while the next one runs.
        waiting = [Outcome(other, "not run") for other in studies[len(outcomes) :]]
        write_pages(folder, args, checkpoint, [*outcomes, *waiting])
    for outcome in outcomes:
        console.print(f"{outcome.study.name}: {outcome.state}", highlight=False)
    console.print(f"Index: {folder.path / 'index.html'}", highlight=False)
    return 1 if any(outcome.state == "failed" for outcome in outcomes) else 0


def _one(study: Study, args: Args, checkpoint: Checkpoint, run: Run, console: Console) -> Outcome:
    kept = done_already(study, args, checkpoint)
    if args.only and study.name not in args.only:
        return Outcome(study, "kept" if kept else "not run")
    if kept and not args.fresh:
        console.print(f"{study.name}: done already", highlight=False)
        return Outcome(study, "kept")
    console.rule(study.title)
    before, began = identity(study, args), time.monotonic()
    _record(args.out, study, None)
    problem = run(study, args)
    if not problem and not complete(study, args, checkpoint):
        problem = "it ended well, but its results.json is not there or of another checkpoint"
    if problem:
        console.print(f"[red]{study.name} failed[/] after {time.monotonic() - began:.0f} s", highlight=False)
        return Outcome(study, "failed", problem)
    _record(args.out, study, before)
    return Outcome(study, "done")


def done_already(study: Study, args: Args, checkpoint: Checkpoint) -> bool:
    """Whether this program has run the study, and would run the very same again."""
    return complete(study, args, checkpoint) and _records(args.out).get(study.name) == identity(study, args)


def complete(study: Study, args: Args, checkpoint: Checkpoint) -> bool:
    """Whether the results of the study are there, as they were asked for."""
    results = read_results(args.out / study.name)
    if results is None or not (args.out / study.name / "report.html").is_file():
        return False
    return (results.checkpoint.sha256, results.quick) == (checkpoint.sha256, args.quick)


def identity(study: Study, args: Args) -> str:
    """A hash of all that the figures of a study depend on, but for the checkpoint."""
    options = study_options(study, replace(args, out=Path(), workers=0))
    text = "\n".join([*options, inputs_digest(study, args.runs), code_digest()])
    return hashlib.sha256(text.encode()).hexdigest()


@lru_cache(maxsize=1)
def code_digest() -> str:
    """A hash of the Python files that figures can depend on."""
    digest = hashlib.sha256()
    for room in ("envs", "experiments", "planning", "textocvp"):
        for path in sorted((ROOT / room).rglob("*.py")):
            digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def read_results(folder: Path) -> Results | None:
    """The results of a study; None where there are none that can be read."""
    try:
        return Results.read(folder / "results.json")
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _records(out: Path) -> dict[str, str]:
    try:
        data = json.loads((out / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def _record(out: Path, study: Study, done: str | None) -> None:
    """Remember what a study was run with, or, with None, that nothing is known of its results any more."""
    records = _records(out) | {study.name: done}
    text = json.dumps({name: value for name, value in records.items() if value}, indent=2) + "\n"
    new = out / (RECORD + ".new")
    new.write_text(text, encoding="utf-8")
    new.replace(out / RECORD)


def run_program(study: Study, args: Args) -> str:
    """Run `experiments/NAME.py` as a program; what it shows appears here."""
    module = f"experiments.{study.name}"
    if importlib.util.find_spec(module) is None:
        return f"there is no experiments/{study.name}.py"
    command = [sys.executable, "-m", module, *study_options(study, args)]
    path = os.pathsep.join(part for part in (str(ROOT), os.environ.get("PYTHONPATH", "")) if part)
    last: deque[str] = deque(maxlen=12)
    with subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.PIPE, text=True, errors="replace"
    ) as program:
        assert program.stderr is not None
        for line in program.stderr:
            sys.stderr.write(line)
            last.append(line.rstrip())
    if program.returncode == 0:
        return ""
    return "\n".join([f"exit status {program.returncode}", *last])


def study_options(study: Study, args: Args) -> list[str]:
    """What a study is told on its command line."""
    options = ["--checkpoint", args.checkpoint, "--out", str(args.out / study.name), "--seed", str(args.seed)]
    options += ["--workers", str(args.workers)]
    options += ["--quick"] if args.quick else []
    return options + (["--runs", str(args.runs)] if study.reads == "runs" else [])


def write_pages(
    folder: OutputFolder, args: Args, checkpoint: Checkpoint, outcomes: Sequence[Outcome]
) -> None:
    """`index.html` and `summary.md`, of all results that are there."""
    found = {outcome.study.name: read_results(args.out / outcome.study.name) for outcome in outcomes}
    index = Index(
        title="What was measured",
        text="Every study has a page of its own, which opens offline: tables with 95 % intervals, plots, films of the "
        "best and of the worst cases, and the command that gives the same figures again.",
        entries=[entry_of(outcome, found[outcome.study.name]) for outcome in outcomes],
        checkpoint=checkpoint,
        command=replace(args, only=(), fresh=False).command("all"),
        quick=args.quick,
    )
    parts = [
        study_markdown(outcome.study.title, results, outcome.study.picks)
        for outcome in outcomes
        if (results := found[outcome.study.name]) is not None
    ]
    with folder.fill() as partial:
        (partial / "index.html").write_text(index.to_html(), encoding="utf-8")
        (partial / "summary.md").write_text("\n".join(parts), encoding="utf-8")


def entry_of(outcome: Outcome, results: Results | None) -> Entry:
    """A study's place on the page."""
    study = outcome.study
    states = {"done": ("done", "good"), "kept": ("done", "good"), "failed": ("failed", "bad")}
    word, tone = states.get(outcome.state, ("not run", "plain"))
    if results is None:
        return Entry(study.title, study.question, word, tone, "no figures yet", problem=outcome.problem)  # type: ignore[arg-type]
    if outcome.state in ("failed", "not run"):
        word += "; figures of an earlier run"
    names = [*(name for name in study.first if name in results.headline)]
    names += [name for name in results.headline if name not in names]
    return Entry(
        title=study.title,
        question=study.question,
        state=word,
        tone=tone,  # type: ignore[arg-type]
        detail=f"{len(results.rows)} figures in {results.seconds:.0f} s"
        + (", a quick run" if results.quick else "")
        + f", {results.checkpoint.name}",
        figures=[(name.replace("_", " "), f"{results.headline[name]:.3g}") for name in names[:SHOWN]],
        report=f"{study.name}/report.html",
        problem=outcome.problem,
    )


def run_all(args: Args) -> None:
    """`main` with the exit status as programs give it."""
    try:
        sys.exit(main(args))
    except KeyboardInterrupt:
        sys.exit("stopped; finished studies are kept: start it again to go on")


if __name__ == "__main__":
    start(run_all, Args)
