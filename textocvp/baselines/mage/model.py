"""MAGE in one module, and its checkpoint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from textocvp.baselines.mage.axial import AxialTransformer
from textocvp.baselines.mage.checkpoint import write
from textocvp.baselines.mage.config import ARCHITECTURE, MageConfig
from textocvp.baselines.mage.text import build_text
from textocvp.baselines.mage.vqvae import VQVAE
from textocvp.checkpoint import CONFIG_FILE, WEIGHTS_FILE, CheckpointError, load_weights, read_json
from textocvp.model import TEXT_FOLDER

AT_ONCE = 64  # frames to decode: more take more memory, and on a CPU more time each


class Mage(nn.Module):
    """Frames to codes, codes and text to the codes to come, codes to frames ("Make It Move", CVPR 2022, figure 2).

    Attributes:
        vqvae: frames to codes and back.
        text: sentences to tokens.
        axial: codes and tokens to scores of the next codes.

    Args:
        text_files: the text encoder's own folder, of a checkpoint that is being loaded.

    Raises:
        ValueError: if parts do not fit each other, or pretrained weights are missing.
    """

    def __init__(self, config: MageConfig, text_files: Path | None = None) -> None:
        super().__init__()
        self.vqvae = VQVAE(config.vqvae)
        self.text = build_text(config.text, text_files)
        self._config = config
        self.axial = AxialTransformer(
            config.axial,
            config.vqvae.grid,
            config.vqvae.codebook_size,
            config.text.dim,
        )

    @property
    def config(self) -> MageConfig:
        """Every choice of architecture; once they are known, with the fingerprints of frozen encoders' weights."""
        return replace(self._config, vqvae=self.vqvae.config, text=self.text.config)

    @property
    def device(self) -> torch.device:
        """Where the model's parameters are."""
        return self.axial.time_TC.device

    @torch.no_grad()
    def take_vqvae(self, trained: VQVAE) -> None:
        """Take over a trained VQ-VAE of the same configuration, frozen from now on."""
        self.vqvae.load_state_dict(trained.state_dict())
        self.vqvae.requires_grad_(False).eval()

    @torch.no_grad()
    def imagine(
        self, first_B3HW: Tensor, texts: list[str], horizon: int, *, use_cache: bool = True
    ) -> Tensor:
        """Frames (B, horizon + 1, 3, H, W), about -1..1; the first is the given one as the VQ-VAE redraws it.

        Args:
            first_B3HW: frames in -1..1.
            texts: one sentence a frame.
            horizon: how many frames to imagine.
            use_cache: see `AxialTransformer.imagine`.

        Raises:
            ValueError: if the horizon is longer than the model was made for, or a text is not allowed.
        """
        seen_B1hw = self.vqvae.encode(first_B3HW)[:, None]
        imagined_BShw = self.axial.imagine(seen_B1hw, self.text(texts), horizon, use_cache=use_cache)
        codes_BThw = torch.cat([seen_B1hw, imagined_BShw], dim=1)
        drawn = [self.vqvae.decode(part) for part in codes_BThw.flatten(0, 1).split(AT_ONCE)]
        return torch.cat(drawn).unflatten(0, codes_BThw.shape[:2])

    def save(self, folder: Path) -> None:
        """Write a checkpoint."""
        write(self, self.config.to_dict(), folder)
        self.text.save_files(folder / TEXT_FOLDER)

    @classmethod
    def load(cls, folder: Path, device: str | torch.device = "cpu") -> Mage:
        """The model of a checkpoint, in evaluation mode.

        Raises:
            CheckpointError: if a file is missing or damaged, it is of another architecture, or a config field or tensor
                does not fit; it is named.
        """
        data = read_json(folder)
        found = data.get("architecture", "textocvp")
        if found != ARCHITECTURE:
            raise CheckpointError(f"{folder} holds a {found!r} model, and this needs one of {ARCHITECTURE!r}")
        try:
            model = cls(MageConfig.from_dict(data), folder / TEXT_FOLDER)
        except (ValueError, TypeError) as error:
            raise CheckpointError(f"{folder / CONFIG_FILE}: {error}") from error
        load_weights(model, folder / WEIGHTS_FILE)
        return model.to(device).eval()
