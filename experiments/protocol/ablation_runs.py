"""Every model of the ablation study: what it is called, what differs, and how it is trained.

One list for both sides: `experiments/train_ablations.py` trains it, `experiments/ablations.py` measures it. All
predictor runs learn from the slots of one parser, the shipped one, from the same episodes in the same order, with
the same number of updates; all parser runs share episodes, order and updates likewise. Runs with the lexicon also
learn from recoloured scenes, which other text encoders cannot (`textocvp.data.slot_batches`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from textocvp.checkpoint import CONFIG_FILE, WEIGHTS_FILE, read_config
from textocvp.config import ModelConfig, with_settings
from textocvp.presets import preset
from textocvp.training.run import STEP_FILE

Stage = Literal["parser", "predictor"]
Group = Literal["reference", "depth", "residual", "text", "initializer and decoder"]

PREDICTOR_STEPS = 500
PREDICTOR_BATCH = 32
PARSER_STEPS = 200
PARSER_BATCH = 16
PARSER_CLIP = 2


@dataclass(frozen=True)
class AblationRun:
    """One model to train.

    Attributes:
        name: of its folder, in the folder of all runs.
        stage: what is trained: a parser with its renderer (stage 1), or text encoder and predictor (stage 2).
        group: the part of the table that it belongs to.
        label: its line in the table.
        preset: where its settings start from.
        settings: what differs from the preset, each `part.field=value`.
    """

    name: str
    stage: Stage
    group: Group
    label: str
    preset: str = "tabletop-small"
    settings: tuple[str, ...] = ()

    @property
    def config(self) -> ModelConfig:
        """What it must have been trained with."""
        return with_settings(preset(self.preset), self.settings)

    @property
    def command(self) -> str:
        """What to type to train it."""
        return f"python experiments/train_ablations.py --only {self.name}"


NO_BIAS = "predictor.color_bias=false"

PREDICTOR_RUNS = (
    AblationRun(
        "base", "predictor", "reference", "3 layers, residual, lexicon with colour bias", "tabletop-small"
    ),
    AblationRun("layers-1", "predictor", "depth", "1 layer", settings=("predictor.layers=1",)),
    AblationRun("layers-2", "predictor", "depth", "2 layers", settings=("predictor.layers=2",)),
    AblationRun("layers-4", "predictor", "depth", "4 layers", settings=("predictor.layers=4",)),
    AblationRun(
        "residual-off", "predictor", "residual", "no residual", settings=("predictor.residual=false",)
    ),
    AblationRun("lexicon-no-bias", "predictor", "text", "lexicon without colour bias", settings=(NO_BIAS,)),
    AblationRun(
        "text-transformer",
        "predictor",
        "text",
        "transformer from scratch",
        settings=("text.kind=transformer", NO_BIAS),
    ),
    AblationRun("text-minilm", "predictor", "text", "MiniLM, frozen", settings=("text.kind=minilm", NO_BIAS)),
)

PARSER_RUNS = (
    AblationRun(
        "savi-cluster-prior",
        "parser",
        "initializer and decoder",
        "clusters, decoder with prior",
        "savi-small",
    ),
    AblationRun(
        "savi-cluster",
        "parser",
        "initializer and decoder",
        "clusters, decoder without prior",
        "savi-small",
        ("renderer.mask_prior=false",),
    ),
    AblationRun(
        "savi-gaussian-prior",
        "parser",
        "initializer and decoder",
        "Gaussian, decoder with prior",
        "savi-small",
        ("parser.initializer=gaussian",),
    ),
    AblationRun(
        "savi-gaussian",
        "parser",
        "initializer and decoder",
        "Gaussian, decoder without prior",
        "savi-small",
        ("parser.initializer=gaussian", "renderer.mask_prior=false"),
    ),
)

RUNS = PREDICTOR_RUNS + PARSER_RUNS


def run_named(name: str) -> AblationRun:
    """The run of that name.

    Raises:
        KeyError: if there is none; the message lists those that exist.
    """
    for run in RUNS:
        if run.name == name:
            return run
    raise KeyError(f"unknown run {name!r}; known: {', '.join(run.name for run in RUNS)}")


# What depends on the machine and the training file, not on the run: where weights were found, and the words.
WHERE_FROM = {"text.weights", "text.fingerprint", "text.vocabulary", "text.untrained"}
PARTS = {"parser": ("parser", "renderer"), "predictor": ("text", "predictor")}


@dataclass(frozen=True)
class FoundRun:
    """What there is of a run.

    Attributes:
        run: which.
        folder: of the run.
        state: `trained`; `unfinished` (it stopped before its end); `missing`; `other settings` than the run's; or
            `unusable` (it cannot be loaded here).
        detail: for the last two, which or why.
        updates: how many updates it had, where that is known.
    """

    run: AblationRun
    folder: Path
    state: Literal["trained", "unfinished", "missing", "other settings", "unusable"]
    detail: str = ""
    updates: int | None = None

    @property
    def checkpoint(self) -> Path:
        """Folder of the trained model."""
        return self.folder / "checkpoint"


def find_run(run: AblationRun, runs: Path) -> FoundRun:
    """Look for a run in the folder of all runs.

    Raises:
        CheckpointError: if its configuration is damaged.
    """
    folder = runs / run.name
    checkpoint, figures = folder / "checkpoint", folder / FIGURES[run.stage]
    if not all(path.is_file() for path in (checkpoint / CONFIG_FILE, checkpoint / WEIGHTS_FILE, figures)):
        return FoundRun(run, folder, "unfinished" if (folder / "state").exists() else "missing")
    other = differences(run, read_config(checkpoint))
    if other:
        return FoundRun(run, folder, "other settings", "; ".join(other))
    step = folder / "state" / STEP_FILE
    updates = int(json.loads(step.read_text())["next_step"]) if step.is_file() else None
    return FoundRun(run, folder, "trained", updates=updates)


FIGURES = {"parser": "quality.json", "predictor": "following.json"}
"""The file that each stage of training writes last."""


def differences(run: AblationRun, config: ModelConfig) -> list[str]:
    """How a trained model's settings differ from the run's, one sentence each."""
    wanted, found = (_flat(one.to_dict(), PARTS[run.stage]) for one in (run.config, config))
    return [
        f"{name} is {found.get(name)}, wanted {value}"
        for name, value in wanted.items()
        if found.get(name) != value and name not in WHERE_FROM
    ]


def _flat(data: Mapping[str, Any], parts: tuple[str, ...]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for part in parts:
        for name, value in data[part].items():
            inner = value.items() if isinstance(value, Mapping) else [("", value)]
            flat |= {f"{part}.{name}" + (f".{key}" if key else ""): one for key, one in inner}
    return flat
