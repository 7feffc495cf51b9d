"""What all stages of training share: settings, data, held-out figures, and a run of updates on one process or many.

A run's folder holds `state/` (all that is needed to continue exactly), `logs/` (TensorBoard) and what the stage writes.

Whatever is random in an update is a function of (seed, step) alone. Each process computes its rows of the batch, in
micro-batches whose losses add up to that of the batch. So a run is the same run on one process or on many, in one
micro-batch or in many, stopped and continued or not.
"""

import atexit
import errno
import fcntl
import json
import math
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal, TextIO, TypeVar

import numpy as np
import torch
from accelerate import Accelerator, DataLoaderConfiguration, DistributedDataParallelKwargs, InitProcessGroupKwargs
from accelerate.state import AcceleratorState
from safetensors import SafetensorError
from torch import Tensor, nn
from tqdm import tqdm
from transformers import get_cosine_schedule_with_warmup

from textocvp.data import open_episodes
from textocvp.data.episodes import Episodes
from textocvp.files import replace_text

STEP_FILE = "step.json"
SETTINGS_FILE = "settings.json"
LOCK_FILE = ".lock"
RUN_FILES = ("state", "samples", "checkpoint", SETTINGS_FILE)  # of a run, without its logs and caches
LOG_EVERY = 20  # updates
# The least and the most that settings of any stage may be; checked before anything is written.
TINY, SEEDS, LARGEST_BATCH = 1e-12, 2**63 - 1, 65536
LIMITS: dict[str, tuple[float, float]] = {
    "episodes": (1, math.inf),
    "steps": (0, math.inf),
    "batch": (1, LARGEST_BATCH),
    "warmup": (0, math.inf),
    "learning_rate": (TINY, 1.0),
    "clip_norm": (TINY, math.inf),
    "seed": (0, SEEDS),
    "evaluate_every": (1, math.inf),
    "evaluate_episodes": (1, math.inf),
    "save_minutes": (0.0, math.inf),
    "stride": (1, math.inf),
    "parse_every": (1, math.inf),
    "clip": (1, math.inf),
    "workers": (0, math.inf),
    "thing_weight": (0.0, 1e6),
    "changed_weight": (0.0, 1e6),
    "first_redraw": (0, math.inf),
}
BEGINS_WITH = ("parser", "taught", "start", "vqvae")  # settings that name a checkpoint, in one stage or another
SYNC_TIMEOUT = timedelta(hours=12)  # how long processes wait for one that parses or evaluates


class SettingsError(ValueError):
    """Settings that exclude each other or that this machine cannot do; the message says which."""


@contextmanager
def allowed_settings() -> Iterator[None]:
    """For building a model: a plain ValueError, of parts that do not fit each other, becomes a SettingsError."""
    try:
        yield
    except ValueError as error:
        if type(error) is not ValueError:  # missing weights, for example
            raise
        raise SettingsError(str(error)) from error


class DivergedError(SettingsError):
    """Training left the numbers: the loss has no finite gradient any more."""


@dataclass
class RunPaths:
    """Where a stage of training reads and writes."""

    data: Path
    """Training episodes, from `python -m envs.collect --split train`."""
    val: Path
    """Held-out episodes, for the figures."""
    out: Path
    """Folder of the run. If it holds an unfinished run, that run goes on."""


@dataclass(kw_only=True)
class TrainingSettings(RunPaths):
    """What every stage of training can be told; each has its own defaults."""

    episodes: int | None = None
    """Train on the first so many episodes of the file only."""
    set: tuple[str, ...] = ()
    """Settings of the preset to change, each part.field=value: `--set predictor.layers=2`."""
    steps: int = 1000
    """Updates."""
    batch: int = 16
    """Samples an update, shared out among the processes."""
    accumulate: int = 1
    """Micro-batches in which a process computes its share of a batch, one after the other: more need less memory."""
    learning_rate: float = 4e-4
    """Peak of the cosine schedule."""
    warmup: int = 100
    """Updates until the peak."""
    clip_norm: float = 1.0
    """Largest gradient norm."""
    precision: Literal["no", "bf16", "fp16"] = "no"
    """Mixed precision; fp16 needs a GPU."""
    seed: int = 0
    """Seed of weights and data order."""
    evaluate_every: int = 500
    """Updates between figures."""
    evaluate_episodes: int = 40
    """Held-out episodes they are measured on; the final figures use all."""
    save_minutes: float = 4.0
    """Minutes between saved states."""
    fresh: bool = False
    """Throw away the run that `out` holds, finished or not, and begin anew. Its caches and logs stay."""

    def __post_init__(self) -> None:
        for name, (least, most) in LIMITS.items():
            value = getattr(self, name, None)
            if value is not None and not least <= value <= most:
                span = f"at least {least}" + (f" and at most {most}" if most < math.inf else "")
                raise SettingsError(f"--{name.replace('_', '-')} is {value}: must be {span}")
        for name in BEGINS_WITH:
            source = getattr(self, name, None)
            if source and (path := Path(source)).exists() and self.out.resolve() in path.resolve().parents:
                raise SettingsError(
                    f"--{name} {source} lies in --out {self.out}, which this run writes: choose another --out"
                )


