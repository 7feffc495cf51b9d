"""How a study is run: its command line, its work on several processes, what it shows, keeps and writes."""

from __future__ import annotations

import hashlib
import inspect
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, cast

import tyro
from joblib import cpu_count

from experiments.report.page import AGAIN, CardSpec, Report, Section
from experiments.report.progress import StudyProgress
from experiments.report.results import Results, package_versions
from experiments.report.rows import Key, Row, pick_figures
from experiments.report.tables import Table, TableSpec
from experiments.study.frame_metrics import Measures
from experiments.study.kept import KeptWork, file_digest, identity_of
from experiments.study.methods import METHODS, find_models
from experiments.study.pool import Pool, Unit
from experiments.study.scenes import scene_line
from textocvp.checkpoint import Checkpoint, CheckpointError
from textocvp.protocols import LoadCheckpoint, LoadModel
from textocvp.world_model import WorldModel

RESULTS = Path("results")  # where every study writes by default
LARGEST_SEED = 999  # each seed has scenes of its own, and a split has so many


class UsageError(ValueError):
    """Arguments that do not go together, or do not fit the model."""


@dataclass
class StudyArgs:
    """What every study can be told. A study's own arguments are a subclass. UsageError if one is out of range."""

    checkpoint: str = "tabletop-small"
    """Bundled name, folder, or id on the Hugging Face hub."""
    out: Path | None = None
    """Folder for results.json, report.html, plots and clips; results/STUDY, or results/quick/STUDY with --quick."""
    seed: int = 0
    """Chooses the scenes and seeds the slots. The same seed gives the same figures."""
    quick: bool = False
    """A first look with few scenes, at most 3 minutes on 2 cores."""
    workers: int = 0
    """Processes; 0 for one a core. Changes no figure."""
    model: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=CHECKPOINT: measure this checkpoint (a folder or hub id) as the model of that row, as MAGE=runs/mage."""

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise UsageError(f"--workers must be at least 0, got {self.workers}")
        if not 0 <= self.seed <= LARGEST_SEED:
            raise UsageError(f"--seed must be 0 to {LARGEST_SEED}, got {self.seed}")
        for one in self.model:
            key, _, name = one.partition("=")
            if key not in METHODS or not METHODS[key].model or not name:
                known = ", ".join(key for key, method in METHODS.items() if method.model)
                raise UsageError(f"--model must be NAME=CHECKPOINT with a NAME of {known}; got {one!r}")

    def folder(self, study: str) -> Path:
        """Where a study writes. A first look must not take the place of figures that took hours."""
        return self.out or (RESULTS / "quick" / study if self.quick else RESULTS / study)

    def options(self) -> list[str]:
        """Every argument that changes figures and is not at its default, as on the command line."""
        words = []
        for one in fields(self):
            value = getattr(self, one.name)
            if one.name not in ("out", "workers", "seed") and value != one.default:
                option = "--" + one.name.replace("_", "-")
                values = value if isinstance(value, tuple) else (value,)
                words += [option] if value is True else [f"{option} {shlex.quote(str(v))}" for v in values]
        return [*words, f"--seed {self.seed}"]

    def command(self, study: str) -> str:
        """What to type for the same figures. `study` is the name of its file, without `.py`."""
        return " ".join([f"python experiments/{study}.py", *self.options()])


@dataclass
class FullArgs(StudyArgs):
    """Arguments of a study that also has a long form."""

    full: bool = False
    """As many scenes as the paper; takes about an hour."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quick and self.full:
            raise UsageError("--quick and --full exclude each other")


