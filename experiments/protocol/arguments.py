"""The command line that the studies share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeVar

import tyro

from textocvp.checkpoint import CheckpointError

#: Where every study writes by default.
RESULTS = Path("results")
#: Each seed has scenes of its own, and a split has so many.
LARGEST_SEED = 999


class UsageError(ValueError):
    """Arguments that do not go together, or do not fit the model."""


@dataclass
class StudyArgs:
    """What every study can be told. A study's own arguments are a subclass that gives `out` its default.

    Raises:
        UsageError: if a number is out of range.
    """

    checkpoint: str = "tabletop-small"
    """Bundled name, folder, or id on the Hugging Face hub."""
    out: Path = Path("results/study")
    """Folder for results.json, report.html, plots and clips; --quick has a default of its own, in results/quick."""
    seed: int = 0
    """Chooses the scenes and seeds the slots. The same seed gives the same figures."""
    quick: bool = False
    """A first look with few scenes, at most 3 minutes on 2 cores."""
    workers: int = 0
    """Processes; 0 for one a core. Changes no figure."""

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise UsageError(f"--workers must be at least 0, got {self.workers}")
        if not 0 <= self.seed <= LARGEST_SEED:
            raise UsageError(f"--seed must be 0 to {LARGEST_SEED}, got {self.seed}")
        if self.quick and self.out == type(self).out:
            # A first look must not take the place of figures that took hours.
            self.out = RESULTS / "quick" / self.out.relative_to(RESULTS)

    def command(self, study: str) -> str:
        """What to type for the same figures: every argument that changes them and is not at its default.

        Args:
            study: name of the study's file, without `.py`.
        """
        words = [f"python experiments/{study}.py"]
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("out", "workers", "seed") or value == field.default:
                continue
            option = "--" + field.name.replace("_", "-")
            words.append(option if value is True else f"{option} {value}")
        return " ".join([*words, f"--seed {self.seed}"])


Args = TypeVar("Args", bound=StudyArgs)


def start(study: Callable[[Args], object], args: type[Args]) -> None:
    """Run a study from the command line. What the user can put right is said in one line, without a traceback."""
    try:
        study(tyro.cli(args))
    except (OSError, UsageError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted; nothing was written")
