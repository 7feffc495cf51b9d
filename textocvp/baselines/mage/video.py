"""MAGE as users meet it: load a checkpoint, give it an observation and a sentence, get frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from textocvp.baselines.mage.model import Mage
from textocvp.checkpoint import Checkpoint
from textocvp.inputs import checked_frames, checked_horizon, checked_pairs, checked_texts, observed_images


class MageVideoModel:
    """A `textocvp.protocols.VideoModel` without slots: it imagines frames and nothing else.

    Attributes:
        model: the network.
        checkpoint: where it came from.
    """

    def __init__(self, model: Mage, checkpoint: Checkpoint | None = None) -> None:
        self.model = model.eval()
        self.checkpoint = checkpoint or Checkpoint(model.config.name)

    @classmethod
    def from_folder(cls, folder: Path, name: str, device: str | torch.device = "cpu") -> MageVideoModel:
        """Load a checkpoint.

        Args:
            name: what to call it.

        Raises:
            CheckpointError: see `Mage.load`.
        """
        return cls(Mage.load(folder, device), Checkpoint.of(folder, name))

    def __repr__(self) -> str:
        million = sum(p.numel() for p in self.model.parameters()) / 1e6
        H, W = self.image_size
        return (
            f"MageVideoModel({self.checkpoint.name!r}, {million:.1f} M parameters, {H}x{W} frames, "
            f"up to {self.longest_horizon} frames ahead, on {self.model.device})"
        )

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) of the only frames that it understands, in pixels."""
        side = self.model.config.vqvae.image_size
        return side, side

    @property
    def longest_horizon(self) -> int:
        """How many frames it can imagine at once: it has no code for later times."""
        return self.model.config.axial.frames - 1

    @torch.no_grad()
    def imagine(
        self, obs: Mapping[str, Any] | np.ndarray, text: str | Sequence[str], *, horizon: int, seed: int = 0
    ) -> Tensor:
        """Frames (B, horizon + 1, 3, H, W), RGB 0..1, float32, as `textocvp.protocols.VideoModel.imagine`.

        Args:
            seed: changes nothing: this model draws nothing at random.

        Raises:
            TypeError: if the observation is not uint8, or a text no string.
            ValueError: if a shape, value or size, the horizon, or a text is not allowed; the message says what is.

        A word that the text encoder has never met is a `UserWarning` that names the word.
        """
        texts = checked_texts(text, self.model.text)
        checked_horizon(horizon, self.longest_horizon)
        frames_B3HW = checked_frames(observed_images(obs), self.image_size, self.model.device)
        B = checked_pairs(len(frames_B3HW), len(texts))
        texts = texts * B if len(texts) == 1 else texts
        frames_BT3HW = self.model.imagine(frames_B3HW.expand(B, -1, -1, -1), texts, horizon)
        return ((frames_BT3HW + 1) / 2).clamp(0, 1)
