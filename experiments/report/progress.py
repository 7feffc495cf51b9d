"""What a study shows while it runs: tables that fill up, bars, and an estimate of the time that is left."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from experiments.report.tables import TERMINAL, Table

T = TypeVar("T")
TRUST_UNITS = 2.0  # a declared time counts as much as so many measured units of the same part
TRUST_SECONDS = 5.0  # the declared times of all parts together, as so many seconds of measured work


@dataclass
class _Part:
    """One kind of work."""

    total: int  # units
    declared: float  # seconds a unit
    done: int = 0
    timed: int = 0  # units of this run
    seconds: float = 0.0  # that those took


class Estimate:
    """How long a study still takes, from the declared seconds of each kind of work and the measured ones.

    A part that has begun is estimated from its own units. One that has not is estimated from its declared seconds,
    scaled by how much slower or faster the other parts were than declared.

    Args:
        parts: name -> (units, rough seconds of a unit on one core).
        processes: how many units run at once.
    """

    def __init__(self, parts: Mapping[str, tuple[int, float]], processes: int = 1) -> None:
        self.parts = {n: _Part(total, seconds / processes) for n, (total, seconds) in parts.items()}
        # Processes start, and load the model, before their first unit is done: that tells nothing of the others.
        self._starting = processes

    def finished(self, name: str, seconds: float | None) -> None:
        """Count a unit. Seconds since the unit before; None for one that an earlier run did."""
        part = self.parts[name]
        part.done += 1
        if seconds is not None and self._starting > 0:
            self._starting -= 1
        elif seconds is not None:
            part.timed += 1
            part.seconds += seconds

    def seconds_left(self) -> float:
        """Of the whole study."""
        parts = self.parts.values()
        declared = sum(part.timed * part.declared for part in parts)
        scale = (sum(part.seconds for part in parts) + TRUST_SECONDS) / (declared + TRUST_SECONDS)
        return sum(
            (part.total - part.done) * (TRUST_UNITS * part.declared * scale + part.seconds) / (TRUST_UNITS + part.timed)
            for part in parts
        )

    @property
    def share_done(self) -> float:
        """0..1, by declared seconds."""
        whole = sum(part.total * part.declared for part in self.parts.values())
        return sum(part.done * part.declared for part in self.parts.values()) / whole if whole else 1.0


class StudyProgress:
    """Live tables above progress bars; plain lines when the output is a file.

    `parts` and `processes` are those of `Estimate`.
    """

    def __init__(
        self,
        parts: Mapping[str, tuple[int, float]],
        processes: int = 1,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.console = console or Console()
        if not self.console.is_terminal:
            self.console.width = TERMINAL  # a file has no width
        self._clock, self._estimate = clock, Estimate(parts, processes)
        self._bars = Progress(
            TextColumn("{task.description:<22}"), BarColumn(bar_width=28), MofNCompleteColumn(),
            TextColumn("{task.fields[left]}"), console=self.console,
        )  # fmt: skip
        self._tasks = {name: self._bars.add_task(name, total=n, left="") for name, (n, _) in parts.items()}
        self._whole = self._bars.add_task("[bold]whole study[/]", total=100, left="")
        self._live = Live(self._bars, console=self.console, refresh_per_second=4, transient=True)
        self._began = self._draw_at = clock()

    def __enter__(self) -> StudyProgress:
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def show(self, make: Callable[[], Iterable[Table]]) -> None:
        """Draw the tables as they are now, if anybody watches. Intervals take time, so that is not done every time."""
        if self.console.is_terminal and (now := self._clock()) >= self._draw_at:
            blocks = [block for table in make() for block in table.to_terminal(self.console.width, False)]
            self._live.update(Group(*blocks, self._bars))
            took = self._clock() - now
            self._draw_at = self._clock() + max(2.0, 10 * took)

    def expect(self, part: str, total: int) -> None:
        """Say that a part has another number of units than was thought at first."""
        self._estimate.parts[part].total = total
        self._bars.update(self._tasks[part], total=total)

    def track(self, part: str, units: Iterable[T], kept: int = 0) -> Iterator[T]:
        """Pass the finished units of a part through, advancing its bar. An earlier run did the first `kept` of them."""
        before = self._clock()
        for done, unit in enumerate(units, start=1):
            self._estimate.finished(part, None if done <= kept else self._clock() - before)
            left = self._estimate.seconds_left()
            self._bars.advance(self._tasks[part])
            about, total = f"about {left:.0f} s left", self._estimate.parts[part].total
            self._bars.update(self._whole, completed=100 * self._estimate.share_done, left=about)
            # A file gets a line for every fifth of a part.
            if not self.console.is_terminal and done * 5 // total != (done - 1) * 5 // total:
                elapsed = self._clock() - self._began
                self.console.print(f"{part}: {done}/{total}, {elapsed:.0f} s elapsed, {about}")
            yield unit
            before = self._clock()

    def print(self, *tables: Table) -> None:
        """Print finished tables, no figure cut off, with their intervals."""
        for table in tables:
            for block in table.to_terminal(self.console.width):
                self.console.print(block)
