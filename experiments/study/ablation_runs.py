"""The models of the ablation study: which there are to train, and what there is of each in the folder of all runs."""

import json
from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from experiments.report.tables import Cell, Line, Table, TableRow
from textocvp.checkpoint import CONFIG_FILE, WEIGHTS_FILE, CheckpointError, read_config
from textocvp.config import ModelConfig, with_settings
from textocvp.presets import preset
from textocvp.protocols import LoadCheckpoint
from textocvp.training.run import STEP_FILE

PRESETS = {"predictor": "tabletop-small", "parser": "savi-small"}  # where the settings of each stage's runs start from
PARTS = {"parser": ("parser", "renderer"), "predictor": ("text", "predictor")}  # what each stage of training trains
FIGURES = {"parser": ("quality.json",), "predictor": ("following.json", "slot_errors.json")}
"""What each stage writes last; `slot_errors.json` where the held-out episodes have no masks."""
WHERE_FROM = ("weights", "fingerprint", "vocabulary", "untrained", "rewrites", "forms")
"""Options that come from pretrained weights or from captions, not from a run's settings."""


@dataclass(frozen=True, kw_only=True)
class AblationRun(Line):
    """One model to train. Its key is the name of its folder, in the folder of all runs."""

    stage: str  # what is trained: `parser` with renderer (stage 1), or text encoder and `predictor` (stage 2)
    preset: str  # where its settings start from
    settings: tuple[str, ...] = ()  # what differs from the preset, each `part.field=value`

    @property
    def config(self) -> ModelConfig:
        """What it must have been trained with."""
        return with_settings(preset(self.preset), self.settings)


NO_BIAS, GAUSSIAN = "predictor.color_bias=false", "parser.initializer=gaussian"
NO_PRIOR = "renderer.mask_prior=false"
# All predictor runs learn from the slots of one parser, from the same episodes in the same order, with as many updates;
# parser runs likewise. Those with the lexicon also learn from recoloured scenes (`textocvp.data.slot_batches`).
RUNS = tuple(
    AblationRun(
        stage=stage, key=key, label=label, preset=PRESETS[stage], settings=tuple(settings),
        note=", ".join(settings) or "the preset as it is",
    )
    for stage, key, label, *settings in (
        ("predictor", "base", "3 layers, residual, lexicon with colour bias"),
        ("predictor", "layers-1", "1 layer", "predictor.layers=1"),
        ("predictor", "layers-2", "2 layers", "predictor.layers=2"),
        ("predictor", "layers-4", "4 layers", "predictor.layers=4"),
        ("predictor", "residual-off", "no residual", "predictor.residual=false"),
        ("predictor", "lexicon-no-bias", "lexicon without colour bias", NO_BIAS),
        ("predictor", "text-transformer", "transformer from scratch", "text.kind=transformer", NO_BIAS),
        ("predictor", "text-minilm", "MiniLM, frozen", "text.kind=minilm", NO_BIAS),
        ("parser", "savi-cluster-prior", "clusters, decoder with prior"),
        ("parser", "savi-cluster", "clusters, decoder without prior", NO_PRIOR),
        ("parser", "savi-gaussian-prior", "Gaussian, decoder with prior", GAUSSIAN),
        ("parser", "savi-gaussian", "Gaussian, decoder without prior", GAUSSIAN, NO_PRIOR),
    )
)  # fmt: skip
PREDICTORS, PARSERS = (tuple(run for run in RUNS if run.stage == stage) for stage in PRESETS)


@dataclass(frozen=True)
class FoundRun:
    """What there is of a run."""

    run: AblationRun
    folder: Path
    state: Literal["trained", "not finished", "not trained", "other settings", "not loadable"]
    detail: str = ""  # which other settings, or why it cannot be loaded here
    updates: int | None = None  # how many it had, where that is known
    sha256: str = ""  # of its weights, first 16 digits, once it has been loaded

    @property
    def checkpoint(self) -> LoadCheckpoint:
        """Makes its model."""
        return LoadCheckpoint(str(self.folder / "checkpoint"))

    @property
    def line(self) -> Line:
        """Its line of a table, with its updates, or why it is absent and what trains it."""
        if self.state == "trained":
            return replace(self.run, note=self.run.note + (f"; {self.updates} updates" if self.updates else ""))
        why = self.detail or f"train it: python experiments/train_ablations.py --only {self.run.key}"
        return replace(self.run, kind="control", note=f"{self.state}; {why}")


def find_run(run: AblationRun, runs: Path) -> FoundRun:
    """Look for a run in the folder of all runs.

    Raises:
        CheckpointError: if its configuration is damaged.
    """
    folder = runs / run.key
    checkpoint, step = folder / "checkpoint", folder / "state" / STEP_FILE
    saved = all((checkpoint / name).is_file() for name in (CONFIG_FILE, WEIGHTS_FILE))
    if not saved or not any((folder / name).is_file() for name in FIGURES[run.stage]):
        return FoundRun(run, folder, "not finished" if step.parent.exists() else "not trained")
    if other := differences(run, read_config(checkpoint)):
        return FoundRun(run, folder, "other settings", "; ".join(other))
    updates = int(json.loads(step.read_text())["next_step"]) if step.is_file() else None
    return FoundRun(run, folder, "trained", updates=updates)


def differences(run: AblationRun, config: ModelConfig) -> list[str]:
    """How a trained model's settings differ from the run's, one sentence each."""
    wanted, found = run.config.to_dict(), config.to_dict()
    return [
        f"{part}.{name} is {found[part].get(name)}, wanted {value}"
        for part in PARTS[run.stage]
        for name, value in wanted[part].items()
        if found[part].get(name) != value and name not in WHERE_FROM
    ]


def load_run(found: FoundRun) -> FoundRun:
    """A trained run with the hash of its weights; `not loadable` if its text encoder, say, cannot be had here."""
    if found.state != "trained":
        return found
    try:
        return replace(found, sha256=found.checkpoint().checkpoint.sha256[:16])
    except (CheckpointError, ImportError, OSError, RuntimeError) as error:
        return replace(found, state="not loadable", detail=str(error))


def runs_table(found: Iterable[FoundRun], failed: Container[str] = ()) -> Table:
    """What there is of each run; `failed` are the names of those whose training just failed."""
    rows = []
    for one in found:
        state = "failed" if one.run.key in failed else one.state
        cells = (one.run.stage, state, str(one.updates or ""), one.detail)
        rows.append(TableRow(one.run.key, [Cell(text) for text in cells]))
    caption = "`python experiments/train_ablations.py --only NAME` trains one."
    return Table("Runs", ["stage", "state", "updates", "detail"], rows, caption)
