"""`results.json`: what a study measured, in the one form that can be checked by machine."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from experiments.report.rows import Row, is_number
from textocvp.checkpoint import Checkpoint

PACKAGES = ("textocvp", "torch", "numpy", "pybullet", "gymnasium")


@dataclass(frozen=True)
class EpisodeLine:
    """What came of one method in one scene. The success rates of the rows are the means of these."""

    method: str  # as in the rows
    place: str  # the split of its scene, and which of the scene's sentences it was
    metric: str  # as in the rows
    scene: str  # hash of its line in `scenes.json`, see `scene_hash`
    seed: int  # of the environment
    goal: str  # in words
    success: float  # 0 or 1; of several repeats the mean
    said: Sequence[str] = ()  # the sentences that were carried out, in order
    error: str | None = None  # why the robot gave up


@dataclass(frozen=True)
class Results:
    """A whole `results.json`."""

    study: str  # its name, as `controllability`
    checkpoint: Checkpoint  # the weights
    versions: Mapping[str, str]  # package name -> version; also the hashes of other weights
    seeds: Mapping[str, Sequence[int]]  # every seed used, in groups: name -> seeds
    quick: bool  # whether this was only the short first look
    seconds: float  # how long it took. The only field that differs when a study is repeated with the same seed.
    rows: Sequence[Row]  # the figures
    # the few figures that a reader wants first, name -> number
    headline: Mapping[str, float] = field(default_factory=dict)
    episodes: Sequence[EpisodeLine] = ()  # what the success rates were computed from

    def __post_init__(self) -> None:
        for name, number in self.headline.items():
            if not is_number(number):
                raise ValueError(f"headline {name!r} must be a finite number, got {number!r}")

    def find(self, method: str, variant: str, metric: str, split: str | None = None) -> Row | None:
        """The first row of that method, variant and metric (and split), or None."""
        for row in self.rows:
            same = (row.method, row.variant, row.metric) == (method, variant, metric)
            if same and split in (None, row.split):
                return row
        return None

    def to_json(self) -> str:
        """The text of `results.json`: stable order of keys, no NaN, a line for each episode."""
        data = asdict(self)
        lines = [json.dumps(one, allow_nan=False, ensure_ascii=False) for one in data.pop("episodes")]
        head = json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False)
        listed = "".join(f"{',' * bool(i)}\n    {line}" for i, line in enumerate(lines))
        return f'{head[:-2]},\n  "episodes": [{listed}\n  ]\n}}\n'

    @classmethod
    def from_json(cls, text: str) -> Results:
        """The inverse of `to_json`; a ValueError that names what is missing, unknown or of the wrong kind."""
        data = json.loads(text)
        try:
            rows = [Row(**row) for row in data["rows"]]
            lines = tuple(EpisodeLine(**{**line, "said": tuple(line["said"])}) for line in data["episodes"])
            checkpoint = Checkpoint(**data["checkpoint"])
            return cls(**{**data, "checkpoint": checkpoint, "rows": rows, "episodes": lines})
        except (KeyError, TypeError) as error:
            raise ValueError(f"these are no results: {error}") from error

    @classmethod
    def read(cls, path: str | Path) -> Results:
        """Read a `results.json`."""
        return cls.from_json(Path(path).read_text(encoding="utf-8"))


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that figures depend on; `not installed` where there is none."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions
