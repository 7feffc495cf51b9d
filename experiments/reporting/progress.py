"""What a study shows while it runs: a table that fills up, and bars with the time that is left."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import TypeVar

from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from experiments.reporting.table import Table

T = TypeVar("T")


class StudyProgress:
    """Live tables above progress bars; plain lines when the output is a file.

    Args:
        parts: name of each part of the study -> (number of work units, rough seconds a unit). The seconds
            only weigh the parts against each other in the bar of the whole study.
        console: where to draw; standard output if None.
    """

    def __init__(self, parts: Mapping[str, tuple[int, float]], console: Console | None = None) -> None:
        self.console = console or Console()
        if not self.console.is_terminal:
            self.console.width = 120  # a file has no width; the 80 that rich assumes would cut the tables
        self._bars = Progress(
            TextColumn("{task.description:<22}"),
            BarColumn(bar_width=28),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("[dim]left[/]"),
            TimeRemainingColumn(),
            console=self.console,
        )
        self._parts = dict(parts)
        self._tasks = {
            name: self._bars.add_task(name, total=n, start=False) for name, (n, _) in parts.items()
        }
        self._total = sum(n * seconds for n, seconds in parts.values()) or 1.0
        self._whole = Progress(
            TextColumn(f"[bold]{'whole study':<22}[/]"),
            BarColumn(bar_width=28),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("[dim]left[/]"),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=self.console,
        )
        self._whole_task = self._whole.add_task("whole", total=self._total)
        self._tables: Sequence[Table] = ()
        self._live = Live(self._draw(), console=self.console, refresh_per_second=4, transient=True)
        self._started = time.monotonic()

    def __enter__(self) -> StudyProgress:
        self._started = time.monotonic()
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.console.is_terminal:
            self._live.stop()

    def show(self, *tables: Table) -> None:
        """Draw these tables from now on."""
        self._tables = tables
        self._live.update(self._draw())

    def expect(self, part: str, total: int) -> None:
        """Say that a part has another number of units than was thought at first."""
        before, seconds = self._parts[part]
        self._parts[part] = (total, seconds)
        self._bars.update(self._tasks[part], total=total)
        self._total += (total - before) * seconds
        self._whole.update(self._whole_task, total=self._total)

    def track(self, part: str, units: Iterable[T]) -> Iterator[T]:
        """Pass the finished units of a part through, advancing its bar."""
        total, seconds = self._parts[part]
        task = self._tasks[part]
        self._bars.start_task(task)
        for done, unit in enumerate(units, start=1):
            yield unit
            self._bars.advance(task)
            self._whole.advance(self._whole_task, seconds)
            if not self.console.is_terminal and (
                done == total or done * 5 // total != (done - 1) * 5 // total
            ):
                self._print_line(part, done, total)

    def print(self, *tables: Table) -> None:
        """Print finished tables, with intervals where there is room for them."""
        for table in tables:
            self.console.print(table.to_rich(intervals=self.console.width >= 110))

    def _print_line(self, part: str, done: int, total: int) -> None:
        elapsed = time.monotonic() - self._started
        share = self._whole.tasks[0].completed / self._total
        left = elapsed / share - elapsed if share > 0 else 0.0
        self.console.print(
            f"{part}: {done}/{total}, {elapsed:.0f} s elapsed, about {max(left, 0):.0f} s left"
        )

    def _draw(self) -> Group:
        return Group(*(table.to_rich(intervals=False) for table in self._tables), self._bars, self._whole)
