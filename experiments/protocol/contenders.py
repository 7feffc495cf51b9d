"""Which models a study compares: ours and the baselines, as far as they are trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from textocvp.checkpoint import CheckpointError
from textocvp.protocols import VideoModel, load_model


class LoadVideoModel(Protocol):
    """Makes a video model. Hashable and equal for equal models, so that a process makes each only once."""

    def __call__(self) -> VideoModel: ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class LoadVideo:
    """Loads a checkpoint of any architecture by its bundled name, folder or hub id."""

    name: str

    def __call__(self) -> VideoModel:
        return load_model(self.name)


@dataclass(frozen=True)
class Baseline:
    """A baseline of the paper.

    Attributes:
        method: its name in tables.
        checkpoint: the bundled one.
        slots: whether it sees things; if not, masks are read off its frames by our parser.
        note: what it is, in a line.
        train: what to type to train it.
    """

    method: str
    checkpoint: str
    slots: bool
    note: str
    train: str


_DATA = "--data data/tabletop-train.h5 --val data/tabletop-val.h5"
BASELINES = (
    Baseline(
        "OCVP-Seq",
        "ocvp-seq-small",
        True,
        "slots, but no text",
        f"textocvp train predictor --parser textocvp/checkpoints/tabletop-small --preset ocvp-seq-small {_DATA} "
        "--out runs/ocvp-seq --steps 1500 --autoregressive 1.0",
    ),
    Baseline(
        "Non-OC",
        "non-oc-small",
        False,
        "text, but one vector for the whole scene",
        f"textocvp train parser --preset non-oc-small {_DATA} --out runs/non-oc-parser --steps 5000 --clip 3 "
        "--stride 8 --batch 16 --learning-rate 2e-3 && "
        f"textocvp train predictor --parser runs/non-oc-parser/checkpoint {_DATA} --out runs/non-oc "
        "--autoregressive 1.0 --content-weight 1 --image-weight 10 --image-frames 2 --steps 1800",
    ),
    Baseline(
        "MAGE",
        "mage-small",
        False,
        "text, and codes of picture patches instead of objects",
        f"textocvp train vqvae {_DATA} --out runs/vqvae --steps 1600 && "
        f"textocvp train mage --vqvae runs/vqvae/checkpoint {_DATA} --out runs/mage --steps 1800 --autoregressive 0.8 "
        "--changed-weight 1",
    ),
)
#: Ours once more: the bundled checkpoint looks 24 frames ahead, and this one, trained on from there, 40.
FAR = Baseline(
    "ours, 40 frames",
    "tabletop-small-40",
    True,
    "ours, trained on to look 40 frames ahead",
    "textocvp train predictor --finetune --set predictor.window=40 --parser textocvp/checkpoints/tabletop-small "
    f"{_DATA} --out runs/window40 --steps 600 --batch 16 --autoregressive 1.0 --horizon 20 --learning-rate 3e-4 "
    "--warmup 50",
)
#: To be said wherever they stand beside ours.
TRAINED_LITTLE = (
    "The bundled baselines are small and were trained for minutes on two cores, as their cards say: none of them was "
    "trained to the end."
)
NOTES = {baseline.method: baseline.note for baseline in (FAR, *BASELINES)}


@dataclass(frozen=True)
class Contender:
    """A baseline that is there.

    Attributes:
        method: its name in tables. load: makes it. slots: see `Baseline`.
        checkpoint, sha256: where it came from.
        longest: how many frames it can imagine at once; None for as many as you like.
    """

    method: str
    load: LoadVideoModel
    slots: bool
    checkpoint: str
    sha256: str
    longest: int | None


@dataclass(frozen=True)
class Absent:
    """A row that stays empty, and why."""

    method: str
    reason: str

    @property
    def text(self) -> str:
        """Both, as a sentence."""
        return f"{self.method} is absent: {self.reason}"


def find_contenders(
    loads: Mapping[str, LoadVideoModel],
) -> tuple[list[Contender], list[Absent]]:
    """The baselines that are there, and those that are not with the reason, in the order of the paper's table.

    Args:
        loads: method -> makes it.

    Raises:
        CheckpointError: if a checkpoint that is not the bundled one cannot be loaded: somebody has asked for it.
    """
    present, absent = [], []
    for baseline in (FAR, *BASELINES):
        if baseline.method not in loads:
            continue
        load = loads[baseline.method]
        try:
            model = load()
        except CheckpointError:
            if load != LoadVideo(baseline.checkpoint):
                raise
            absent.append(Absent(baseline.method, f"not trained: `{baseline.train}`"))
            continue
        where = model.checkpoint
        present.append(
            Contender(baseline.method, load, baseline.slots, where.name, where.sha256, model.longest_horizon)
        )
    return present, absent


def hashes(contenders: Sequence[Contender]) -> dict[str, str]:
    """The SHA-256 of every contender's weights, as `results.json` names them."""
    return {f"checkpoint of {contender.method}": contender.sha256 for contender in contenders}


def absent_text(absent: Sequence[Absent]) -> str:
    """Sentences for a report."""
    return " ".join(f"{one.method} is absent: {one.reason}." for one in absent)
