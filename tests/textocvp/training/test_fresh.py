"""Runs that begin anew, and two that would write to one folder."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from textocvp.training.run import LOCK_FILE, SETTINGS_FILE, Run, SettingsError, TrainingSettings, close_run, open_run


def test_fresh_throws_the_run_away_and_nothing_else(tmp_path: Path) -> None:
    for name in ("state/a", "checkpoint/b", "samples/c", "slots-train/d", "mine/e"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    args = TrainingSettings(Path("a"), Path("b"), tmp_path, fresh=True, batch=2)
    accelerator = open_run(tmp_path, "no")
    with pytest.raises(SettingsError, match="cannot be shared out"):
        Run(replace(args, accumulate=3), accelerator, torch.nn.Linear(2, 2))
    assert (tmp_path / "state/a").exists()  # nothing is thrown away for settings that cannot be
    assert Run(args, accelerator, torch.nn.Linear(2, 2)).first == 0
    close_run(accelerator)
    assert {path.name for path in tmp_path.iterdir()} == {"logs", "slots-train", "mine", SETTINGS_FILE}


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
