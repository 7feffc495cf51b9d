"""The frozen image encoder of the published CLIPort models: DINOv2 (Oquab et al. 2023), through transformers.

A checkpoint says where its weights were found (`parser.encoder_weights`, of MAGE-DINO `vqvae.encoder_weights`) and
which they are (`encoder_fingerprint`). They are read when the first frame is encoded: a model can be built, counted and
trained on cached features, slots or codes without them.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from textocvp.pretrained import PretrainedFiles, WeightsError, read_model

DINO_HUB_ID = "facebook/dinov2-base"  # ViT-B/14, 768 wide

# What DINOv2 was trained with: RGB in 0..1 minus the mean, divided by the deviation (ImageNet's).
IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)


def normalized(frames_N3HW: Tensor) -> Tensor:
    """Frames in -1..1 as DINOv2 wants them."""
    mean, std = (frames_N3HW.new_tensor(values)[:, None, None] for values in (IMAGE_MEAN, IMAGE_STD))
    return ((frames_N3HW + 1) / 2 - mean) / std


def cells_along(side: int, patch: int, part: str = "parser") -> int:
    """Patches along a side of a frame; `part` of the configuration names the field in the message.

    Raises:
        ValueError: if patches do not divide it.
    """
    if side % patch:
        raise ValueError(f"{part}.image_size: patches of {patch} pixels do not divide {side} pixels evenly")
    return side // patch


class DinoEncoder(nn.Module):
    """Frames to the features of their patches, without gradient and always in evaluation mode.

    Args:
        weights: a folder with `config.json` and `model.safetensors`, or a hub id; empty for facebook/dinov2-base.
        dim: width of its features.
        patch: side of its patches in pixels.
        fingerprint: of the weights that it must be; empty for any, until they are read.
        part: of the configuration, for messages that name a field.
    """

    def __init__(
        self,
        weights: str | Path = "",
        *,
        dim: int = 768,
        patch: int = 14,
        fingerprint: str = "",
        part: str = "parser",
    ) -> None:
        super().__init__()
        self.weights, self.dim, self.patch = str(weights), dim, patch
        self.fingerprint, self.part = fingerprint, part
        # In a list it is no submodule: in no checkpoint and no optimiser, and `train()` cannot switch its dropout on.
        self._backbone: list[nn.Module] = []

    def cells(self, image_size: int) -> int:
        """Patches along a side of a square frame, see `cells_along`."""
        return cells_along(image_size, self.patch, self.part)

    def load(self) -> DinoEncoder:
        """Read the weights, if that has not been done; returns itself.

        Raises:
            WeightsError: if they are missing or damaged, of another size, or not those of `fingerprint`.
        """
        if not self._backbone:
            from transformers import Dinov2Config, Dinov2Model  # takes seconds, and only this needs them

            settings = (f"{self.part}.encoder_weights", f"{self.part}.encoder_fingerprint")
            files = PretrainedFiles("the image encoder", *settings, DINO_HUB_ID)
            folder = files.folder(self.weights)
            found = files.fingerprint(folder, self.fingerprint)
            architecture = files.architecture(folder, Dinov2Config)
            for field, wanted, has in (
                ("encoder_dim", self.dim, architecture.hidden_size),
                ("encoder_patch", self.patch, architecture.patch_size),
            ):
                if wanted != has:
                    where = f"that of the weights in {folder}"
                    raise WeightsError(f"{self.part}.{field} is {wanted}, {where} is {has}")
            self._backbone.append(read_model(Dinov2Model, folder).eval().requires_grad_(False))
            self.fingerprint = found
        return self

    @torch.no_grad()
    def forward(self, frames_N3HW: Tensor) -> Tensor:
        """Features (N, L, dim) of the L patches, row by row, of frames in -1..1.

        Frames of other sizes than DINOv2's own 518x518 get its position codes interpolated, as published.

        Raises:
            WeightsError: as `load`.
            ValueError: if patches do not divide the frames.
        """
        for side in frames_N3HW.shape[-2:]:
            self.cells(side)
        backbone = self.load()._backbone[0].to(frames_N3HW.device)
        states = backbone(pixel_values=normalized(frames_N3HW)).last_hidden_state
        return states[:, 1:]  # without the class token