@dataclass
class ScenesArgs(StudyArgs):
    """Arguments of a study whose number of scenes can be chosen."""

    scenes: int = 0
    """Scenes of each split; 0 for the study's own number."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scenes < 0:
            raise UsageError(f"--scenes must be at least 0, got {self.scenes}")


@dataclass(frozen=True)
class Part:
    """A kind of work."""

    # of work; for a part that follows from the results of others, nothing, and `cases` makes them later
    units: Sequence[Unit[Any]] = ()
    seconds: float = 1.0  # of a unit on one core, roughly; they make the first estimate of the time that is left
    count: int = 0  # units that are expected of a part that follows from others


Found = Mapping[str, list[Any]]
"""The results of the finished units of each part, in their order. Those with `lines` tell of single episodes."""


@dataclass(frozen=True)
class Study:
    """A study: `experiments/NAME.py`."""

    name: str  # of its file and of its folder of results
    title: str  # for reports
    question: str  # for reports, in a sentence
    units: Callable[[Run], Mapping[str, Part]]  # the work that is known beforehand: part -> `Part`
    # the figures, of whatever is finished; must bear parts with no result yet
    rows: Callable[[Run, Found], Sequence[Row]]
    # for the terminal, the live view and the summary. Columns and lines without figures show a dash.
    tables: Sequence[TableSpec]
    # sections of the report, of the results and of what the units found
    page: Callable[[Run, Results, Found], Sequence[Section]]
    sizes: Callable[[Any], Any]  # how much is measured; tests give their own
    args: type[StudyArgs] = StudyArgs  # class of its command line
    methods: Sequence[str] = ()  # keys of `METHODS` that are measured; those with a `model` are loaded
    # more work, that follows from what was found; may name only parts that `units` announced
    cases: Callable[[Run, Found], Mapping[str, Sequence[Unit[Any]]]] = lambda run, found: {}
    # the first figures of the report
    cards: Sequence[CardSpec] | Callable[[Run, Results], Sequence[CardSpec]] = ()
    # name -> key of the row. A mapping is a promise, and what of it was not measured is an error; a function
    # of the run may name more than can be measured.
    headline: Mapping[str, Key] | Callable[[Run], Mapping[str, Key]] = field(default_factory=dict)
    first: Sequence[str] = ()  # names of the headline that the index shows first
    measures: Callable[[Any], Measures] = lambda args: Measures()  # what of frames is measured
    horizon: int = 1  # how many frames the model must be able to imagine at once
    # files whose content changes figures, beside the checkpoints of `methods`
    inputs: Callable[[Any], Sequence[Path]] = lambda args: ()
    versions: Callable[[Run], Mapping[str, str]] = lambda run: {}  # more entries of `versions` in results.json
    files: Callable[[Run, Found], Mapping[str, str]] = lambda run, found: {}  # more files of the folder: name -> text
    # more tables, that are printed after the others
    printed: Callable[[Run, Results], Sequence[Table]] = lambda run, results: ()
    # makes what the study needs once, `Run.prepared`; raises UsageError if the model does not do
    prepare: Callable[[Run], Any] = lambda run: None
    one_process: bool = False  # whether everything runs in this process, as for timing
    again: str = AGAIN  # how far the figures come out the same


class Run:
    """One run of a study, from the moment that folder and checkpoints are known to be there.

    Args:
        study, args: which, and its command line.
        load: makes the world model; by default loads `args.checkpoint`.
        sizes: how much is measured; by default what the study makes of `args`.
        loads: key of a method -> makes its model; by default their checkpoints.
        measures: what of frames is measured; by default what the study asks for and this machine can.

    Attributes:
        folder: where it writes.
        world_model: a world model to look at; units get their own.
        models: of the methods, as far as they are there.
        missing, remarks: methods that cannot be measured -> why; sentences that say so.

    Raises:
        OSError: if the folder cannot be written.
        CheckpointError: if there is no such checkpoint.
        UsageError: if the model cannot look as far ahead as the study needs.
    """

    def __init__(
        self,
        study: Study,
        args: StudyArgs,
        *,
        load: LoadModel | None = None,
        sizes: Any = None,
        loads: Mapping[str, LoadModel] | None = None,
        measures: Measures | None = None,
    ) -> None:
        self.study, self.args = study, args
        self.folder = OutputFolder(args.folder(study.name))
        self.sizes = study.sizes(args) if sizes is None else sizes
        self.load: LoadModel[Any] = load or LoadCheckpoint(args.checkpoint)
        self.world_model = cast(WorldModel, self.load())
        if not hasattr(self.world_model, "rollout"):
            raise UsageError(f"{args.checkpoint} has no slots, and a study needs a model that has")
        longest = self.world_model.longest_horizon
        if longest is not None and longest < study.horizon:
            raise UsageError(
                f"{args.checkpoint} imagines {longest} frames at most (predictor.window), and this study needs "
                f"{study.horizon}"
            )
        if loads is None:
            asked = dict(one.split("=", 1) for one in args.model)
            bundled = {key: METHODS[key].model for key in study.methods if METHODS[key].model}
            loads = {key: LoadCheckpoint(asked.get(key, name)) for key, name in bundled.items()}
        self.models, self.missing = find_models(loads)
        self.measures = measures or study.measures(args)
        self.remarks = [f"{key} is absent: {reason}." for key, reason in self.missing.items()]
        self.remarks += filter(None, [self.measures.absent])

    @cached_property
    def prepared(self) -> Any:
        """What `Study.prepare` made."""
        return self.study.prepare(self)

    @property
    def checkpoint(self) -> Checkpoint:
        """The weights of the world model."""
        return self.world_model.checkpoint

    @cached_property
    def identity(self) -> str:
        """A hash of all that the figures depend on; see `kept`."""
        models = [f"{model.key} {model.sha256}" for model in self.models]
        inputs = [f"{path} {file_digest(path)}" for path in self.study.inputs(self.args)]
        what = [self.study.name, *self.args.options(), repr((self.sizes, self.measures, package_versions()))]
        return identity_of([*what, self.checkpoint.sha256, *models, *inputs])

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """The study's tables."""
        return [spec.table(rows, self.missing) for spec in self.study.tables]

    def headline(self, rows: Sequence[Row]) -> dict[str, float]:
        """The figures that are asked for by name.

        Raises:
            ValueError: if one that the study promises was not measured.
        """
        wanted = self.study.headline
        if callable(wanted):
            return pick_figures(rows, wanted(self))
        found = pick_figures(rows, wanted)
        if lacking := [name for name in wanted if name not in found]:
            raise ValueError(f"headline {lacking[0]!r} was not measured")
        return found


