"""The VQ-VAE of MAGE: frames to a square of codes from a learned codebook, and codes to frames.

"Neural Discrete Representation Learning" (van den Oord et al. 2017); sizes from "Make It Move" (CVPR 2022).

Shape suffixes: N frames, H and W pixels, h and w codes along a side, C width of a code, K codes in the codebook.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from math import exp, log2
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.checkpoint import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    CheckpointError,
    load_weights,
    read_json,
    write_checkpoint,
)
from textocvp.config import build
from textocvp.layers import full_precision
from textocvp.parsers.dino import DINO_HUB_ID, DinoEncoder
from textocvp.renderers.image_decoders import build_image_decoder

VQVAE_ARCHITECTURE = "mage-vqvae"
M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class VQVAEConfig:
    """From a frame to a square of codes and back.

    Attributes:
        image_size: side of the square frame in pixels.
        encoder: `conv` (MAGE) or `dinov2` (MAGE-DINO: its features, frozen, become codes, and the decoder of
            TextOCVP-DINO draws them).
        ratio: pixels along the side of a code's square; a power of two (`conv` only).
        channels: width of the convolutions; with `dinov2` of the decoder's first, a multiple of 32.
        blocks: residual blocks of the encoder, and of the decoder (`conv` only).
        codebook_size: how many codes there are.
        code_dim: numbers a code.
        encoder_weights: folder or hub id of the frozen encoder; empty for facebook/dinov2-base from the hub.
        encoder_dim: width of its features.
        encoder_patch: side of its patches in pixels.
        encoder_fingerprint: of its weights, set when they are first used; other weights are then an error.
    """

    image_size: int = 64
    encoder: Literal["conv", "dinov2"] = "conv"
    ratio: int = 4
    channels: int = 256
    blocks: int = 2
    codebook_size: int = 512
    code_dim: int = 256
    encoder_weights: str = ""
    encoder_dim: int = 768
    encoder_patch: int = 14
    encoder_fingerprint: str = ""

    @property
    def grid(self) -> int:
        """Codes along a side of a frame."""
        return self.image_size // (self.ratio if self.encoder == "conv" else self.encoder_patch)


@dataclass
class Quantized:
    """Features and the nearest codes.

    Attributes:
        codes_Nhw: numbers of the nearest codes.
        vectors_NhwC: these codes. Their gradient goes straight through to the features and not to the codebook.
        codebook_loss: mean squared distance of the codes to the features; moves the codes only (VQ term).
        commitment_loss: the same number; moves the features only.
    """

    codes_Nhw: Tensor
    vectors_NhwC: Tensor
    codebook_loss: Tensor
    commitment_loss: Tensor


class Codebook(nn.Module):
    """K codes of C numbers."""

    def __init__(self, size: int, dim: int) -> None:
        super().__init__()
        self.codes_KC = nn.Parameter(torch.empty(size, dim).uniform_(-1 / size, 1 / size))

    @torch.no_grad()
    def distances(self, features_XC: Tensor) -> Tensor:
        """Squared distances (X, K) of features (X, C) to the codes."""
        # In full precision also where the rest is not: codes lie close to each other.
        with full_precision(features_XC.device):
            features_XC = features_XC.detach().float()
            cross_XK = features_XC @ self.codes_KC.T
            return features_XC.square().sum(1, keepdim=True) - 2 * cross_XK + self.codes_KC.square().sum(1)

    def nearest(self, features_NhwC: Tensor) -> Tensor:
        """The numbers (N, h, w) of the codes nearest to the features."""
        return self.distances(features_NhwC.flatten(0, 2)).argmin(dim=1).view(features_NhwC.shape[:-1])

    def lookup(self, codes: Tensor) -> Tensor:
        """Codes (...) by number to vectors (..., C)."""
        return F.embedding(codes, self.codes_KC)

    def forward(self, features_NhwC: Tensor) -> Quantized:
        features_NhwC = features_NhwC.float()
        codes_Nhw = self.nearest(features_NhwC)
        vectors_NhwC = self.lookup(codes_Nhw)
        return Quantized(
            codes_Nhw,
            features_NhwC + (vectors_NhwC - features_NhwC).detach(),
            codebook_loss=F.mse_loss(vectors_NhwC, features_NhwC.detach()),
            commitment_loss=F.mse_loss(features_NhwC, vectors_NhwC.detach()),
        )

    @torch.no_grad()
    def restart(self, unused_K: Tensor, features_XC: Tensor, generator: torch.Generator) -> int:
        """Put codes that nothing is near, and that would so never get a gradient, onto features.

        Features far from every code that is in use are the likelier to be drawn, as in k-means++.

        Args:
            unused_K: True for each code to move.
            features_XC: features (X, C) of training frames.
            generator: the source of chance, on the CPU.

        Returns:
            how many codes were moved.
        """
        count = int(unused_K.sum())
        if count == 0:
            return 0
        distances_XK = self.distances(features_XC)
        if count < len(unused_K):
            distances_XK = distances_XK[:, ~unused_K]
        likelihood_X = distances_XK.amin(dim=1).clamp_min(1e-12).cpu()
        drawn = torch.multinomial(likelihood_X, count, replacement=True, generator=generator)
        self.codes_KC[unused_K] = features_XC[drawn.to(features_XC.device)].to(self.codes_KC.dtype)
        return count


class _Residual(nn.Module):
    """Adds to its input a convolution of 3 x 3 and one of 1 x 1, each after a ReLU."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.spread = nn.Conv2d(channels, channels, 3, padding=1)
        self.mix = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.mix(F.relu(self.spread(F.relu(x))))


