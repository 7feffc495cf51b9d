"""Every model that this package knows: what it is, how large it is, and where its weights come from.

Nothing is counted by hand: sizes are those of the model that a preset builds (on PyTorch's meta device, without memory
or weights), and what was trained here is what lies in the package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from textocvp.baselines.mage import MAGE_PRESETS, Mage, MageConfig
from textocvp.baselines.mage.model import ARCHITECTURE as MAGE
from textocvp.checkpoint import (
    DEFAULT_CHECKPOINT,
    bundled_checkpoints,
    read_config,
    read_json,
    resolve_checkpoint,
)
from textocvp.config import ModelConfig
from textocvp.model import TextOCVP
from textocvp.parsers.dino import DINO_HUB_ID
from textocvp.presets import PRESETS
from textocvp.text.pretrained import MINILM_PACKAGE, T5_HUB_ID

State = Literal["trained here", "not trained here", "needs weights", "figures only"]

WHAT = {
    "tabletop-small": "TextOCVP as it ships: placed slots, causal predictor, colour lexicon",
    "tabletop-small-40": "tabletop-small, fine-tuned to imagine 40 frames",
    "savi-small": "TextOCVP with published slots, small, for ablations of the parser",
    "savi-cater": "TextOCVP-SAVi at the paper's sizes (CATER)",
    "cliport-dino": "TextOCVP-DINO at the paper's sizes (CLIPort)",
    "ocvp-seq-small": "OCVP-Seq, no text, on the slots of tabletop-small",
    "ocvp-seq": "OCVP-Seq, no text, at its published size",
    "non-oc-small": "Non-OC, one slot for the whole scene, small",
    "non-oc": "Non-OC at the paper's sizes",
    "mage-small": "MAGE, no slots, small",
    "mage": "MAGE at its published sizes",
    "mage-dino": "MAGE-DINO at the paper's sizes (CLIPort)",
}


@dataclass(frozen=True)
class Entry:
    """A model.

    Attributes:
        name: of its preset or its bundled checkpoint.
        what: what it is, in a few words.
        parameters: those that training learns, a frozen encoder's left out. None for a model that cannot be built here.
        predictor: those of them that predict: of MAGE its second stage (text and axial transformer), as the paper
            counts.
        state: `trained here`: a checkpoint is in the package. `not trained here`: it can be, with nothing but data.
            `needs weights`: it can be, once the pretrained weights of a frozen encoder are there. `figures only`: no
            code.
        weights: where its weights come from.
    """

    name: str
    what: str
    parameters: int | None
    predictor: int | None
    state: State
    weights: str


# The one model of the paper's comparison that is not in this package; docs/models.md says why.
SEER = Entry(
    name="seer",
    what="SEER, a latent diffusion model of 406 M parameters (as published)",
    parameters=None,
    predictor=None,
    state="figures only",
    weights="its authors' checkpoint, which nothing here reads: see docs/models.md",
)


def catalogue() -> list[Entry]:
    """Every preset, every bundled checkpoint that is none, and what is only quoted."""
    presets: dict[str, ModelConfig | MageConfig] = {**PRESETS, **MAGE_PRESETS}
    bundled = bundled_checkpoints()
    others = {name: _bundled_config(name) for name in bundled if name not in presets}
    entries = [_entry(name, config, name in bundled) for name, config in {**presets, **others}.items()]
    return [*entries, SEER]


def learnable(*modules: nn.Module) -> int:
    """How many numbers training may change."""
    return sum(p.numel() for module in modules for p in module.parameters() if p.requires_grad)


def _entry(name: str, config: ModelConfig | MageConfig, bundled: bool) -> Entry:
    with torch.device("meta"):
        if isinstance(config, MageConfig):
            mage = Mage(config)
            whole, predictor = learnable(mage), learnable(mage.text, mage.axial)
        else:
            model = TextOCVP(config)
            whole, predictor = learnable(model), learnable(model.predictor)
            if not model.predictor.hears_text:
                whole -= learnable(model.text)
    needed = _frozen_encoders(config)
    state: State = "trained here" if bundled else "needs weights" if needed else "not trained here"
    weights = "in this package" if bundled else _commands(name, config)
    if needed:
        weights = f"{', '.join(needed)}; {weights}"
    return Entry(name, WHAT.get(name, ""), whole, predictor, state, weights)


def _frozen_encoders(config: ModelConfig | MageConfig) -> list[str]:
    """Where the pretrained weights that it cannot do without come from."""
    needed = []
    looks = config.parser if isinstance(config, ModelConfig) else config.vqvae
    if looks.encoder == "dinov2":
        needed.append(looks.encoder_weights or DINO_HUB_ID)
    if config.text.kind == "t5":
        needed.append(config.text.weights or T5_HUB_ID)
    if config.text.kind == "minilm":
        needed.append(config.text.weights or MINILM_PACKAGE)
    return needed


def _commands(name: str, config: ModelConfig | MageConfig) -> str:
    """What trains it."""
    if isinstance(config, MageConfig):
        return f"textocvp train vqvae --preset {name}, then train mage"
    shipped = PRESETS[DEFAULT_CHECKPOINT]
    if name != shipped.name and (config.parser, config.renderer) == (shipped.parser, shipped.renderer):
        return f"textocvp train predictor --preset {name} on the parser of {shipped.name}"
    return f"textocvp train parser --preset {name}, then train predictor"


def _bundled_config(name: str) -> ModelConfig | MageConfig:
    with resolve_checkpoint(name) as folder:
        data = read_json(folder)
        return MageConfig.from_dict(data) if data.get("architecture") == MAGE else read_config(folder)
