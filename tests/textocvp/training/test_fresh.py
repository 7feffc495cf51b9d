"""Runs that begin anew, and two that would write to one folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from textocvp.training.run import LOCK_FILE, SETTINGS_FILE, SettingsError, close_run, open_run


def test_fresh_throws_the_run_away_and_nothing_else(tmp_path: Path) -> None:
    for name in ("state/a", "checkpoint/b", "samples/c", "slots-train/d", "mine/e"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    (tmp_path / SETTINGS_FILE).write_text("{}")
    close_run(open_run(tmp_path, "no"))
    assert (tmp_path / "state/a").exists() and (tmp_path / SETTINGS_FILE).exists()
    close_run(open_run(tmp_path, "no", fresh=True))
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"logs", "slots-train", "mine"}


def test_two_processes_do_not_train_in_one_folder(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
from textocvp.training.run import open_run
open_run(Path({str(tmp_path)!r}), "no")
print("open", flush=True)
input()
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with pytest.raises(SettingsError, match="is being trained by another process"):
            open_run(tmp_path, "no")
        other.kill()  # the lock ends with the process, however that ended
        other.wait()
    close_run(open_run(tmp_path, "no"))
    close_run(open_run(tmp_path, "no"))  # and with the run
    assert not (tmp_path / LOCK_FILE).exists()
