"""An MLP draws patch by patch: every slot is copied to every cell of a coarse grid (DINOSAUR, Seitzer et al. 2023).

Two renderers fill the cells: `patches` with pixels, `features` with the features of a frozen encoder, which
convolutions draw (TextOCVP-DINO). On a CPU `patches` is many times faster than convolutions at full resolution, because
nothing wider than four channels ever exists at pixel resolution.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import pixel_grid
from textocvp.renderers.base import Rendered, Renderer, RendererConfig
from textocvp.renderers.image_decoders import build_image_decoder, check_channels
from textocvp.slots import SlotLayout

FREQUENCIES = 4
MIN_SCALE = 0.02  # smallest standard deviation of the mask prior, in -1..1: two thirds of a pixel at 64x64


@dataclass(frozen=True)
class GridConfig(RendererConfig):
    """Options of both renderers."""

    patches: int = 16  # along a side of the frame
    layers: int = 4  # linear ones, of the MLP; at least 2
    hidden: int = 256  # their width
    # Add to the logits of a mask a Gaussian, whose place and size a linear layer reads off the slot.
    mask_prior: bool = False

    def __post_init__(self) -> None:
        if self.layers < 2:
            raise ValueError(f"renderer.layers must be at least 2, not {self.layers}")


@dataclass(frozen=True)
class PatchConfig(GridConfig):
    """Options of `PatchRenderer`."""

    kind: Literal["patches"] = "patches"


@dataclass(frozen=True)
class FeatureConfig(GridConfig):
    """Options of `FeatureRenderer`; `patches` and `feature_dim` must be those of the parser's frozen encoder."""

    kind: Literal["features"] = "features"
    feature_dim: int = 768  # width of the reconstructed features
    image_decoder: Literal["cnn", "vqgan"] = "cnn"  # features to pixels: published, or larger and sharper
    image_channels: int = 1024  # width of the first convolution of `cnn`; that of `vqgan` is half of it

    def __post_init__(self) -> None:
        super().__post_init__()
        check_channels(self.image_channels)


def position_code(cells: int) -> Tensor:
    """(cells * cells, 2 + 4 * FREQUENCIES): coordinates of the cells in -1..1, plain and as sines and cosines."""
    grid_L2 = pixel_grid(cells, cells).flatten(0, 1)
    waves = [grid_L2 * (math.pi * 2**i / 2) for i in range(FREQUENCIES)]
    return torch.cat([grid_L2, *(wave.sin() for wave in waves), *(wave.cos() for wave in waves)], dim=-1)


class PatchDecoder(nn.Module):
    """Slots (B, K, D) to `out_dim` numbers at each of L = `cells` x `cells` places, (B, K, L, out_dim), row by row."""

    codes_LC: Tensor

    def __init__(self, slot_dim: int, cells: int, layers: int, hidden: int, out_dim: int) -> None:
        super().__init__()
        codes_LC = position_code(cells)
        self.register_buffer("codes_LC", codes_LC, persistent=False)
        # The first layer is linear in the slot and in the code of the place, so it is computed once for each and added:
        # there are no L times K copies of the slots.
        self.slot = nn.Linear(slot_dim, hidden)
        self.place = nn.Linear(codes_LC.shape[-1], hidden, bias=False)
        inner: list[nn.Module] = [nn.ReLU()]
        for _ in range(layers - 2):
            inner += [nn.Linear(hidden, hidden), nn.ReLU()]
        self.rest = nn.Sequential(*inner, nn.Linear(hidden, out_dim))

    def forward(self, slots_BKD: Tensor, first: int | None = None) -> Tensor:
        """All `out_dim` numbers of every place, or only the first so many."""
        *inner, last = self.rest
        hidden_BKLH = self.slot(slots_BKD)[:, :, None] + self.place(self.codes_LC)
        for layer in inner:
            hidden_BKLH = layer(hidden_BKLH)
        assert isinstance(last, nn.Linear)
        return F.linear(hidden_BKLH, last.weight[:first], last.bias[:first])


class SlotPlace(nn.Module):
    """Reads a place and a size off a slot whose numbers are unexplained: one linear layer.

    Stage 1 holds them to the moments of the slot's attention (`textocvp.training.losses.read_place_loss`).
    """

    def __init__(self, slot_dim: int) -> None:
        super().__init__()
        self.read = nn.Linear(slot_dim, 4)
        nn.init.zeros_(self.read.bias)

    def forward(self, slots_BKD: Tensor) -> tuple[Tensor, Tensor]:
        """Centre (x, y) in -1..1 and standard deviation along x and y in that unit, each (B, K, 2)."""
        position, scale = self.read(slots_BKD).float().split(2, dim=-1)
        return position.tanh(), MIN_SCALE + F.softplus(scale - 1)  # 0.33 for a slot that says nothing