def run(study: Study, args: StudyArgs | None = None, **doubles: Any) -> Results:
    """Run a study and write its folder. One that was interrupted goes on.

    `doubles` are `load`, `sizes`, `loads` and `measures` of `Run`, whose errors come before any work is done.
    """
    this = Run(study, args or study.args(), **doubles)
    _ = this.prepared  # may find that the model does not do
    pool = Pool(this.load, 1 if study.one_process else this.args.workers or cpu_count())
    planned = study.units(this)
    found: dict[str, list[Any]] = {part: [] for part in planned}
    seeds: dict[str, list[int]] = {"slots": [this.args.seed]}
    manifest = scenes_manifest([unit for part in planned.values() for unit in part.units])
    kept = KeptWork(this.folder.path / "unfinished.pickle", this.identity)
    began = time.monotonic() - kept.seconds
    expected = {name: (len(part.units) or part.count, part.seconds) for name, part in planned.items()}
    done = False
    try:
        with StudyProgress(expected, pool.processes) as progress:

            def work(part: str, units: Sequence[Unit[Any]]) -> None:
                known = kept.of(part)[: len(units)]
                progress.expect(part, len(units))
                outcomes = chain(known, pool.run(units[len(known) :]))
                for outcome in progress.track(part, outcomes, len(known)):
                    found[part].append(outcome)
                    if len(found[part]) > len(known):
                        kept.add(part, time.monotonic() - began, outcome)
                    progress.show(lambda: this.tables(study.rows(this, found)))

            for name, part in planned.items():
                if part.units:
                    _note_seeds(seeds, name, part.units)
                    work(name, part.units)
            cases = study.cases(this, found)
            for name, part in planned.items():
                if not part.units:
                    work(name, cases.get(name, ()))
        rows = list(study.rows(this, found))
        hashes = {f"checkpoint of {model.key}": model.sha256 for model in this.models}
        versions = {**package_versions(), **hashes, **study.versions(this)}
        if manifest:
            versions["scenes.json"] = hashlib.sha256(manifest.encode()).hexdigest()
        results = Results(
            study.name,
            this.checkpoint,
            versions,
            seeds,
            this.args.quick,
            round(time.monotonic() - began, 1),
            rows,
            this.headline(rows),
            tuple(line for part in found.values() for one in part for line in getattr(one, "lines", ())),
        )
        _write(this, results, found, manifest)
        done = True
    finally:
        kept.close(done=done)
    progress.print(*this.tables(rows), *study.printed(this, results))
    for remark in this.remarks:
        progress.console.print(remark, markup=False, highlight=False)
    progress.console.print(f"{results.seconds:.0f} s. Report: {this.folder.path / 'report.html'}")
    return results


