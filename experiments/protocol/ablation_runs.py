"""Every model of the ablation study: what it is called, what differs, and how it is trained.

One list for both sides: `experiments/train_ablations.py` trains it, `experiments/ablations.py` measures it. All
predictor runs learn from the slots of one parser, the shipped one, from the same episodes in the same order, with
the same number of updates; all parser runs share episodes, order and updates likewise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Stage = Literal["parser", "predictor"]
Group = Literal["reference", "depth", "residual", "text", "initializer and decoder"]

PREDICTOR_STEPS = 500
PREDICTOR_BATCH = 32
PARSER_STEPS = 1500
PARSER_BATCH = 16


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
