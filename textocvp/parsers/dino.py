"""The frozen image encoder of the published CLIPort models: DINOv2 (Oquab et al. 2023), through transformers.

Its weights are never part of our checkpoints. A checkpoint says where they were found (`parser.encoder_weights`, of
MAGE-DINO `vqvae.encoder_weights`) and which they are (`encoder_fingerprint`), and other weights are an error. They are
read when the first frame is encoded, so that a model can be built, counted and trained on cached features, slots or
codes without them; and never made up.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import snapshot_download
from torch import Tensor, nn
from transformers import Dinov2Config, Dinov2Model

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
DINO_HUB_ID = "facebook/dinov2-base"  # ViT-B/14, 768 wide

# What DINOv2 was trained with: RGB in 0..1 minus the mean, divided by the deviation (ImageNet's).
IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)


class DinoWeightsError(ValueError):
    """The weights of the frozen encoder are missing, damaged, or others than a checkpoint was made with."""


def normalized(frames_N3HW: Tensor) -> Tensor:
    """Frames in -1..1 as DINOv2 wants them."""
    mean, std = (frames_N3HW.new_tensor(values)[:, None, None] for values in (IMAGE_MEAN, IMAGE_STD))
    return ((frames_N3HW + 1) / 2 - mean) / std


class DinoEncoder(nn.Module):
    """Frames to the features of their patches, without gradient and always in evaluation mode.

    The backbone is no submodule on purpose: so its weights are in no checkpoint and no optimiser, and `train()` cannot
    switch its dropout on.

    Args:
        weights: a folder with `config.json` and `model.safetensors`, or the id of a repository on the Hugging Face hub.
        dim: width of its features.
        patch: side of its patches in pixels.
        fingerprint: of the weights that it must be; empty for any.
        part: of the configuration, for messages that name a field.

    Attributes:
        fingerprint: of the weights; empty as long as none are known.
    """

    def __init__(
        self,
        weights: str | Path = DINO_HUB_ID,
        *,
        dim: int = 768,
        patch: int = 14,
        fingerprint: str = "",
        part: str = "parser",
    ) -> None:
        super().__init__()
        self.weights, self.dim, self.patch, self.fingerprint = str(weights), dim, patch, fingerprint
        self.part = part
        self._backbone: list[nn.Module] = []  # a list, so that it is not registered

    def cells(self, image_size: int) -> int:
        """Patches along a side of a square frame.

        Raises:
            ValueError: if patches do not divide it.
        """
        if image_size % self.patch:
            raise ValueError(
                f"{self.part}.image_size: patches of {self.patch} pixels do not divide {image_size} pixels evenly"
            )
        return image_size // self.patch

    def load(self) -> DinoEncoder:
        """Read the weights, if that has not been done; returns itself.

        Raises:
            DinoWeightsError: if they are missing or damaged, of another size, or not those of `fingerprint`.
        """
        if not self._backbone:
            folder = weights_folder(self.weights, self.part)
            found = fingerprint(folder)
            if self.fingerprint not in ("", found):
                raise DinoWeightsError(
                    f"{self.part}.encoder_fingerprint: this was made with other weights of the image encoder "
                    f"({self.fingerprint[:12]}) than those in {folder} ({found[:12]}); give those in "
                    f"{self.part}.encoder_weights"
                )
            backbone = read_backbone(folder)
            for field, wanted, has in (
                ("encoder_dim", self.dim, backbone.config.hidden_size),
                ("encoder_patch", self.patch, backbone.config.patch_size),
            ):
                if wanted != has:
                    raise DinoWeightsError(
                        f"{self.part}.{field} is {wanted}, that of the weights in {folder} is {has}"
                    )
            self._backbone.append(backbone.eval().requires_grad_(False))
            self.fingerprint = found
        return self

    @torch.no_grad()
    def forward(self, frames_N3HW: Tensor) -> Tensor:
        """Features (N, L, dim) of the L patches, row by row, of frames in -1..1.

        Frames of other sizes than DINOv2's own 518x518 get its position codes interpolated, as published.

        Raises:
            DinoWeightsError: as `load`.
            ValueError: if patches do not divide the frames.
        """
        for side in frames_N3HW.shape[-2:]:
            self.cells(side)
        backbone = self.load()._backbone[0].to(frames_N3HW.device)
        states = backbone(pixel_values=normalized(frames_N3HW)).last_hidden_state
        return states[:, 1:]  # without the class token


def weights_folder(weights: str, part: str = "parser") -> Path:
    """The folder of the weights of that name.

    Raises:
        DinoWeightsError: if there is none; the message says what to download.
    """
    folder = Path(weights)
    if not folder.is_dir():
        try:
            folder = Path(snapshot_download(weights, allow_patterns=[CONFIG_FILE, WEIGHTS_FILE]))
        # The hub client raises many kinds: no such repository, no network, not a valid id, no access.
        except Exception as error:
            raise DinoWeightsError(
                f"the image encoder's weights {weights!r} are no folder here, and fetching them from the Hugging Face "
                f"hub failed ({type(error).__name__}: {error}). Where there is a network: hf download {DINO_HUB_ID} "
                f"{CONFIG_FILE} {WEIGHTS_FILE} --local-dir FOLDER; then set {part}.encoder_weights=FOLDER"
            ) from error
    missing = [name for name in (CONFIG_FILE, WEIGHTS_FILE) if not (folder / name).is_file()]
    if missing:
        raise DinoWeightsError(f"the image encoder's folder {folder} lacks {' and '.join(missing)}")
    return folder


def fingerprint(folder: Path) -> str:
    """A hash of the weights in a folder."""
    with (folder / WEIGHTS_FILE).open("rb") as file:
        digest = hashlib.sha256()
        while part := file.read(1 << 22):
            digest.update(part)
    return digest.hexdigest()


def read_backbone(folder: Path) -> Dinov2Model:
    """The encoder in a folder, in float32; every tensor must be there.

    Raises:
        DinoWeightsError: if it is damaged or no DINOv2.
    """
    try:
        kind = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))["model_type"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DinoWeightsError(f"the image encoder's {folder / CONFIG_FILE} is damaged: {error}") from error
    if kind != Dinov2Config.model_type:
        raise DinoWeightsError(
            f"{folder / CONFIG_FILE} is of the type {kind!r}, not {Dinov2Config.model_type!r}"
        )
    # Through transformers, which knows under which names its older versions stored the tensors.
    try:
        found: Any = Dinov2Model.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    # It raises many kinds, one for every way in which a file can be damaged.
    except Exception as error:
        raise DinoWeightsError(
            f"the image encoder in {folder} is damaged: {type(error).__name__}: {error}"
        ) from error
    backbone, loading = found
    # It would leave them at random.
    if loading["missing_keys"]:
        raise DinoWeightsError(f"{folder / WEIGHTS_FILE} lacks the tensor {min(loading['missing_keys'])!r}")
    return backbone.float()
