"""What every study does before its work and after it, once for all of them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from experiments.protocol.arguments import StudyArgs, UsageError
from experiments.protocol.workers import LoadCheckpoint, LoadWorldModel, Pool, StudyModel, available_cores
from experiments.reporting import (
    Checkpoint,
    OutputFolder,
    Report,
    Results,
    Row,
    StudyProgress,
    Table,
    package_versions,
)


@dataclass(frozen=True)
class StudyRun:
    """One run of a study, from the moment that folder and checkpoint are known to be there.

    Attributes:
        study: its name, as its file's.
        args: the command line.
        folder: what it writes.
        load: makes the world model. world_model: one such, for looking at.
        began: when it began, `time.monotonic`.
    """

    study: str
    args: StudyArgs
    folder: OutputFolder
    load: LoadWorldModel
    world_model: StudyModel
    began: float

    @classmethod
    def open(
        cls, study: str, args: StudyArgs, load: LoadWorldModel | None = None, horizon: int = 1
    ) -> StudyRun:
        """Check that the study can be run.

        Args:
            load: makes the world model; by default loads `args.checkpoint`.
            horizon: how many frames it must be able to imagine at once.

        Raises:
            OSError: if the folder cannot be written.
            CheckpointError: if there is no such checkpoint.
            UsageError: if it cannot look that far ahead.
        """
        folder, began = OutputFolder(args.out), time.monotonic()
        load = load or LoadCheckpoint(args.checkpoint)
        world_model = load()
        longest = world_model.longest_horizon
        if longest is not None and longest < horizon:
            raise UsageError(
                f"{args.checkpoint} imagines {longest} frames at most (predictor.window), and this study needs "
                f"{horizon}"
            )
        return cls(study, args, folder, load, world_model, began)

    @property
    def pool(self) -> Pool:
        """As many processes as were asked for."""
        return Pool(self.load, self.args.workers or available_cores())

    @property
    def command(self) -> str:
        """What to type for the same figures."""
        return self.args.command(self.study)

    def results(
        self,
        rows: list[Row],
        headline: dict[str, float],
        seeds: dict[str, list[int]],
        versions: Mapping[str, str] | None = None,
    ) -> Results:
        """The figures, with what they were made from.

        Args:
            versions: of what they depend on beside the packages, as the hashes of other checkpoints.
        """
        where = self.world_model.checkpoint
        return Results(
            study=self.study,
            checkpoint=Checkpoint(where.name, where.sha256),
            versions={**package_versions(), **(versions or {})},
            seeds=seeds,
            quick=self.args.quick,
            seconds=round(time.monotonic() - self.began, 1),
            rows=rows,
            headline=headline,
        )

    def write(self, report: Report, files: Mapping[str, str] | None = None) -> None:
        """Fill the folder in one go.

        Args:
            files: name -> text of files beside the report's own.
        """
        with self.folder.fill() as partial:
            report.write(partial)
            for name, text in (files or {}).items():
                (partial / name).write_text(text, encoding="utf-8")

    def close(
        self, progress: StudyProgress, results: Results, tables: Sequence[Table], remarks: Sequence[str] = ()
    ) -> None:
        """Print the tables, what there is to say about them, and where the report is."""
        progress.print(*tables)
        for remark in remarks:
            progress.console.print(remark, markup=False, highlight=False)
        progress.console.print(f"{results.seconds:.0f} s. Report: {self.folder.path / 'report.html'}")
