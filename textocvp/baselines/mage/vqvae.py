"""The VQ-VAE of MAGE: frames to a square of codes from a learned codebook, and codes to frames.

"Neural Discrete Representation Learning" (van den Oord et al. 2017); sizes from "Make It Move" (CVPR 2022).

Shape suffixes: N frames, H and W pixels, h and w codes along a side, C width of a code, K codes in the codebook.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from math import exp
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.checkpoint import CheckpointError, load_checkpoint, read_json, write_checkpoint
from textocvp.config import build
from textocvp.layers import full_precision
from textocvp.parsers.dino import DINO_HUB_ID, DinoEncoder
from textocvp.renderers.image_decoders import build_image_decoder

VQVAE_ARCHITECTURE = "mage-vqvae"
M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class VQVAEConfig:
    """From a frame to a square of codes and back."""

    image_size: int = 64  # side of the square frame in pixels
    # `conv` is MAGE. `dinov2` is MAGE-DINO: its frozen features become codes, the decoder of TextOCVP-DINO draws them.
    encoder: Literal["conv", "dinov2"] = "conv"
    ratio: int = 4  # pixels along the side of a code's square; a power of two (`conv` only)
    channels: int = 256  # width of the convolutions; with `dinov2` of the decoder's first, a multiple of 32
    blocks: int = 2  # residual blocks of the encoder, and of the decoder (`conv` only)
    codebook_size: int = 512
    code_dim: int = 256
    encoder_weights: str = ""  # folder or hub id of the frozen encoder; empty for facebook/dinov2-base from the hub
    encoder_dim: int = 768  # width of its features
    encoder_patch: int = 14  # side of its patches in pixels
    encoder_fingerprint: str = ""  # of its weights, set when they are first used; others are then an error

    @property
    def grid(self) -> int:
        """Codes along a side of a frame."""
        return self.image_size // (self.ratio if self.encoder == "conv" else self.encoder_patch)


@dataclass
class Quantized:
    """The codes nearest to features."""

    codes_Nhw: Tensor  # their numbers
    vectors_NhwC: Tensor  # themselves; their gradient goes straight through to the features, not to the codebook
    codebook_loss: Tensor  # mean squared distance of codes and features; moves the codes only (VQ term)
    commitment_loss: Tensor  # the same number; moves the features only


class Codebook(nn.Module):
    """K codes of C numbers."""

    def __init__(self, size: int, dim: int) -> None:
        super().__init__()
        self.codes_KC = nn.Parameter(torch.empty(size, dim).uniform_(-1 / size, 1 / size))

    @torch.no_grad()
    def distances(self, features_XC: Tensor) -> Tensor:
        """Squared distances (X, K) of features (X, C) to the codes."""
        # In full precision even where the rest is not: codes lie close to each other.
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
        """Put the unused codes onto features (X, C) of training frames, drawn on the CPU. Returns how many these are.

        Features far from every code that is in use are the likelier to be drawn, as in k-means++.
        """
        # Nothing is near an unused code, so it would never get a gradient.
        count = int(unused_K.sum())
        if count == 0:
            return 0
        distances_XK = self.distances(features_XC)
        near_XK = distances_XK if count == len(unused_K) else distances_XK[:, ~unused_K]
        likelihood_X = near_XK.amin(dim=1).clamp_min(1e-12).cpu()
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
        """(N, C, h, w). `features_NLF` are DINOv2's, where they are known already."""
        if features_NLF is None:
            features_NLF = self.dino(frames_N3HW)
        return self.project(features_NLF).transpose(1, 2).unflatten(2, (self.cells, self.cells))


def _convolutions(config: VQVAEConfig) -> tuple[nn.Module, nn.Module]:
    """Encoder and decoder as published: strided convolutions, then residual blocks, and back."""
    halvings = config.ratio.bit_length() - 1
    if halvings < 1 or 2**halvings != config.ratio or config.image_size % config.ratio:
        raise ValueError(
            "vqvae.ratio must be a power of two of at least 2 that divides vqvae.image_size "
            f"{config.image_size}, not {config.ratio}"
        )
    C = config.channels
    down: list[nn.Module] = []
    up: list[nn.Module] = []
    for i in range(halvings):
        down += [nn.Conv2d(3 if i == 0 else C, C, 4, stride=2, padding=1), nn.ReLU()]
        up += [nn.ReLU(), nn.ConvTranspose2d(C, 3 if i == halvings - 1 else C, 4, stride=2, padding=1)]

    def residual() -> list[nn.Module]:
        return [_Residual(C) for _ in range(config.blocks)]

    encoder = nn.Sequential(*down[:-1], *residual(), nn.Conv2d(C, config.code_dim, 1))
    return encoder, nn.Sequential(nn.Conv2d(config.code_dim, C, 3, padding=1), *residual(), *up)


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
            sizes = (config.channels, self.encoder.cells, config.image_size)
            self.decoder = build_image_decoder("cnn", config.code_dim, *sizes)
        self.codebook = Codebook(config.codebook_size, config.code_dim)

    @property
    def config(self) -> VQVAEConfig:
        """What it was built from, with the fingerprint of the frozen encoder's weights once they are known."""
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
        """The encoder's features (N, h, w, C) of frames in -1..1, or of the frozen encoder's features.

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
    counts_K = counts_K.cpu()  # float64 is not on every device
    share_K = counts_K[counts_K > 0].double() / counts_K.sum()
    return exp(-float((share_K * share_K.log()).sum()))


def save_vqvae(model: VQVAE, folder: Path) -> None:
    """Write a checkpoint of a VQ-VAE alone, on which the transformer is then trained."""
    write_checkpoint(folder, model, {"architecture": VQVAE_ARCHITECTURE, "vqvae": asdict(model.config)})


def load_vqvae(folder: Path) -> VQVAE:
    """The VQ-VAE of a checkpoint, in evaluation mode. Raises as `read_checkpoint`."""

    def build_model(data: dict[str, Any]) -> VQVAE:
        return VQVAE(build(VQVAEConfig, data.get("vqvae", {}), "vqvae"))

    return read_checkpoint(folder, VQVAE_ARCHITECTURE, build_model)


def read_checkpoint(folder: Path, architecture: str, build_model: Callable[[dict[str, Any]], M]) -> M:
    """The model that `build_model` makes of a checkpoint's `config.json`, with its weights, in evaluation mode.

    Raises:
        CheckpointError: if a file is missing or damaged, it is of another architecture, or a config field or tensor
            does not fit; it is named.
    """
    data = read_json(folder)
    found = data.get("architecture", "textocvp")
    if found != architecture:
        raise CheckpointError(f"{folder} holds a {found!r} model, and this needs one of {architecture!r}")
    return load_checkpoint(folder, lambda: build_model(data))
