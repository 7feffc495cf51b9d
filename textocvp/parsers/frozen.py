"""Frozen pretrained image encoders: what a parser sees through, and never learns.

A checkpoint says where the weights were found (`parser.encoder_weights`, of MAGE-DINO `vqvae.encoder_weights`) and
which they are (`encoder_fingerprint`). They are read when the first frame is encoded: a model can be built, counted and
trained on cached features, slots or codes without them.
"""

from abc import abstractmethod
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from textocvp.pretrained import WeightsError

AT_ONCE = 64  # frames; all of 16 episodes at 336x336 would take tens of gigabytes
E = TypeVar("E", bound="FrozenEncoder")


def cells_along(side: int, patch: int, part: str = "parser") -> int:
    """Patches along a side of a frame; `part` of the configuration names the field in the message.

    Raises:
        ValueError: if patches do not divide it.
    """
    if side % patch:
        raise ValueError(f"{part}.image_size: patches of {patch} pixels do not divide {side} pixels evenly")
    return side // patch


class FrozenEncoder(nn.Module):
    """Frames to the features of their patches, without gradient and always in evaluation mode.

    Args:
        weights: where they are; a subclass says what it may be, and what stands in where it is empty.
        dim: width of its features.
        patch: side of its patches in pixels.
        fingerprint: of the weights that it must be; empty for any, until they are read.
        part: of the configuration, for messages that name a field.
    """

    def __init__(
        self, weights: str | Path = "", *, dim: int, patch: int, fingerprint: str = "", part: str = "parser"
    ) -> None:
        super().__init__()
        self.weights, self.dim, self.patch = str(weights), dim, patch
        self.fingerprint, self.part = fingerprint, part
        # In a list it is no submodule: in no checkpoint and no optimiser, and `train()` cannot switch its dropout on.
        self._backbone: list[nn.Module] = []

    def cells(self, image_size: int) -> int:
        """Patches along a side of a square frame, see `cells_along`."""
        return cells_along(image_size, self.patch, self.part)

    @property
    def identity(self) -> str:
        """What a cache of its features must have been made with; known once the weights are read."""
        return self.fingerprint

    def load(self: E) -> E:
        """Read the weights, if that has not been done; returns itself.

        Raises:
            WeightsError: if they are missing or damaged, of another size, or not those of `fingerprint`.
        """
        if not self._backbone:
            backbone, self.fingerprint = self._read()
            self._backbone.append(backbone.eval().requires_grad_(False))
        return self

    @torch.no_grad()
    def forward(self, frames_N3HW: Tensor) -> Tensor:
        """Features (N, L, dim) of the L patches, row by row, of frames in -1..1.

        Raises:
            WeightsError: as `load`.
            ValueError: if patches do not divide the frames.
        """
        for side in frames_N3HW.shape[-2:]:
            self.cells(side)
        backbone = self.load()._backbone[0].to(frames_N3HW.device)
        return torch.cat([self._encode(backbone, some_n3HW) for some_n3HW in frames_N3HW.split(AT_ONCE)])

    @abstractmethod
    def _read(self) -> tuple[nn.Module, str]:
        """The network, and the fingerprint of its weights; errors as `load`."""
        raise NotImplementedError

    @abstractmethod
    def _encode(self, backbone: nn.Module, frames_N3HW: Tensor) -> Tensor:
        """As `forward`."""
        raise NotImplementedError

    def _check_sizes(self, dim: int, patch: int, where: str) -> None:
        """Raise a WeightsError where the weights in `where` are of another size than the configuration says."""
        for field, wanted, has in (("encoder_dim", self.dim, dim), ("encoder_patch", self.patch, patch)):
            if wanted != has:
                raise WeightsError(f"{self.part}.{field} is {wanted}, that of the weights in {where} is {has}")