@contextmanager
def open_data(args: TrainingSettings, image_size: int, setting: str) -> Iterator[tuple[Episodes, Episodes]]:
    """The training episodes and the held-out ones.

    Args:
        image_size: of the frames that the model reads, in pixels.
        setting: what that size is called in the model's configuration.

    Raises:
        SettingsError: if frames have another size.
        OSError, ValueError: if episodes cannot be read.
    """
    with open_episodes(args.data, args.episodes) as episodes, open_episodes(args.val) as held_out:
        for source in (episodes, held_out):
            if source.image_size != image_size:
                raise SettingsError(
                    f"{source.path} has frames of {source.image_size} pixels, {setting} is {image_size}: "
                    "collect the episodes at that size, or set it"
                )
        yield episodes, held_out


class Metrics:
    """Figures of held-out episodes. Subclasses are frozen dataclasses of numbers and intervals; None: not measured."""

    group: ClassVar[str] = "val"
    """What they are listed under in a log."""

    def measured(self) -> dict[str, Any]:
        """The fields that are numbers or intervals."""
        return {name: value for name, value in vars(self).items() if not isinstance(value, str | None)}

    def as_metrics(self) -> dict[str, float]:
        """What was measured, without intervals, named for a log."""
        measured = self.measured().items()
        return {f"{self.group}/{name}": float(getattr(value, "value", value)) for name, value in measured}

    def to_json(self) -> str:
        """All fields, intervals with their bounds."""
        return json.dumps(asdict(self), indent=2) + "\n"  # type: ignore[call-overload]


M = TypeVar("M", bound=Metrics)


def open_run(out: Path, precision: Literal["no", "bf16", "fp16"], *, some_unused: bool = False) -> Accelerator:
    """An accelerator that logs to `out`/logs: one process, or one of those that `accelerate launch` started.

    Until `close_run`, or until the process ends however that may be, no other process can open a run there.

    Args:
        some_unused: some parameters of what is trained take no part in an update.

    Raises:
        SettingsError: if the machine has no GPU for `fp16`, or another process trains in `out`.
    """
    if precision == "fp16" and not torch.cuda.is_available():
        raise SettingsError("precision fp16 needs a GPU, and there is none here: use bf16 or no")
    (out / "logs").mkdir(parents=True, exist_ok=True)  # an unwritable folder fails before any work
    torch.set_flush_denormal(True)  # decaying Adam moments reach denormals, which are slow on CPUs
    # Without this, several processes without a GPU would each believe to be alone.
    only_cpus = int(os.environ.get("WORLD_SIZE", 1)) > 1 and not torch.cuda.is_available()
    accelerator = Accelerator(
        mixed_precision=precision,
        log_with="tensorboard",
        project_dir=str(out / "logs"),
        cpu=only_cpus,
        # The batch is shared out, not multiplied: the schedule takes one step an update on any number of processes.
        dataloader_config=DataLoaderConfiguration(split_batches=True),
        kwargs_handlers=[
            InitProcessGroupKwargs(timeout=SYNC_TIMEOUT),
            DistributedDataParallelKwargs(find_unused_parameters=some_unused),
        ],
    )
    if accelerator.num_processes > 1:
        atexit.register(_destroy_group)
    if accelerator.is_main_process:
        _lock(out)
    accelerator.init_trackers("training")
    return accelerator