def gaussian_prior(position_BK2: Tensor, scale_BK2: Tensor, height: int, width: int) -> Tensor:
    """(B, K, height, width): the logarithm of each slot's Gaussian at each pixel, up to a constant."""
    grid_HW2 = pixel_grid(height, width, device=position_BK2.device)
    x_BKW = ((grid_HW2[0, :, 0] - position_BK2[..., :1]) / scale_BK2[..., :1]).square() / 2
    y_BKH = ((grid_HW2[:, 0, 1] - position_BK2[..., 1:]) / scale_BK2[..., 1:]).square() / 2
    x_BKW = x_BKW + scale_BK2.log().sum(-1, keepdim=True)
    return -(x_BKW[:, :, None, :] + y_BKH[..., None])


class GridRenderer(Renderer):
    """What both renderers share: the MLP and, with `mask_prior`, the places read off the slots. These are a set."""

    def __init__(self, config: GridConfig, layout: SlotLayout, image_size: int, out_dim: int) -> None:
        super().__init__()
        self.cells, self.image_size = config.patches, image_size
        self.decoder = PatchDecoder(layout.dim, self.cells, config.layers, config.hidden, out_dim)
        self.place = SlotPlace(layout.dim) if config.mask_prior else None

    def places(self, slots_BKD: Tensor) -> tuple[Tensor, Tensor] | None:
        return None if self.place is None else self.place(slots_BKD)

    def _masks(self, alpha_BKhw: Tensor, slots_BKD: Tensor) -> Tensor:
        """The competition of all slots for each place (B, K, h, w)."""
        alpha_BKhw = alpha_BKhw.float()  # bf16 masks would not sum to 1
        if self.place is not None:
            alpha_BKhw = alpha_BKhw + gaussian_prior(*self.place(slots_BKD), *alpha_BKhw.shape[2:])
        return torch.softmax(alpha_BKhw, dim=1)


class PatchRenderer(GridRenderer):
    """Every slot to a grid of patches of pixels (RGB and alpha); the patches must divide the frame."""

    Config = PatchConfig

    def __init__(self, config: PatchConfig, layout: SlotLayout, image_size: int) -> None:
        side = image_size // config.patches
        super().__init__(config, layout, image_size, 4 * side**2)
        self.side = side

    def forward(self, slots_BKD: Tensor) -> Rendered:
        B, K, _ = slots_BKD.shape
        n, s = self.cells, self.side
        patches = self.decoder(slots_BKD).view(B, K, n, n, 4, s, s)
        alpha_BKHW = patches[:, :, :, :, 3].transpose(3, 4).reshape(B, K, n * s, n * s)
        masks_BKHW = self._masks(alpha_BKHW, slots_BKD)
        # Composed patch by patch: only the sum, not every slot's picture, is put together to a frame.
        shares = masks_BKHW.view(B, K, n, s, n, s).transpose(3, 4)[:, :, :, :, None]
        composed_Bnn3ss = (shares * patches[:, :, :, :, :3]).sum(1)

        def draw_objects() -> Tensor:
            return patches[:, :, :, :, :3].permute(0, 1, 4, 2, 5, 3, 6).reshape(B, K, 3, n * s, n * s)

        frames_B3HW = composed_Bnn3ss.permute(0, 3, 1, 4, 2, 5).reshape(B, 3, n * s, n * s)
        return Rendered(frames_B3HW, masks_BKHW, draw_objects)


class FeatureRenderer(GridRenderer):
    """Slots (B, K, D) to features (B, L, F), masks and frames."""

    Config = FeatureConfig

    def __init__(self, config: FeatureConfig, layout: SlotLayout, image_size: int) -> None:
        # The alpha comes first, so that masks can be had without the features.
        super().__init__(config, layout, image_size, 1 + config.feature_dim)
        self.image_decoder = build_image_decoder(
            config.image_decoder, config.feature_dim, config.image_channels, config.patches, image_size
        )

    def forward(self, slots_BKD: Tensor) -> Rendered:
        out_BKLC = self.decoder(slots_BKD)
        shares_BKhw = self._shares(out_BKLC, slots_BKD)
        own_BKLF = out_BKLC[..., 1:]
        features_BLF = (shares_BKhw.flatten(2)[..., None] * own_BKLF).sum(1)

        def draw_objects() -> Tensor:
            return self._picture(own_BKLF.flatten(0, 1)).unflatten(0, own_BKLF.shape[:2])

        return Rendered(self._picture(features_BLF), self._enlarged(shares_BKhw), draw_objects, features_BLF)

    def masks(self, slots_BKD: Tensor) -> Tensor:
        return self._enlarged(self._shares(self.decoder(slots_BKD, first=1), slots_BKD))

    def _shares(self, out_BKLC: Tensor, slots_BKD: Tensor) -> Tensor:
        return self._masks(out_BKLC[..., 0].unflatten(2, (self.cells, self.cells)), slots_BKD)

    def _picture(self, features_NLF: Tensor) -> Tensor:
        return self.image_decoder(features_NLF.transpose(1, 2).unflatten(2, (self.cells, self.cells)))

    def _enlarged(self, shares_BKhw: Tensor) -> Tensor:
        size = (self.image_size, self.image_size)
        return F.interpolate(shares_BKhw, size=size, mode="bilinear", align_corners=False)
