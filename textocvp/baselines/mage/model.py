"""MAGE in one module, its checkpoint, and the form in which users meet it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from textocvp.baselines.mage.axial import AxialConfig, AxialTransformer
from textocvp.baselines.mage.text import TEXT_ENCODERS, PublishedTextConfig
from textocvp.baselines.mage.vqvae import VQVAE, VQVAEConfig, read_checkpoint
from textocvp.checkpoint import TEXT_FOLDER, Checkpoint, write_checkpoint
from textocvp.config import build
from textocvp.inputs import checked_frames, checked_horizon, checked_pairs, checked_texts, observed_images
from textocvp.text import TextConfig

ARCHITECTURE: Literal["mage"] = "mage"
AT_ONCE = 64  # frames to decode: more take more memory, and on a CPU more time each


@dataclass(frozen=True)
class MageConfig:
    """A whole MAGE."""

    KINDS: ClassVar[Mapping[str, Mapping[str, type]]] = {"text": TEXT_ENCODERS}  # what a part's `kind` names

    name: str  # of the preset it came from
    vqvae: VQVAEConfig = field(default_factory=VQVAEConfig)
    text: TextConfig = field(default_factory=PublishedTextConfig)
    axial: AxialConfig = field(default_factory=AxialConfig)
    architecture: Literal["mage"] = ARCHITECTURE  # tells its checkpoints from others


class Mage(nn.Module):
    """Frames to codes, codes and text to the next codes, codes to frames ("Make It Move", CVPR 2022, figure 2).

    Args:
        text_files: the text encoder's own folder, of a checkpoint that is being loaded.

    Raises:
        ValueError: if parts do not fit each other, or pretrained weights are missing.
    """

    def __init__(self, config: MageConfig, text_files: Path | None = None) -> None:
        super().__init__()
        self._config, vqvae = config, config.vqvae
        self.vqvae = VQVAE(vqvae)
        self.text = TEXT_ENCODERS[config.text.kind](config.text, text_files)
        self.axial = AxialTransformer(config.axial, vqvae.grid, vqvae.codebook_size, config.text.dim)

    @property
    def config(self) -> MageConfig:
        """Every choice of architecture, with the fingerprints of frozen encoders' weights once they are known."""
        return replace(self._config, vqvae=self.vqvae.config, text=self.text.config)

    @property
    def device(self) -> torch.device:
        """Where the model's parameters are."""
        return self.axial.time_TC.device

    @torch.no_grad()
    def imagine(self, first_B3HW: Tensor, texts: list[str], horizon: int) -> Tensor:
        """Frames (B, horizon + 1, 3, H, W), about -1..1, from frames in -1..1 with a sentence each.

        The first ones are those given, as the VQ-VAE redraws them.

        Raises:
            ValueError: if the horizon is longer than the model was made for, or a text is not allowed.
        """
        seen_B1hw = self.vqvae.encode(first_B3HW)[:, None]
        imagined_BShw = self.axial.imagine(seen_B1hw, self.text(texts), horizon)
        codes_BThw = torch.cat([seen_B1hw, imagined_BShw], dim=1)
        drawn = [self.vqvae.decode(part) for part in codes_BThw.flatten(0, 1).split(AT_ONCE)]
        return torch.cat(drawn).unflatten(0, codes_BThw.shape[:2])

    def save(self, folder: Path) -> None:
        """Write a checkpoint."""
        write_checkpoint(folder, self, asdict(self.config))
        self.text.save_files(folder / TEXT_FOLDER)

    @classmethod
    def load(cls, folder: Path, device: str | torch.device = "cpu") -> Mage:
        """The model of a checkpoint, in evaluation mode. Raises as `read_checkpoint`."""
        files = folder / TEXT_FOLDER
        model = read_checkpoint(folder, ARCHITECTURE, lambda data: cls(build(MageConfig, data), files))
        return model.to(device)


class MageVideoModel:
    """A `textocvp.protocols.VideoModel` without slots: it imagines frames and nothing else."""

    def __init__(self, model: Mage, checkpoint: Checkpoint | None = None) -> None:
        self.model = model.eval()
        self.checkpoint = checkpoint or Checkpoint(model.config.name)

    @classmethod
    def from_folder(cls, folder: Path, name: str, device: str | torch.device = "cpu") -> MageVideoModel:
        """Load a checkpoint and call it `name`. Raises as `read_checkpoint`."""
        return cls(Mage.load(folder, device), Checkpoint.of(folder, name))

    def __repr__(self) -> str:
        million, (H, W) = sum(p.numel() for p in self.model.parameters()) / 1e6, self.image_size
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
        """As `textocvp.protocols.VideoModel.imagine`. Nothing is drawn at random: `seed` changes nothing."""
        texts = checked_texts(text, self.model.text)
        checked_horizon(horizon, self.longest_horizon)
        frames_B3HW = checked_frames(observed_images(obs), self.image_size, self.model.device)
        B = checked_pairs(len(frames_B3HW), len(texts))
        texts = texts * B if len(texts) == 1 else texts
        frames_BT3HW = self.model.imagine(frames_B3HW.expand(B, -1, -1, -1), texts, horizon)
        return ((frames_BT3HW + 1) / 2).clamp(0, 1)
