"""A study of nothing that takes no time: what the framework does with it is all there is to see."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.report.page import Section
from experiments.report.rows import Row, mean_row
from experiments.report.tables import Line, TableSpec, columns
from experiments.study.pool import Worker
from experiments.study.run import Found, Part, Run, ScenesArgs, Study
from experiments.study.scenes import StudyScene
from textocvp.world_model import Checkpoint

TABLE = TableSpec("Values", columns("value", {"mean": ("test", "all")}), [Line(key="ours"), Line(key="MAGE")])


@dataclass(frozen=True)
class LoadNothing:
    """Makes a model that can do nothing."""

    sha256: str = "a" * 64

    def __call__(self) -> Nothing:
        return Nothing(self.sha256)


class Nothing:
    """See `LoadNothing`."""

    longest_horizon = 24

    def __init__(self, sha256: str) -> None:
        self.checkpoint = Checkpoint("nothing", sha256)

    def rollout(self) -> None:
        """No study of this file asks for it."""


@dataclass(frozen=True)
class Draw:
    """A unit: a number that depends on the scene. Notes that it ran; dies once where it finds the file `die-SEED`."""

    scene: StudyScene
    log: Path

    def run(self, worker: Worker) -> np.ndarray:
        with self.log.open("a") as file:
            file.write(f"{self.scene.seed}\n")
        trap = self.log.with_name(f"die-{self.scene.seed}")
        if trap.exists():
            trap.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.random.default_rng(self.scene.seed).normal(size=3)


def study(log: Path) -> Study:
    """The study; its units write into `log`."""

    def units(run: Run) -> dict[str, Part]:
        scenes = [StudyScene("test", seed, ()) for seed in range(run.sizes)]
        return {"draws": Part([Draw(scene, log) for scene in scenes], 0.1), "again": Part(count=2)}

    def cases(run: Run, found: Found) -> dict[str, Sequence[Draw]]:
        largest = sorted(range(run.sizes), key=lambda i: -found["draws"][i].max())
        return {"again": [Draw(StudyScene("test", 100 + i, ()), log) for i in largest[:2]]}

    def rows(run: Run, found: Found) -> list[Row]:
        values = [float(v.mean()) for v in found["draws"]]
        return [mean_row("ours", "test", "all", "value", values)] if values else []

    return Study(
        name="tiny",
        title="Tiny",
        question="Is it?",
        args=ScenesArgs,
        sizes=lambda args: args.scenes or 6,
        units=units,
        cases=cases,
        rows=rows,
        tables=[TABLE],
        page=lambda run, results, found: [Section("Again", f"{[v.round(6).tolist() for v in found['again']]}")],
        headline={"value": ("ours", "test", "all", "value")},
    )