_locks: dict[Path, TextIO] = {}  # open files, whose locks end with the process


def _lock(out: Path) -> None:
    if out.absolute() in _locks:  # of a run that failed in this process; closing the file would lose the lock
        return
    lock = open(out / LOCK_FILE, "a")  # noqa: SIM115 - it stays open
    try:
        fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        if error.errno not in (errno.EACCES, errno.EAGAIN):
            return  # a file system without locks
        raise SettingsError(f"{out} is being trained by another process: wait, or choose another --out") from None
    _locks[out.absolute()] = lock


def _destroy_group() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def close_run(accelerator: Accelerator) -> None:
    """Close the log when all processes are done; another run may be opened afterwards, also in another precision."""
    accelerator.wait_for_everyone()
    out = Path(accelerator.project_dir).parent.absolute()
    if lock := _locks.pop(out, None):
        (out / LOCK_FILE).unlink(missing_ok=True)
        lock.close()
    # Not `end_training`, which also ends the group of processes: the next run of a study could not use it.
    for tracker in accelerator.trackers:
        tracker.finish()
    AcceleratorState._reset_state()


def step_rng(seed: int, step: int) -> np.random.Generator:
    """The generator of everything that is random in one step, the same on all processes."""
    return np.random.default_rng([seed, step])


class Run:
    """A run from wherever `args.out` says it stopped: Adam, a cosine schedule with warm-up, clipped gradients.

    A training loop is

        for step in run.steps("predictor"):
            ...                                         # what the rows `run.rows` of the batch learn from
            for part in run.micro_batches():
                run.backward(...)                       # what the rows `part` of these add to the loss of the batch
            run.update(step)

    Args:
        args: the stage's settings.
        accelerator: from `open_run`.
        module: what is trained.

    Attributes:
        module: the same for calling: else gradients of several processes do not meet.
        first: number of the first step that is left to do.
        rows: the rows of every batch that this process computes.

    Raises:
        SettingsError: if a batch has fewer rows than there are micro-batches.
    """

    def __init__(self, args: TrainingSettings, accelerator: Accelerator, module: nn.Module) -> None:
        count = accelerator.num_processes * args.accumulate
        if args.accumulate < 1 or args.batch < count:
            raise SettingsError(
                f"a batch of {args.batch} cannot be shared out among {accelerator.num_processes} processes x "
                f"{args.accumulate} micro-batches: accumulate must be at least 1, and batch at least {count}"
            )
        self.args, self.accelerator = args, accelerator
        edges = [args.batch * number // count for number in range(count + 1)]
        mine = edges[accelerator.process_index * args.accumulate :][: args.accumulate + 1]
        self.rows, self._edges = slice(mine[0], mine[-1]), mine
        learned = [parameter for parameter in module.parameters() if parameter.requires_grad]
        optimizer = torch.optim.Adam(learned, lr=args.learning_rate)
        schedule = get_cosine_schedule_with_warmup(optimizer, args.warmup, args.steps)
        self.module, self._optimizer, self._schedule = accelerator.prepare(module, optimizer, schedule)
        self._sums: dict[str, Tensor] = {}
        self._bar: Any = None
        # Whether to stop is agreed upon between CPUs: asking the GPUs would make them wait for it at every step.
        # `Any`: what `new_group` says it returns differs between versions of torch.
        self._agreement: Any = None
        if accelerator.num_processes > 1:
            self._agreement = torch.distributed.new_group(backend="gloo", timeout=SYNC_TIMEOUT)
        if args.fresh and accelerator.is_main_process:  # all settings have been checked by now
            for name in RUN_FILES:
                path = args.out / name
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        accelerator.wait_for_everyone()
        try:
            self.first = load_state(accelerator, args.out)
            if accelerator.is_main_process:
                _compare_settings(args, resumed=self.first > 0)
        except SettingsError:
            raise
        except Exception as error:  # several libraries read, each fails in its own way
            said = str(error).partition("\n")[0]
            raise SettingsError(
                f"{args.out} holds a run that cannot be gone on with: its state or {SETTINGS_FILE} is damaged, or of "
                f"another model ({said}); --fresh throws it away"
            ) from error
        if accelerator.is_main_process and self.first >= args.steps > 0:
            tqdm.write(f"the run in {args.out} is finished ({self.first} updates): nothing more is trained")

    @property
    def device(self) -> torch.device:
        """Where this process computes."""
        return self.accelerator.device

    def steps(self, name: str) -> Iterator[int]:
        """The numbers of the steps that are left. Saves the state when it is time to, and at the end.

        On SIGTERM the step is finished, the state saved and the program left with status 143. `name` is on the bar.
        """
        first, total, hidden = self.first, self.args.steps, not self.accelerator.is_main_process
        self._bar = tqdm(range(first, total), name, initial=first, total=total, unit="step", disable=hidden)
        saved = time.monotonic()
        with _termination() as asked:
            for step in self._bar:
                yield step
                due = time.monotonic() - saved > 60 * self.args.save_minutes
                due, stop = self._any_process(due, bool(asked))
                if due or stop:
                    self._save(step + 1)
                    saved = time.monotonic()
                if stop:
                    raise SystemExit(128 + signal.SIGTERM)
        self._save(total)

    def _save(self, next_step: int) -> None:
        if not all(bool(parameter.isfinite().all()) for parameter in self.module.parameters()):
            raise DivergedError(
                f"training diverged before step {next_step}: a weight is not finite. Nothing was saved since the last "
                "good state; lower --learning-rate, with another --out"
            )
        save_state(self.accelerator, self.args.out, next_step)

    def micro_batches(self, *, of_batch: bool = False) -> Iterator[slice]:
        """Parts of this process's rows; each wants one `backward`.

        They are counted from this process's first row, or with `of_batch` from the first of the whole batch.
        """
        zero = 0 if of_batch else self.rows.start
        for first, end in pairwise(self._edges):
            # Gradients travel between processes once an update.
            last = end == self.rows.stop
            with nullcontext() if last else self.accelerator.no_sync(self.module):
                yield slice(first - zero, end - zero)

    def weight(self, part: slice) -> float:
        """How much of a batch these rows are: what a mean over them counts in that over the batch."""
        return (part.stop - part.start) / self.args.batch

    def backward(self, loss: Tensor, terms: Mapping[str, Tensor] | None = None) -> None:
        """Add the gradients of what a micro-batch adds to the loss of the batch; `terms` are for the log."""
        # Gradients are averaged over the processes; they are meant to add up.
        self.accelerator.backward(loss * self.accelerator.num_processes)
        for name, value in {"total": loss, **(terms or {})}.items():
            self._sums[f"loss/{name}"] = self._sums.get(f"loss/{name}", 0.0) + value.detach()

    def update(self, step: int, metrics: Mapping[str, float] | None = None) -> None:
        """Take the step that the gradients ask for, and log now and then, also `metrics`, equal on all processes."""
        norm = self.accelerator.clip_grad_norm_(self.module.parameters(), self.args.clip_norm)
        # With fp16 the scaler skips such a step, and tries a smaller scale.
        if self.args.precision != "fp16" and not bool(torch.isfinite(torch.as_tensor(norm))):
            raise DivergedError(
                f"training diverged at step {step + 1}: the gradient is not finite. Nothing was saved since the last "
                "good state; lower --learning-rate, or raise --warmup, with another --out"
            )
        self._optimizer.step()
        self._schedule.step()
        self._optimizer.zero_grad()
        if step % LOG_EVERY == 0:
            sums = self.accelerator.reduce(self._sums, "sum")
            values = {name: float(value) for name, value in sums.items()}
            self.accelerator.log({**values, "gradient_norm": float(norm), **(metrics or {})}, step)
            self._bar.set_postfix({name.removeprefix("loss/"): f"{x:.4f}" for name, x in values.items()})
        self._sums = {}

    def evaluate(
        self, step: int, measure: Callable[[int | None], Metrics], draw: Callable[[Path], None] | None = None
    ) -> None:
        """Every `args.evaluate_every` updates, on the main process.

        Args:
            measure: gives the figures of the first so many held-out episodes, or of all (None).
            draw: writes a picture of a few of them.
        """
        if not self.accelerator.is_main_process or (step + 1) % self.args.evaluate_every:
            return
        metrics = measure(self.args.evaluate_episodes)
        self.accelerator.log(metrics.as_metrics(), step)
        tqdm.write(f"step {step + 1}: {metrics}")
        if draw is not None:
            draw(self.args.out / "samples" / f"{step + 1:06d}.png")

    def finish(self, save: Callable[[Path], Any], measure: Callable[[int | None], M], file: str) -> M | None:
        """Write `out`/checkpoint, and the figures of all held-out episodes as `out`/`file`; None on other processes."""
        if not self.accelerator.is_main_process:
            return None
        save(self.args.out / "checkpoint")
        metrics = measure(None)
        print(f"final: {metrics}")
        replace_text(self.args.out / file, metrics.to_json())
        return metrics

    def total(self, amount: Tensor) -> Tensor:
        """The sum over all processes of a tensor that needs no gradient: what a weighted loss is divided by."""
        return self.accelerator.reduce(amount.detach(), "sum")

    def _any_process(self, *answers: bool) -> tuple[bool, ...]:
        """Each answer, whether any process gave it: clocks differ and signals do not reach all."""
        if self._agreement is None:
            return answers
        said = torch.tensor(answers, dtype=torch.int32)
        torch.distributed.all_reduce(said, torch.distributed.ReduceOp.MAX, group=self._agreement)
        return tuple(bool(answer) for answer in said)


# What may change when a run goes on: where it lies, how long, how fast and how closely watched it is.
_FREE = {
    "out", "data", "val", "parser", "vqvae", "taught", "start", "fresh", "steps", "accumulate", "precision", "workers",
    "save_minutes", "evaluate_every", "evaluate_episodes",
}  # fmt: skip


def _compare_settings(args: TrainingSettings, resumed: bool) -> None:
    """Note the settings of a new run; refuse to go on with one that had others."""
    path = args.out / SETTINGS_FILE
    now = {name: value for name, value in asdict(args).items() if name not in _FREE}
    now = json.loads(json.dumps(now, default=str))
    if not resumed:
        replace_text(path, json.dumps(now, indent=2) + "\n")
    elif path.exists():
        before = json.loads(path.read_text())
        for name, value in now.items():
            if name in before and before[name] != value:  # older runs lack newer settings
                raise SettingsError(
                    f"{args.out} holds a run with {name.replace('_', '-')} {before.get(name)!r}, not {value!r}: "
                    "give the same settings to go on with it, --fresh to throw it away, or another --out"
                )


@contextmanager
def _termination() -> Iterator[list[int]]:
    """Collects SIGTERM instead of dying of it."""
    asked: list[int] = []
    try:
        before = signal.signal(signal.SIGTERM, lambda number, frame: asked.append(number))
    except ValueError:  # only the main thread may
        yield asked
        return
    try:
        yield asked
    finally:
        signal.signal(signal.SIGTERM, before)


def save_state(accelerator: Accelerator, out: Path, next_step: int) -> None:
    """Replace `out`/state by the present state; killed at any moment, the old or the new state is there whole."""
    new, state, old = out / "state.new", out / "state", out / "state.old"
    if accelerator.is_main_process:
        shutil.rmtree(new, ignore_errors=True)
    accelerator.wait_for_everyone()
    try:
        accelerator.save_state(str(new))
        if accelerator.is_main_process:
            (new / STEP_FILE).write_text(json.dumps({"next_step": next_step}))
    except (OSError, RuntimeError, SafetensorError) as error:  # several libraries write, each fails in its own way
        shutil.rmtree(new, ignore_errors=True)
        said = str(error).partition("\n")[0]
        raise OSError(
            f"no state can be saved to {state}, is there room on the disk? An old one is kept ({said})"
        ) from error
    accelerator.wait_for_everyone()
    if accelerator.is_main_process:
        shutil.rmtree(old, ignore_errors=True)
        if state.exists():
            state.rename(old)
        new.rename(state)
        shutil.rmtree(old, ignore_errors=True)
    accelerator.wait_for_everyone()


def load_state(accelerator: Accelerator, out: Path) -> int:
    """Continue from `out`/state if there is one; the number of the next step, 0 for a new run."""
    state = out / "state"
    if accelerator.is_main_process and not state.exists() and (out / "state.old").exists():
        (out / "state.old").rename(state)  # killed between the two renames of save_state
    accelerator.wait_for_everyone()
    if not state.exists():
        return 0
    accelerator.load_state(str(state))
    return int(json.loads((state / STEP_FILE).read_text())["next_step"])
