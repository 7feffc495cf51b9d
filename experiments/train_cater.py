"""Make everything that `experiments/cater.py` measures: the clips of CATER-hard, and every model of its tables.

    python experiments/train_cater.py --list              # the commands, and what is done already
    python experiments/train_cater.py                     # two cores: hours
    python experiments/train_cater.py --scale gpu --jobs 8 --workers 14    # a GPU and 16 cores: minutes
    python experiments/train_cater.py --scale toy         # a few updates of each, to see that all of it runs

Each step is a command that can also be typed. Steps that need nothing of each other run side by side (`--jobs`). Stop
at any moment and start again: finished steps are skipped, an unfinished one goes on where it was.
"""

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro
from joblib import Parallel, delayed

from textocvp.data import open_episodes
from textocvp.data.cache import cached_slots
from textocvp.model import TextOCVP

DONE = "done"
SLOTS = {"slots-train": "train.h5", "slots-val": "val.h5"}  # as `textocvp train predictor` names them


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How much is made: clips, and the updates of each step with their batch; steps of no updates are left out."""

    train: int
    val: int
    seen: int  # the first clips, from which the voting parsers learn, and MAGE
    votes: tuple[int, int]
    draw: tuple[int, int]
    predictor: tuple[int, int]
    polish: tuple[int, int]
    rows: tuple[int, int]  # of each predictor of the ablation: without text, and with words of each kind
    savi: str  # preset of published slot attention
    stills: tuple[int, int]
    clips: tuple[int, int]
    savi_predictor: tuple[int, int]
    vqvae: tuple[int, int]
    mage: tuple[int, int]
    evaluate: int = 20  # held-out clips


SCALES = {
    "toy": Scale(
        train=60, val=16, seen=40, votes=(4, 4), draw=(4, 4), predictor=(6, 4), polish=(2, 4), rows=(4, 4),
        savi="savi-cater", stills=(4, 2), clips=(2, 2), savi_predictor=(2, 2), vqvae=(4, 2), mage=(2, 2), evaluate=2,
    ),
    "cpu": Scale(
        train=12000, val=100, seen=3200, votes=(2000, 16), draw=(1200, 16), predictor=(10500, 16),
        polish=(6000, 16), rows=(4000, 16), savi="savi-small", stills=(9500, 16), clips=(0, 0),
        savi_predictor=(1500, 16), vqvae=(1600, 16), mage=(1000, 8),
    ),
    "gpu": Scale(
        train=5000, val=120, seen=5000, votes=(3000, 32), draw=(1500, 16), predictor=(4000, 64),
        polish=(0, 0), rows=(4000, 64), savi="savi-cater", stills=(6000, 64), clips=(1000, 24),
        savi_predictor=(1500, 32), vqvae=(3000, 32), mage=(2000, 32), evaluate=60,
    ),
}  # fmt: skip
# Ten slots from one Gaussian, as published; the small ones with a wider decoder, and without its Gaussian prior.
SAVI = {
    "savi-cater": ("parser.num_slots=10",),
    "savi-small": ("parser.num_slots=10", "parser.initializer=gaussian", "renderer.hidden=96", "renderer.layers=3",
                   "renderer.mask_prior=false"),
}  # fmt: skip


@dataclass
class Args:
    """Make the clips of CATER-hard and train every model on them."""

    out: Path | None = None
    """Folder of all of it; runs/cater, or runs/cater-SCALE at another scale."""
    scale: Literal["toy", "cpu", "gpu"] = "cpu"
    """How much: a few updates, what two cores do in a night, or what a GPU does in minutes."""
    jobs: int = 1
    """Steps side by side."""
    workers: int = 2
    """Processes that draw or parse clips."""
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Only these steps, with what they need."""
    collector: str = sys.executable
    """A Python with PyBullet, where this one has none."""
    seed: int = 0
    """Of weights and data order."""
    parse: tuple[Path, Path] | None = None
    """A checkpoint and a folder: only write the slots of all clips there, with so many processes."""
    list: bool = False
    """Print the commands and run none."""

    @property
    def folder(self) -> Path:
        """Where all of it is."""
        return self.out or Path("runs/cater" if self.scale == "cpu" else f"runs/cater-{self.scale}")


