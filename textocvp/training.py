"""What both training stages share: starting, saving and continuing a run.

A run's folder holds `state/` (everything needed to continue exactly: weights, optimiser, schedule, random numbers and
the number of the next step), `logs/` (TensorBoard) and whatever the stage writes for people and for the next stage.
Batches are drawn from a generator seeded by (seed, step), so the order of the data needs no saving.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from accelerate import Accelerator

STEP_FILE = "step.json"


def start(
    out: Path, precision: Literal["no", "bf16", "fp16"], accumulation: int = 1, cpu: bool = False
) -> Accelerator:
    """An accelerator that logs to `out`/logs. Makes the folder, so that an unwritable one fails before any work."""
    (out / "logs").mkdir(parents=True, exist_ok=True)
    torch.set_flush_denormal(True)  # decaying Adam moments reach denormals, which are slow on CPUs
    accelerator = Accelerator(
        mixed_precision=precision,
        gradient_accumulation_steps=accumulation,
        log_with="tensorboard",
        project_dir=str(out / "logs"),
        cpu=cpu,
    )
    accelerator.init_trackers("training")
    return accelerator


def step_rng(seed: int, step: int, process: int = 0) -> np.random.Generator:
    """The generator of one step's batch on one process."""
    return np.random.default_rng([seed, step, process])


def save_state(accelerator: Accelerator, out: Path, next_step: int) -> None:
    """Replace `out`/state by the present state; killed at any moment, the old or the new state is there whole."""
    new, state, old = out / "state.new", out / "state", out / "state.old"
    if accelerator.is_main_process:
        shutil.rmtree(new, ignore_errors=True)
    accelerator.wait_for_everyone()
    accelerator.save_state(str(new))
    if accelerator.is_main_process:
        (new / STEP_FILE).write_text(json.dumps({"next_step": next_step}))
        shutil.rmtree(old, ignore_errors=True)
        if state.exists():
            state.rename(old)
        new.rename(state)
        shutil.rmtree(old, ignore_errors=True)
    accelerator.wait_for_everyone()


def load_state(accelerator: Accelerator, out: Path) -> int:
    """Continue from `out`/state if there is one; the number of the next step, 0 for a new run."""
    state = out / "state"
    if not state.exists() and (out / "state.old").exists():  # killed between the two renames of save_state
        (out / "state.old").rename(state)
    if not state.exists():
        return 0
    accelerator.load_state(str(state))
    return int(json.loads((state / STEP_FILE).read_text())["next_step"])