class DinoCodes(nn.Module):
    """The features of a frozen DINOv2, brought to the width of a code: MAGE-DINO's encoder."""

    def __init__(self, config: VQVAEConfig) -> None:
        super().__init__()
        self.dino = DinoEncoder(
            config.encoder_weights or DINO_HUB_ID,
            dim=config.encoder_dim,
            patch=config.encoder_patch,
            fingerprint=config.encoder_fingerprint,
            part="vqvae",
        )
        self.cells = self.dino.cells(config.image_size)
        self.project = nn.Linear(config.encoder_dim, config.code_dim)

    def forward(self, frames_N3HW: Tensor, features_NLF: Tensor | None = None) -> Tensor:
        """(N, C, h, w). `features_NLF` are those of the frames, where they are known already."""
        if features_NLF is None:
            features_NLF = self.dino(frames_N3HW)
        return self.project(features_NLF).transpose(1, 2).unflatten(2, (self.cells, self.cells))


def _convolutions(config: VQVAEConfig) -> tuple[nn.Module, nn.Module]:
    """Encoder and decoder as published: strided convolutions, then residual blocks, and back."""
    halvings = round(log2(config.ratio)) if config.ratio > 0 else 0
    if halvings < 1 or 2**halvings != config.ratio or config.image_size % config.ratio:
        raise ValueError(
            f"vqvae.ratio must be a power of two of at least 2 that divides vqvae.image_size "
            f"{config.image_size}, not {config.ratio}"
        )
    C = config.channels
    down: list[nn.Module] = []
    up: list[nn.Module] = []
    for i in range(halvings):
        down += [nn.Conv2d(3 if i == 0 else C, C, 4, stride=2, padding=1), nn.ReLU()]
        up += [nn.ReLU(), nn.ConvTranspose2d(C, 3 if i == halvings - 1 else C, 4, stride=2, padding=1)]
    encoder = nn.Sequential(
        *down[:-1],
        *(_Residual(C) for _ in range(config.blocks)),
        nn.Conv2d(C, config.code_dim, 1),
    )
    decoder = nn.Sequential(
        nn.Conv2d(config.code_dim, C, 3, padding=1), *(_Residual(C) for _ in range(config.blocks)), *up
    )
    return encoder, decoder


