"""Whether what is killed loses or doubles anything: ``python -m benchmarks.kill``.

A collection and both trainings are killed with SIGKILL, all their processes at once, at random moments, and started
again with the same command, until each has died its share of times. Whatever they leave must be readable after every
death, may never shrink, and must in the end be what a run leaves that nobody killed: the episode file value by value,
the checkpoint tensor by tensor. Half an hour of one core for 100 deaths. Ends with status 1 if anything differs.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import tyro
from safetensors.numpy import load_file
from tqdm import tqdm

LATEST = 1.2  # times the length of a run that nobody kills: the last moment at which a run is killed


@dataclass(frozen=True)
class Args:
    """Kill, start again, compare."""

    kills: int = 100
    """In all."""
    seed: int = 0
    """Of the moments."""
    episodes: int = 60
    """That the collection makes."""
    steps: int = 6
    """Updates of a training, each followed by a saved state."""


@dataclass(frozen=True)
class Work:
    """A command that can be killed, and what it has done at some moment."""

    name: str
    command: Callable[[Path], list[str]]
    count: Callable[[Path], int]  # of episodes or updates that are safe on the disk
    digest: Callable[[Path], str]  # of all that a finished run leaves

    def start(self, out: Path) -> subprocess.Popen[bytes]:
        """Run the command in a group of processes of its own."""
        out.mkdir(exist_ok=True)
        log = open(out.with_suffix(".log"), "ab")  # noqa: SIM115 - the process writes to it
        return subprocess.Popen(self.command(out), stdout=log, stderr=log, start_new_session=True)


def works(args: Args, data: Path) -> list[Work]:
    """The collection and the two trainings, small."""
    cli = [sys.executable, "-m", "textocvp.cli", "train"]
    train = [
        "--data", str(data / "train.h5"), "--val", str(data / "val.h5"), "--steps", str(args.steps), "--batch", "2",
        "--save-minutes", "0", "--evaluate-every", "1000", "--evaluate-episodes", "1",
    ]  # fmt: skip
    collect = [sys.executable, "-m", "envs.collect", "--episodes", str(args.episodes), "--workers", "2"]
    parser = [*cli, "parser", "--clip", "2", *train]
    predictor = [*cli, "predictor", "--parser", "tabletop-small", *train]
    return [
        Work("collection", lambda out: [*collect, "--out", f"{out}/x.h5"], collected, collected_digest),
        Work("stage 1", lambda out: [*parser, "--out", str(out)], trained, trained_digest),
        Work("stage 2", lambda out: [*predictor, "--out", str(out)], trained, trained_digest),
    ]


def collected(out: Path) -> int:
    """Episodes in the file; a ValueError where they are not the first of the split, each once."""
    if not (out / "x.h5").exists():
        return 0
    with h5py.File(out / "x.h5", "r") as file:
        seeds = file["episode/seed"][:]
        if not np.array_equal(seeds, file.attrs["first_seed"] + np.arange(len(seeds))):
            raise ValueError(f"episodes are lost or doubled: {seeds.tolist()}")
        return len(seeds)


def collected_digest(out: Path) -> str:
    """Of every value and attribute of the file."""
    values: dict[str, object] = {"left": sorted(one.name for one in out.iterdir())}
    with h5py.File(out / "x.h5", "r") as file:
        for name, value in file.attrs.items():
            values[f"attribute {name}"] = np.asarray(value).tolist()
        for name in [*file, *(f"episode/{column}" for column in file["episode"])]:
            if isinstance(file[name], h5py.Dataset):
                rows = file[name][:]  # texts are objects, whose bytes are addresses
                values[name] = rows.tolist() if rows.dtype == object else rows.tobytes()
    return hashlib.sha256(repr(sorted(values.items())).encode()).hexdigest()


def trained(out: Path) -> int:
    """Updates of which the state is saved."""
    # Killed between the two renames of a save, a run finds the state under its other name.
    path = next((one for name in ("state", "state.old") if (one := out / name / "step.json").exists()), None)
    return 0 if path is None else int(json.loads(path.read_text())["next_step"])


def trained_digest(out: Path) -> str:
    """Of every tensor of the checkpoint, and of the held-out figures and the settings."""
    digest = hashlib.sha256()
    for name, tensor in sorted(load_file(out / "checkpoint/model.safetensors").items()):
        digest.update(name.encode() + tensor.tobytes())
    for path in sorted(out.glob("*.json")):  # figures, settings
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def kill_and_compare(work: Work, kills: int, rng: np.random.Generator, folder: Path) -> dict[str, int]:
    """Kill runs of this work so many times; numbers of deaths, of runs that ended, and of what went wrong."""
    began = time.monotonic()
    if work.start(folder / "whole").wait() != 0:
        raise SystemExit((folder / "whole.log").read_text()[-2000:])
    length, wanted = time.monotonic() - began, work.digest(folder / "whole")
    found = dict.fromkeys(("kills", "runs", "shrunk", "different", "broken"), 0)
    out, safe = folder / "killed", 0
    with tqdm(total=kills, desc=work.name, unit="kill") as progress:
        while found["kills"] < kills or out.exists():
            process = work.start(out)
            try:
                # The last run of all may end in peace.
                limit = rng.uniform(0, LATEST * length) if found["kills"] < kills else None
                status = process.wait(limit)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                found["kills"] += 1
                progress.update()
                now = work.count(out)
                found["shrunk"] += now < safe
                safe = now
                continue
            found["runs"] += 1
            found["broken"] += status != 0
            found["different"] += status == 0 and work.digest(out) != wanted
            shutil.rmtree(out)
            safe = 0
    return found


def main(args: Args) -> int:
    """Kill and print; the exit status."""
    rng, rows = np.random.default_rng(args.seed), {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for split, episodes in (("train", 16), ("val", 2)):
            command = [sys.executable, "-m", "envs.collect", "--split", split, "--episodes", str(episodes)]
            subprocess.run([*command, "--out", str(folder / f"{split}.h5")], check=True)
        found = works(args, folder)
        for number, work in enumerate(found):
            (folder / str(number)).mkdir()
            share = args.kills // len(found) + (number < args.kills % len(found))
            rows[work.name] = kill_and_compare(work, share, rng, folder / str(number))
    names = list(next(iter(rows.values())))
    print("| | " + " | ".join(names) + " |\n|" + "---|" * (1 + len(names)))
    for work_name, values in rows.items():
        print(f"| {work_name} | " + " | ".join(str(value) for value in values.values()) + " |")
    return int(any(row[name] for row in rows.values() for name in ("shrunk", "different", "broken")))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args, description=__doc__)))
