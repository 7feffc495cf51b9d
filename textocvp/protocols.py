"""What others may ask of a model, and how they get one.

A `VideoModel` imagines frames, with slots or without. Whatever has its methods is one, so a study that asks for no more
also runs on a test double.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from textocvp.baselines import BASELINES
from textocvp.checkpoint import DEFAULT_CHECKPOINT, Checkpoint, read_json, resolve_checkpoint
from textocvp.world_model import WorldModel

Model = TypeVar("Model", covariant=True)


class VideoModel(Protocol):
    """A video prediction model."""

    @property
    def checkpoint(self) -> Checkpoint:
        """Where it came from."""

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels of the frames that it was trained on; a `WorldModel` also takes whole multiples of it."""

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


class LoadModel(Protocol[Model]):
    """Makes a model. Hashable, and equal for equal models, so that a process makes each only once."""

    def __call__(self) -> Model: ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class LoadCheckpoint:
    """Loads any checkpoint, see `load_model`."""

    name: str

    def __call__(self) -> VideoModel:
        return load_model(self.name)


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