class VQVAE(nn.Module):
    """Frames to codes and back.

    Raises:
        ValueError: if `ratio` is no power of two of at least 2, or it or DINOv2's patches do not divide `image_size`.
    """

    def __init__(self, config: VQVAEConfig) -> None:
        super().__init__()
        self._config = config
        if config.encoder == "conv":
            self.encoder, self.decoder = _convolutions(config)
        else:
            self.encoder = DinoCodes(config)
            self.decoder = build_image_decoder("cnn", config.code_dim, config.channels, config.image_size)
        self.codebook = Codebook(config.codebook_size, config.code_dim)

    @property
    def config(self) -> VQVAEConfig:
        """What it was built from; once they are known, with the fingerprint of the frozen encoder's weights."""
        if self.dino is None:
            return self._config
        return replace(self._config, encoder_fingerprint=self.dino.fingerprint)

    @property
    def device(self) -> torch.device:
        """Where its parameters are."""
        return self.codebook.codes_KC.device

    @property
    def dino(self) -> DinoEncoder | None:
        """The frozen encoder of MAGE-DINO."""
        return self.encoder.dino if isinstance(self.encoder, DinoCodes) else None

    def features(self, frames_N3HW: Tensor, features_NLF: Tensor | None = None) -> Tensor:
        """The encoder's features (N, h, w, C) of frames in -1..1.

        Args:
            features_NLF: of the frozen encoder, where they are known already.

        Raises:
            WeightsError: if the weights of the frozen encoder are missing.
        """
        known = () if features_NLF is None else (features_NLF,)
        return self.encoder(frames_N3HW, *known).permute(0, 2, 3, 1)

    def encode(self, frames_N3HW: Tensor) -> Tensor:
        """Frames in -1..1 to the numbers (N, h, w) of their codes."""
        return self.codebook.nearest(self.features(frames_N3HW))

    def decode(self, codes_Nhw: Tensor) -> Tensor:
        """Numbers (N, h, w) of codes to frames (N, 3, H, W), about -1..1 (may overshoot slightly)."""
        return self.draw(self.codebook.lookup(codes_Nhw))

    def draw(self, vectors_NhwC: Tensor) -> Tensor:
        """Codes (N, h, w, C) to frames (N, 3, H, W)."""
        return self.decoder(vectors_NhwC.permute(0, 3, 1, 2)).float()

    def forward(self, frames_N3HW: Tensor, features_NLF: Tensor | None = None) -> tuple[Tensor, Quantized]:
        """The frames (N, 3, H, W) redrawn from their codes, and the codes. Arguments as `features`."""
        found = self.codebook(self.features(frames_N3HW, features_NLF))
        return self.draw(found.vectors_NhwC), found


def perplexity(counts_K: Tensor) -> float:
    """How many codes are used, effectively: the exponential of the entropy of their frequencies (K)."""
    share_K = counts_K[counts_K > 0].double() / counts_K.sum()
    return exp(-float((share_K * share_K.log()).sum()))


def save_vqvae(model: VQVAE, folder: Path) -> None:
    """Write a checkpoint of a VQ-VAE alone, on which the transformer is then trained."""
    config = {"architecture": VQVAE_ARCHITECTURE, "vqvae": asdict(model.config)}
    write_checkpoint(folder, model, config)


def load_vqvae(folder: Path) -> VQVAE:
    """The VQ-VAE of a checkpoint, in evaluation mode.

    Raises:
        CheckpointError: as `read_checkpoint`.
    """
    return read_checkpoint(
        folder,
        VQVAE_ARCHITECTURE,
        lambda data: VQVAE(build(VQVAEConfig, data.get("vqvae", {}), "vqvae")),
    )


def read_checkpoint(folder: Path, architecture: str, build_model: Callable[[dict[str, Any]], M]) -> M:
    """The model of a checkpoint, in evaluation mode.

    Args:
        architecture: what `config.json` must say.
        build_model: makes the model from what it says.

    Raises:
        CheckpointError: if a file is missing or damaged, it is of another architecture, or a config field or tensor
            does not fit; it is named.
    """
    data = read_json(folder)
    found = data.get("architecture", "textocvp")
    if found != architecture:
        raise CheckpointError(f"{folder} holds a {found!r} model, and this needs one of {architecture!r}")
    try:
        model = build_model(data)
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{folder / CONFIG_FILE}: {error}") from error
    load_weights(model, folder / WEIGHTS_FILE)
    return model.eval()
