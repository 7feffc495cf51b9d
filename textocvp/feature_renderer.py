"""The renderer of TextOCVP-DINO: slots to image features with masks, and features to a picture.

Every slot is copied to every patch and decoded by an MLP to features and an alpha (DINOSAUR, Seitzer et al. 2023); the
alphas become masks by a softmax over the slots, the masked features are added up, and a convolutional decoder draws
the sum. Masks exist at the resolution of the features and are interpolated to that of the frames.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from textocvp.config import ModelConfig, RendererConfig
from textocvp.image_decoders import build_image_decoder
from textocvp.patches import PatchDecoder, SlotPlace, gaussian_prior
from textocvp.renderer import Rendered, Renderer
from textocvp.slots import SlotLayout


class FeatureRenderer(Renderer):
    """Slots (B, K, D) to features (B, L, F), masks and frames.

    Slots are exchangeable: reordering them reorders masks and object frames and leaves features and frame as they are.

    Args:
        config: `patches` (L is its square), `layers`, `hidden`, `mask_prior`, `feature_dim`, `image_decoder` and
            `image_channels`.
        layout: gives the slots' width.
        image_size: side of the frames in pixels.
    """

    def __init__(self, config: RendererConfig, layout: SlotLayout, image_size: int) -> None:
        super().__init__()
        self.cells, self.image_size = config.patches, image_size
        # The alpha comes first, so that masks can be had without the features.
        self.decoder = PatchDecoder(
            layout.dim, config.patches, config.layers, config.hidden, 1 + config.feature_dim
        )
        self.place = SlotPlace(layout.dim) if config.mask_prior else None
        self.image_decoder = build_image_decoder(
            config.image_decoder, config.feature_dim, config.image_channels, image_size
        )

    def forward(self, slots_BKD: Tensor) -> Rendered:
        out_BKLC = self.decoder(slots_BKD)
        shares_BKL = self._shares(out_BKLC[..., 0], slots_BKD)
        own_BKLF = out_BKLC[..., 1:]
        features_BLF = (shares_BKL[..., None] * own_BKLF).sum(1)

        def draw_objects() -> Tensor:
            return self._picture(own_BKLF.flatten(0, 1)).unflatten(0, own_BKLF.shape[:2])

        return Rendered(self._picture(features_BLF), self._enlarged(shares_BKL), draw_objects, features_BLF)

    def masks(self, slots_BKD: Tensor) -> Tensor:
        return self._enlarged(self._shares(self.decoder(slots_BKD, first=1)[..., 0], slots_BKD))

    def places(self, slots_BKD: Tensor) -> tuple[Tensor, Tensor] | None:
        return None if self.place is None else self.place(slots_BKD)

    def _shares(self, alpha_BKL: Tensor, slots_BKD: Tensor) -> Tensor:
        alpha_BKL = alpha_BKL.float()  # bf16 masks would not sum to 1
        if self.place is not None:
            position_BK2, scale_BK2 = self.place(slots_BKD)
            alpha_BKL = alpha_BKL + gaussian_prior(position_BK2, scale_BK2, self.cells, self.cells).flatten(2)
        return torch.softmax(alpha_BKL, dim=1)

    def _picture(self, features_NLF: Tensor) -> Tensor:
        return self.image_decoder(features_NLF.transpose(1, 2).unflatten(2, (self.cells, self.cells)))

    def _enlarged(self, shares_BKL: Tensor) -> Tensor:
        masks_BKhw = shares_BKL.unflatten(2, (self.cells, self.cells))
        size = (self.image_size, self.image_size)
        return F.interpolate(masks_BKhw, size=size, mode="bilinear", align_corners=False)


def check_features(config: ModelConfig) -> None:
    """Raise a ValueError where renderer and parser do not speak of the same features; the message says what to set."""
    parser, renderer = config.parser, config.renderer
    if renderer.kind != "features":
        return
    if parser.encoder != "dinov2" or parser.corrector != "slot_attention":
        raise ValueError(
            "renderer.kind 'features' redraws the features of a frozen encoder: set parser.encoder=dinov2 and "
            "parser.corrector=slot_attention"
        )
    for name, has, wanted in (
        ("renderer.feature_dim", renderer.feature_dim, parser.encoder_dim),
        ("renderer.patches", renderer.patches, parser.image_size // parser.encoder_patch),
    ):
        if has != wanted:
            raise ValueError(f"{name} is {has}, the encoder's features have {wanted}: set {name}={wanted}")