def start(study: Study) -> None:
    """Run a study from the command line."""
    module = inspect.getmodule(study.units)
    with exit_in_a_line("interrupted; what is finished is kept: start it again to go on"):
        run(study, tyro.cli(study.args, description=module.__doc__ if module else None))


@contextmanager
def exit_in_a_line(interrupted: str) -> Iterator[None]:
    """What the user can put right is said in one line, without a traceback."""
    try:
        yield
    except (OSError, UsageError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(interrupted)


def _write(this: Run, results: Results, found: Found, manifest: str) -> None:
    study = this.study
    cards = study.cards(this, results) if callable(study.cards) else study.cards
    filled = [card.fill(results) for card in cards]
    sections, command = study.page(this, results, found), this.args.command(study.name)
    report = Report(study.title, study.question, results, filled, sections, command, study.again)
    with this.folder.fill() as partial:
        report.write(partial)
        (partial / "identity.txt").write_text(this.identity + "\n", encoding="utf-8")
        named = {"scenes.json": manifest} if manifest else {}
        for name, text in {**named, **study.files(this, found)}.items():
            (partial / name).write_text(text, encoding="utf-8")


def scenes_manifest(units: Sequence[Unit[Any]]) -> str:
    """Every scene of some units, once, a line each: with it the environments build the same scenes again."""
    scenes = chain.from_iterable(map(_scenes_of, units))
    lines = dict.fromkeys(map(scene_line, scenes))
    return "[\n" + ",\n".join(sorted(lines)) + "\n]\n" if lines else ""


def _note_seeds(seeds: dict[str, list[int]], part: str, units: Sequence[Unit[Any]]) -> None:
    """The seeds of every unit's `scene` or `scenes`, by what it was used for, and its `slot_seeds`."""
    for unit in units:
        used = [("slots", seed) for seed in getattr(unit, "slot_seeds", ())]
        for group, seed in used + [(f"{part}, {scene.split}", scene.seed) for scene in _scenes_of(unit)]:
            if seed not in (known := seeds.setdefault(group, [])):
                known.append(seed)


def _scenes_of(unit: Unit[Any]) -> list[Any]:
    return list(getattr(unit, "scenes", None) or filter(None, [getattr(unit, "scene", None)]))


class OutputFolder:
    """A folder such as `results/controllability`.

    Making one creates the folder and proves that files can be written there, so that a study of an hour cannot fail at
    its last step. `fill` then gives a temporary folder; only when its block ends well do the files move into place,
    each by one atomic rename, `results.json` last. Other files in the folder are left alone.

    Raises:
        OSError: if files cannot be written there; the message names it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.path, prefix=".writable-"):
                pass
        except (FileExistsError, NotADirectoryError):
            raise NotADirectoryError(f"cannot write to {self.path}: a file of that name is in the way") from None
        except OSError as error:
            raise type(error)(f"cannot write to {self.path}: {error.strerror or error}") from None

    @contextmanager
    def fill(self) -> Iterator[Path]:
        """A temporary folder; its files replace those of the same name here once the block ends well."""
        with tempfile.TemporaryDirectory(dir=self.path, prefix=".partial-") as partial:
            yield Path(partial)
            files = (p for p in Path(partial).rglob("*") if p.is_file())
            # results.json says that a study is complete, so it must be the last to appear.
            for file in sorted(files, key=lambda p: p.name == "results.json"):
                target = self.path / file.relative_to(partial)
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(file, target)
