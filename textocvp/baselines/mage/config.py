"""The architecture of MAGE as dataclasses, and its named presets.

Sizes of the published model are from "Make It Move" (CVPR 2022), section 4 and the configuration published with it,
and from TextOCVP (TMLR 2026), appendix.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal

from textocvp.config import build
from textocvp.text import ENCODERS, TextConfig
from textocvp.text.words import WordsConfig

ARCHITECTURE: Literal["mage"] = "mage"
"""What `architecture` says in the `config.json` of a checkpoint."""


@dataclass(frozen=True)
class VQVAEConfig:
    """From a frame to a square of codes and back.

    Attributes:
        image_size: side of the square frame in pixels.
        encoder: `conv` (MAGE) or `dinov2` (MAGE-DINO: its features, frozen, are what becomes codes, and the decoder of
            TextOCVP-DINO draws them).
        ratio: pixels along the side of a code's square; a power of two (`conv` only).
        channels: width of the convolutions; with `dinov2` of the decoder's first, a multiple of 32.
        blocks: residual blocks of the encoder, and of the decoder (`conv` only).
        encoder_weights: folder or hub id of the frozen encoder; empty for facebook/dinov2-base from the hub.
        encoder_dim, encoder_patch: width of its features, and side of its patches in pixels.
        encoder_fingerprint: of its weights, set when they are first used; other weights are then an error.
        codebook_size: how many codes there are.
        code_dim: numbers a code.
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


@dataclass(frozen=True)
class PublishedTextConfig:
    """MAGE's own text transformer: words to tokens, with learned positions.

    Attributes:
        kind: always `published`; tells this from a `textocvp.text.TextConfig`.
        dim, layers, heads, hidden: the transformer.
        max_tokens: longest sentence in words; a longer one is an error.
        vocabulary: rows of the word embedding. More than there are words: the rest is never used, as published.
    """

    kind: Literal["published"] = "published"
    dim: int = 512
    layers: int = 2
    heads: int = 16
    hidden: int = 2048
    max_tokens: int = 32
    vocabulary: int = 30


@dataclass(frozen=True)
class AxialConfig:
    """From the codes of the past, and text, to the codes of the next frame.

    Attributes:
        dim: token width. layers, heads, hidden: the transformer, one axis a layer: time, height, width, time, ...
        frames: the longest video, in frames, the seen one included.
        patch: side of the square of codes that make one token. 1 as published; 2 makes a frame of 16x16 codes 64
            tokens and so four times as cheap, with all codes of a frame still predicted at once.
        copy: add to the score of the code that a place has now, and of the one it had in the first frame, a bonus that
            is read off the token: standing still and being seen again need then not be learned code by code. Not
            published; for training in minutes.
    """

    dim: int = 512
    layers: int = 6
    heads: int = 16
    hidden: int = 2048
    frames: int = 20
    patch: int = 1
    copy: bool = False


@dataclass(frozen=True)
class MageConfig:
    """A whole MAGE.

    Attributes:
        name: the preset it came from.
        vqvae, text, axial: its three parts.
        architecture: always `mage`; tells its checkpoints from others.
    """

    KINDS: ClassVar[Mapping[str, Mapping[str, type]]] = {
        "text": {**ENCODERS, "published": PublishedTextConfig},
    }

    name: str
    vqvae: VQVAEConfig = field(default_factory=VQVAEConfig)
    text: TextConfig | PublishedTextConfig = field(default_factory=PublishedTextConfig)
    axial: AxialConfig = field(default_factory=AxialConfig)
    architecture: Literal["mage"] = ARCHITECTURE

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionaries, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> MageConfig:
        """The inverse of `to_dict`.

        Raises:
            ValueError: see `textocvp.config.build`.
        """
        return build(cls, data)


MAGE_PRESETS: dict[str, MageConfig] = {
    # The published sizes at 64x64.
    "mage": MageConfig(name="mage"),
    # For two CPU cores: VQ-VAE in minutes, the transformer in tens of minutes, at the episodes' 25 frames. Without
    # `copy` most of that time goes into learning that the table does not move.
    "mage-small": MageConfig(
        name="mage-small",
        vqvae=VQVAEConfig(channels=64, code_dim=64),
        text=WordsConfig(kind="lexicon"),
        axial=AxialConfig(dim=128, heads=4, hidden=256, frames=25, patch=2, copy=True),
    ),
    # The paper's MAGE-DINO at its own sizes (CLIPort, 336x336: 24x24 patches, one seed frame and 19 predicted).
    "mage-dino": MageConfig(
        name="mage-dino", vqvae=VQVAEConfig(image_size=336, encoder="dinov2", channels=1024)
    ),
}


def mage_preset(name: str) -> MageConfig:
    """The preset of that name.

    Raises:
        KeyError: if there is none; the message lists those that exist.
    """
    try:
        return MAGE_PRESETS[name]
    except KeyError:
        raise KeyError(f"unknown MAGE preset {name!r}; known: {', '.join(sorted(MAGE_PRESETS))}") from None
