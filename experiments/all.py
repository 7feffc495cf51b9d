"""All studies, one after another, and one page that links their reports.

    python experiments/all.py                    # under an hour on 2 cores; stop it and start it again as you like
    python experiments/all.py --quick            # first looks, about 7 minutes
    python experiments/all.py --only runtime --only long_horizon --fresh

A study that is done is not run again while its options, weights and code are the same. One that fails is told on the
page; the others are run all the same, and the exit status is 1. Writes a folder a study into `--out`, `index.html`, and
`summary.md`: tables for the README.
"""

import shlex
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path

import tyro
from rich.console import Console

from experiments.report.page import Entry, Tone, environment
from experiments.report.results import Results
from experiments.report.tables import Cell, Table, TableRow
from experiments.study.run import OutputFolder, Run, Study, StudyArgs, UsageError, exit_in_a_line
from textocvp.checkpoint import Checkpoint, CheckpointError
from textocvp.protocols import LoadCheckpoint, LoadModel

NAMES = (
    "controllability", "imagination", "robustness", "prediction", "objects",
    "ablations", "interpretability", "runtime", "long_horizon",
)  # fmt: skip
"""Every study, in the order in which they are run and shown."""
SHOWN = 5  # headline figures a study on the index page


@dataclass
class Args(StudyArgs):
    """Run every study."""

    only: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Run only the studies of these names. The page and the summary show what is there of all."""
    fresh: bool = False
    """Run studies again that are done already."""
    runs: Path = Path("runs/ablations")
    """Folder of the ablation runs."""

    def of(self, study: Study) -> StudyArgs:
        """What a study is told."""
        known = {one.name for one in fields(study.args)} & {one.name for one in fields(self)} - {"out"}
        return study.args(out=self.folder("") / study.name, **{name: getattr(self, name) for name in known})


Outcome = tuple[str, Tone, str]  # of a study in this run: a word or two, their colour on the page, and what went wrong
DONE: Outcome = ("done", "good", "")


def main(
    args: Args,
    execute: Callable[[Study, StudyArgs], str] | None = None,
    studies: Sequence[Study] = (),
    load: LoadModel | None = None,
) -> int:
    """Run what is not done yet; the exit status, 1 if a study failed.

    Args:
        execute: runs one study and returns what went wrong, or nothing; by default `run_program`.
        studies: all there are, in order.
        load: makes the world model; by default loads `args.checkpoint`.

    Raises:
        OSError, CheckpointError, UsageError: without folder, checkpoint or a study of that name; before any work.
    """
    studies = studies or [import_module(f"experiments.{name}").STUDY for name in NAMES]
    outcomes: dict[str, Outcome] = {study.name: ("not run", "plain", "") for study in studies}
    if wrong := [name for name in args.only if name not in outcomes]:
        raise UsageError(f"unknown study {wrong[0]!r}; known: {', '.join(outcomes)}")
    folder, console = OutputFolder(args.folder("")), Console()
    weights = (load or LoadCheckpoint(args.checkpoint))().checkpoint
    for study in studies:
        wanted = not args.only or study.name in args.only
        if not (wanted and args.fresh) and is_done(study, args.of(study), load):
            outcomes[study.name] = DONE
        elif wanted:
            console.rule(study.title)
            # Until it is done again, nothing is known of what lies there.
            (folder.path / study.name / "identity.txt").unlink(missing_ok=True)
            problem = (execute or run_program)(study, args.of(study))
            if not problem and not is_done(study, args.of(study), load):
                problem = "it ended well, but its results.json is not there or of another checkpoint"
            outcomes[study.name] = ("failed", "bad", problem) if problem else DONE
        console.print(f"{study.name}: {outcomes[study.name][0]}", highlight=False)
        # After every study, so that there is something to look at while the next one runs.
        write_pages(folder, args, weights, studies, outcomes)
    console.print(f"Index: {folder.path / 'index.html'}", highlight=False)
    return int(any(problem for *_, problem in outcomes.values()))


def is_done(study: Study, args: StudyArgs, load: LoadModel | None = None) -> bool:
    """Whether the results of the study are there, and running it would give the very same."""
    folder = args.folder(study.name)
    results = read_results(folder)
    if results is None or not all((folder / name).is_file() for name in ("identity.txt", "report.html")):
        return False
    try:
        this = Run(study, args, load=load)
        written = (folder / "identity.txt").read_text().strip()
    except (OSError, UsageError, CheckpointError):  # the study itself will say so
        return False
    return (written, results.checkpoint) == (this.identity, this.checkpoint)


def read_results(folder: Path) -> Results | None:
    """The results of a study; None where there are none that can be read."""
    try:
        return Results.read(folder / "results.json")
    except (OSError, ValueError):
        return None


def run_program(study: Study, args: StudyArgs) -> str:
    """Run a study as a program, so that one that dies takes no other with it; what it shows appears here."""
    command = [sys.executable, "-m", f"experiments.{study.name}", *shlex.split(" ".join(args.options()))]
    command += ["--out", str(args.folder(study.name)), "--workers", str(args.workers)]
    last: deque[str] = deque(maxlen=12)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, errors="replace") as program:
        for line in program.stderr or ():
            sys.stderr.write(line)
            last.append(line.rstrip())
    return "\n".join([f"exit status {program.returncode}", *last]) if program.returncode else ""


def write_pages(
    folder: OutputFolder, args: Args, weights: Checkpoint, studies: Sequence[Study], outcomes: Mapping[str, Outcome]
) -> None:
    """`index.html` and `summary.md`, of all results that are there."""
    entries, parts = [], []
    for study in studies:
        results = read_results(folder.path / study.name)
        entries.append(entry_of(study, outcomes[study.name], results))
        parts += [to_markdown(study, results)] if results else []
    command = replace(args, only=(), fresh=False).command("all")
    index = environment().get_template("index.html.j2")
    page = index.render(entries=entries, checkpoint=weights, command=command, quick=args.quick)
    with folder.fill() as partial:
        (partial / "index.html").write_text(page, encoding="utf-8")
        (partial / "summary.md").write_text("\n".join(parts), encoding="utf-8")


def entry_of(study: Study, outcome: Outcome, results: Results | None) -> Entry:
    """A study's place on the page."""
    word, tone, problem = outcome
    entry = Entry(study.title, study.question, word, tone, "no figures yet", problem=problem)
    if results is None:
        return entry
    names = [name for name in dict.fromkeys([*study.first, *results.headline]) if name in results.headline]
    quick = ", a quick run" if results.quick else ""
    return replace(
        entry,
        state=word if outcome == DONE else f"{word}; figures of an earlier run",
        detail=f"{len(results.rows)} figures in {results.seconds:.0f} s, {results.checkpoint.name}{quick}",
        figures=[(name.replace("_", " "), f"{results.headline[name]:.3g}") for name in names[:SHOWN]],
        report=f"{study.name}/report.html",
    )


def to_markdown(study: Study, results: Results) -> str:
    """A study's part of the summary: its tables, or its headline figures where none of the tables has a row."""
    tables = [spec.table(results.rows) for spec in study.tables]
    named = [TableRow(key.replace("_", " "), [Cell(f"{value:g}")]) for key, value in results.headline.items()]
    shown = [table for table in tables if table.measured()[1]] or [Table("Figure", ["value"], named)]
    weights = f"`{results.checkpoint.name}` ({results.checkpoint.sha256[:12]}), 95 % intervals in brackets."
    quick = "**Quick run**: a first look, not the figures to quote. " if results.quick else ""
    return "\n".join([f"### {study.title}", *(f"\n{its.to_markdown()}" for its in shown), "", quick + weights, ""])


if __name__ == "__main__":
    with exit_in_a_line("stopped; finished studies are kept: start it again to go on"):
        sys.exit(main(tyro.cli(Args, description=__doc__)))
