"""A DINOv2 with random weights, a few kilobytes large: what the code must do whatever the weights are."""

from __future__ import annotations

from pathlib import Path

import torch
from transformers import Dinov2Config, Dinov2Model

DIM, PATCH = 16, 4


def write_tiny_dino(folder: Path, seed: int = 0) -> Path:
    """Write `config.json` and `model.safetensors` as the Hugging Face hub has them."""
    torch.manual_seed(seed)
    # Trained on other sizes than it is used for, and with dropout, as a careless copy of a configuration might have.
    config = Dinov2Config(
        hidden_size=DIM,
        num_hidden_layers=2,
        num_attention_heads=2,
        patch_size=PATCH,
        image_size=16,
        hidden_dropout_prob=0.2,
        initializer_range=0.2,
    )
    Dinov2Model(config).save_pretrained(folder)
    return folder
