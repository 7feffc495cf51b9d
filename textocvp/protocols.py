"""What others may ask of a model, with slots or without, and how they get one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from textocvp.baselines import BASELINES
from textocvp.checkpoint import DEFAULT_CHECKPOINT, Checkpoint, read_json, resolve_checkpoint
from textocvp.world_model import WorldModel


class VideoModel(Protocol):
    """A video prediction model. Whatever has these methods is one, a test double too."""

    @property
    def checkpoint(self) -> Checkpoint:
        """Where it came from."""

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels of the frames that it was trained on; it takes no others."""

    @property
    def longest_horizon(self) -> int | None:
        """How many frames it can imagine at once; None for any number."""

    def imagine(
        self, obs: Mapping[str, Any] | np.ndarray, text: str | Sequence[str], *, horizon: int, seed: int = 0
    ) -> Tensor:
        """Frames (B, horizon + 1, 3, H, W), RGB 0..1, float32. Frame 0 is the observed one, redrawn by the model.

        Args:
            obs: the environment's observation (a mapping with `rgb`), an image (H, W, 3) or images (B, H, W, 3), uint8.
            text: what is to be done; one sentence, or one for each image.
            horizon: how many frames to imagine.
            seed: of whatever the model draws at random.

        Raises:
            TypeError, ValueError: as `WorldModel.rollout`.
        """


def load_model(
    name_or_folder_or_hub_id: str | Path = DEFAULT_CHECKPOINT, device: str | torch.device = "cpu"
) -> VideoModel:
    """The model of a checkpoint of any architecture; arguments and errors as `WorldModel.from_pretrained`."""
    name = str(name_or_folder_or_hub_id)
    with resolve_checkpoint(name) as folder:
        architecture = read_json(folder).get("architecture")
        if architecture in BASELINES:
            return BASELINES[architecture].from_folder(folder, name, device)
    return WorldModel.from_pretrained(name, device)
