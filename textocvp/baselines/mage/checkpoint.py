"""MAGE on disk: a folder with `config.json` and `model.safetensors`, loaded strictly, never unpickled.

There are two kinds. `mage-vqvae` holds a trained VQ-VAE, on which the transformer is trained; `mage` a whole model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import nn

from textocvp.baselines.mage.config import VQVAEConfig
from textocvp.baselines.mage.vqvae import VQVAE
from textocvp.checkpoint import CONFIG_FILE, WEIGHTS_FILE, CheckpointError, load_weights, read_json
from textocvp.config import build

VQVAE_ARCHITECTURE = "mage-vqvae"


def save_vqvae(model: VQVAE, folder: Path) -> None:
    """Write a VQ-VAE's checkpoint."""
    write(model, {"architecture": VQVAE_ARCHITECTURE, "vqvae": asdict(model.config)}, folder)


def load_vqvae(folder: Path) -> VQVAE:
    """The VQ-VAE of a checkpoint, in evaluation mode.

    Raises:
        CheckpointError: if a file is missing or damaged, it is of another architecture, or a config field or tensor
            does not fit; it is named.
    """
    data = read_json(folder)
    found = data.pop("architecture", "textocvp")
    if found != VQVAE_ARCHITECTURE:
        raise CheckpointError(
            f"{folder} holds a {found!r} model, and this needs one of {VQVAE_ARCHITECTURE!r}"
        )
    try:
        model = VQVAE(build(VQVAEConfig, data.get("vqvae", {}), "vqvae"))
    except ValueError as error:
        raise CheckpointError(f"{folder / CONFIG_FILE}: {error}") from error
    load_weights(model, folder / WEIGHTS_FILE)
    return model.eval()


def write(model: nn.Module, config: Mapping[str, Any], folder: Path) -> None:
    """Write the two files of a checkpoint."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {
        name: tensor.detach().cpu().contiguous().clone() for name, tensor in model.state_dict().items()
    }
    save_file(tensors, folder / WEIGHTS_FILE, metadata={"format": "pt"})
    (folder / CONFIG_FILE).write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
