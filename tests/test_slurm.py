"""The Slurm example, run by stand-ins for Slurm's programs: processes, signals and queueing again are those it says."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parent.parent / "docs" / "slurm" / "train.sbatch"

SRUN = """
import os, signal, subprocess, sys
command = [word for word in sys.argv[1:] if not word.startswith("--kill")]
tasks = [
    subprocess.Popen(command, env={**os.environ, "SLURM_PROCID": str(n), "SLURM_LOCALID": str(n), "SLURM_NTASKS": "2"})
    for n in range(2)
]
signal.signal(signal.SIGTERM, lambda *_: [task.send_signal(signal.SIGTERM) for task in tasks])
sys.exit(max(task.wait() for task in tasks))
"""
SCONTROL = """
import sys
if sys.argv[1] == "show":
    print("first\\nsecond")
else:
    open("requeued", "a").write(sys.argv[2])
"""
TEXTOCVP = """
import os, signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(int(os.environ.get("ENDS_WITH", 143))))
names = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
with open("task-" + os.environ["RANK"], "w") as file:
    file.write(" ".join([*sys.argv[1:], *(os.environ[name] for name in names)]))
while "--forever" in sys.argv:
    time.sleep(0.02)
"""


@pytest.fixture
def job(tmp_path: Path):
    """Starts the script as job 20007 of two processes."""
    programs = tmp_path / "programs"
    programs.mkdir()
    for name, text in (("srun", SRUN), ("scontrol", SCONTROL), ("textocvp", TEXTOCVP)):
        (programs / name).write_text(f"#!{sys.executable}\n{text}")
        (programs / name).chmod(0o755)

    def start(*arguments: str, **environment: str) -> subprocess.Popen:
        slurm = {"SLURM_JOB_ID": "20007", "SLURM_JOB_NODELIST": "first,second"}
        path = {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
        return subprocess.Popen(
            ["bash", str(SCRIPT), *arguments], cwd=tmp_path, env={**os.environ, **path, **slurm, **environment}
        )

    return start


def wait_for(*paths: Path) -> None:
    end = time.monotonic() + 60
    while not all(path.exists() and path.read_text() for path in paths):
        assert time.monotonic() < end, "the processes did not start"
        time.sleep(0.02)


def test_every_process_gets_the_command_and_its_place(job, tmp_path: Path) -> None:
    assert job("parser", "--set", "text.kind=t5 small").wait(timeout=60) == 0
    for rank in "01":
        told = (tmp_path / f"task-{rank}").read_text()
        assert told == f"train parser --set text.kind=t5 small {rank} {rank} 2 first 20007"
    assert not (tmp_path / "requeued").exists()


@pytest.mark.parametrize(("ends_with", "requeued"), [("143", True), ("1", False), ("0", False)])
def test_it_queues_itself_again_only_if_the_run_ended_as_asked(
    job, tmp_path: Path, ends_with: str, requeued: bool
) -> None:
    started = job("parser", "--forever", ENDS_WITH=ends_with)
    wait_for(tmp_path / "task-0", tmp_path / "task-1")
    started.send_signal(signal.SIGUSR1)
    assert started.wait(timeout=60) == int(ends_with)
    assert (tmp_path / "requeued").exists() == requeued
    if requeued:
        assert (tmp_path / "requeued").read_text() == "20007"