@dataclass(frozen=True)
class Step:
    """One command."""

    name: str
    command: tuple[str, ...]
    done: Path  # what is there when it has run
    updates: int | None = None  # of a training
    needs: tuple[str, ...] = ()
    slots: Path | None = None  # where the slots of all clips are, for a run that learns from them
    clips: int = 0  # of a collection, which leaves a file of fewer when it is stopped

    @property
    def is_done(self) -> bool:
        """Whether it has run to its end."""
        if not (self.done.exists() and self.clips):
            return self.done.exists()
        with open_episodes(self.done) as episodes:
            return len(episodes) >= self.clips


def steps(args: Args) -> list[Step]:
    """All of them, in an order in which they can run."""
    out, scale = args.folder, SCALES[args.scale]
    data = ("--data", f"{out}/train.h5", "--val", f"{out}/val.h5")

    def collect(split: str, episodes: int) -> Step:
        path = out / f"{split}.h5"
        options = ("--world", "cater", "--split", split, "--episodes", str(episodes), "--out", str(path))
        workers = ("--workers", str(args.workers if split == "train" else 2))
        return Step(split, (args.collector, "-m", "envs.collect", *options, *workers), path, clips=episodes)

    def train(name: str, kind: str, needs: str, size: tuple[int, int], *options: str) -> Step:
        sizes = ("--steps", str(size[0]), "--batch", str(size[1]), "--seed", str(args.seed))
        few = ("--evaluate-every", str(max(1, size[0] // 4)), "--evaluate-episodes", str(scale.evaluate))
        command = (sys.executable, "-m", "textocvp.cli", "train", kind, *data, "--out", f"{out}/{name}")
        linked = [one for one in needs.split() if "slots" in one]
        return Step(
            name,
            (*command, *sizes, *few, *options),
            out / name / "checkpoint",
            size[0],
            ("train", "val", *needs.split()),
            out / linked[0] if linked else None,
        )

    def slots(name: str, parser: str) -> Step:
        checkpoint = f"{out}/{parser}/checkpoint"
        command = (sys.executable, __file__, "--parse", checkpoint, str(out / name), "--workers", str(args.workers))
        return Step(name, (*command, "--out", str(out)), out / name / DONE, needs=("train", "val", parser))

    reads = ("--workers", {"toy": "0", "cpu": "1", "gpu": "4"}[args.scale])
    seen = ("--episodes", str(scale.seen), *reads)
    taught = ("--preset", "cater", "--clip", "1", "--learning-rate", "2e-3", "--warmup", "50", *seen)
    never = ("--first-redraw", str(scale.votes[0]))
    savi = ("--preset", scale.savi, "--set", *SAVI[scale.savi], *reads)
    fast = ("--precision", "bf16") if args.scale == "gpu" else ()
    films = ("--learning-rate", "1e-3", "--autoregressive", "0.33", "--horizon", "8")
    cater = ("--parser", f"{out}/draw/checkpoint", *films)
    words = ("--words-first", str(scale.predictor[0] * 8 // 21))
    learned = round(scale.rows[0] * 8 / 21)  # updates in which the ablation's words are learned
    plain = ("predictor.appearance=false", "text.kind=transformer")
    color = ("predictor.appearance=false", "predictor.color_bias=true", "text.kind=lexicon")
    savi_parser = "savi-clips" if scale.clips[0] else "savi-stills"
    savi_text: tuple[str, ...] = ("--preset", "savi-cater", "--learning-rate", "2e-4")
    if scale.savi == "savi-small":
        savi_text = ("--learning-rate", "1e-3", "--set", "text.kind=transformer", "predictor.window=29")
    found = [
        collect("train", scale.train),
        collect("val", scale.val),
        train("votes", "parser", "", scale.votes, *taught, *never),
        train("draw-videos", "parser", "votes", scale.draw, *taught, "--taught", f"{out}/votes/checkpoint"),
        train("votes-masks", "parser", "", scale.votes, *taught, *never, "--teacher", "masks"),
        train("draw", "parser", "votes-masks", scale.draw, *taught, "--taught", f"{out}/votes-masks/checkpoint"),
        slots("slots", "draw"),
        train("predictor", "predictor", "slots", scale.predictor, *cater, *words),
        train("polish", "predictor", "predictor slots", scale.polish, "--finetune", "--parser",
              f"{out}/predictor/checkpoint", "--learning-rate", "7e-4", "--autoregressive", "0.6", "--horizon", "12"),
        train("predictor-words", "predictor", "slots", (learned + scale.rows[0], scale.rows[1]), *cater,
              "--words-first", str(learned)),
        train("predictor-plain", "predictor", "slots", scale.rows, *cater, "--set", *plain),
        train("predictor-color", "predictor", "slots", scale.rows, *cater, "--set", *color),
        train("ocvp-seq", "predictor", "slots", scale.rows, *cater, "--preset", "ocvp-seq-small", "--set",
              "predictor.window=29"),
        # Single frames first: slots bind to things before they follow them.
        train("savi-stills", "parser", "", scale.stills, *savi, *fast, "--clip", "1", "--learning-rate", "4e-4"),
        train("savi-clips", "parser", "savi-stills", scale.clips, *savi, *fast, "--clip", "6", "--stride", "2",
              "--start", f"{out}/savi-stills/checkpoint", "--learning-rate", "2e-4"),
        slots("savi-slots", savi_parser),
        train("savi", "predictor", "savi-slots", scale.savi_predictor, "--parser", f"{out}/{savi_parser}/checkpoint",
              *savi_text, *fast),
        train("vqvae", "vqvae", "", scale.vqvae),
        train("mage", "mage", "vqvae", scale.mage, *seen[:2], "--vqvae", f"{out}/vqvae/checkpoint",
              "--autoregressive", "0.8", "--changed-weight", "1"),
    ]  # fmt: skip
    return [step for step in found if step.updates != 0]


def main(args: Args) -> int:
    """Run what is missing; the exit status, 1 if a step failed (what does not need it runs all the same)."""
    if args.parse is not None:
        parse(args, *args.parse)
        return 0
    chosen = wanted(steps(args), args.only)
    if args.list:
        for step in chosen:
            print(f"# {step.name}{' (done)' if step.is_done else ''}\n{shlex.join(step.command)}")
        return 0
    args.folder.mkdir(parents=True, exist_ok=True)
    states = {step.name: "done" if step.is_done else "waits" for step in chosen}
    began, running = time.monotonic(), dict[Future[bool], Step]()
    with ThreadPoolExecutor(args.jobs) as pool:
        while True:
            for step in chosen:
                if states[step.name] == "waits" and any(states[one] == "failed" for one in step.needs):
                    states[step.name] = "failed"
                ready = states[step.name] == "waits" and all(states[one] == "done" for one in step.needs)
                if ready and len(running) < args.jobs:
                    states[step.name] = "runs"
                    running[pool.submit(run, step, args.folder)] = step
                    print(f"{time.monotonic() - began:6.0f} s  {step.name} begins", flush=True)
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                step = running.pop(future)
                states[step.name] = "done" if future.result() else "failed"
                print(f"{time.monotonic() - began:6.0f} s  {step.name} {states[step.name]}", flush=True)
    return int("failed" in states.values())


def wanted(found: Sequence[Step], only: Sequence[str]) -> list[Step]:
    """The steps of these names (all by default), and those that they need.

    Raises:
        ValueError: if there is no such step.
    """
    known = {step.name: step for step in found}
    names = list(only) or list(known)
    for name in names:
        if name not in known:
            raise ValueError(f"there is no step {name!r}: {', '.join(known)}")
        names += [one for one in known[name].needs if one not in names]
    return [step for step in found if step.name in names]


def run(step: Step, out: Path) -> bool:
    """Run one step, its output in `out`/NAME.log; whether it ended well."""
    if step.slots is not None:
        folder = out / step.name
        folder.mkdir(exist_ok=True)
        for name in SLOTS:
            if not (folder / name).exists():
                (folder / name).symlink_to((step.slots / name).absolute())
    with open(out / f"{step.name}.log", "ab") as log:
        ended = subprocess.run(step.command, stdout=log, stderr=log, check=False).returncode
    return ended == 0 and step.is_done


def parse(args: Args, checkpoint: Path, folder: Path) -> None:
    """Write the slots of all clips, with several processes: a parser that looks at pixels one by one is slow."""
    for name, file in SLOTS.items():
        jobs = (
            delayed(_parse)(checkpoint, args.folder / file, folder / name, i, args.workers) for i in range(args.workers)
        )
        Parallel(n_jobs=args.workers)(jobs)
    (folder / DONE).touch()


def _parse(checkpoint: Path, data: Path, folder: Path, process: int, processes: int) -> None:
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // processes))
    with open_episodes(data) as episodes:
        model = TextOCVP.from_pretrained(str(checkpoint)).eval()
        cached_slots(model, episodes, folder, process, processes)


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args, description=__doc__)))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
