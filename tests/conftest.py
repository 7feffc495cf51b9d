"""For all tests: what is left out without PyBullet, and nothing is left running."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

NEEDS_PYBULLET = re.compile(r"^(from|import) (envs|experiments|pybullet)\b", re.MULTILINE)
SHARED = (b"loky", b"resource_tracker", b"forkserver")  # joblib's and multiprocessing's own, used again by later tests
POOL = "ExecutorManagerThread"  # joblib's
SECONDS = 5.0  # for what is just ending

if find_spec("pybullet") is None:  # as on the newest Pythons
    tests = Path(__file__).parent
    collect_ignore = ["envs", "experiments", "test_readme.py"]
    collect_ignore += [str(file) for file in tests.rglob("test_*.py") if NEEDS_PYBULLET.search(file.read_text("utf-8"))]


@pytest.fixture(autouse=True)
def nothing_is_left_running() -> Iterator[None]:
    """A test that leaves a process or a thread fails; the process is ended, for pytest would wait for it for ever."""
    children, threads = _children(), set(threading.enumerate())
    yield
    end = time.monotonic() + SECONDS
    while (left := _children() - children) and time.monotonic() < end:
        time.sleep(0.02)
    for process in left:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    waiting = {t for t in threading.enumerate() if not t.daemon and t.name != POOL} - threads
    for thread in waiting:
        thread.join(max(0.0, end - time.monotonic()))
    running = [thread.name for thread in waiting if thread.is_alive()]
    assert not left and not running, f"left running: processes {sorted(left)}, threads {running}"


def _children() -> set[int]:
    """This process's own running child processes (Linux; elsewhere none are found)."""
    found = set()
    for listed in Path("/proc/self/task").glob("*/children"):
        with suppress(OSError):
            found |= {int(child) for child in listed.read_text().split()}
    return {child for child in found if not _ended_or_shared(child)}


def _ended_or_shared(process: int) -> bool:
    try:
        command = Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return True
    return not command or any(name in command for name in SHARED)  # a zombie has none
