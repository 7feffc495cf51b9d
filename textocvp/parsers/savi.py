"""The published scene parser: slot attention for video (SAVi; TextOCVP section 3.1 and appendix).

frame -> ConvEncoder -> features -> SlotAttention (corrector) -> slots -> Transition -> next frame's guess
                                     ^ first frame: GaussianInitializer or clusters
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import PositionCode, init_relu_
from textocvp.parsers.base import Generators, Parsed, ParserConfig, SceneParser
from textocvp.parsers.clustering import ClusterInitializer, FeatureClusters
from textocvp.parsers.dino import DinoEncoder
from textocvp.parsers.efficientnet import LITE0, EfficientNetEncoder
from textocvp.parsers.frozen import FrozenEncoder, cells_along
from textocvp.parsers.frozen_votes import VotedClusters, VotesEncoder
from textocvp.slots import SlotLayout


@dataclass(frozen=True)
class SaviConfig(ParserConfig):
    """Options of `SaviParser`: encoder -> initializer -> corrector -> transition."""

    kind: Literal["savi"] = "savi"
    layout: SlotLayout = SlotLayout(content=64, explicit=False)
    # `gaussian` samples from one learned Gaussian (published); `cluster` starts from clusters of colour and place, of
    # the frozen encoder's features, or of its votes.
    initializer: Literal["gaussian", "cluster"] = "cluster"
    encoder: Literal["conv", "dinov2", "efficientnet-lite0", "votes"] = "conv"  # learned, or one of `FROZEN`
    encoder_channels: int = 32  # width of the convolutional encoder
    encoder_stride: int = 1  # of its first convolution
    # Folder or hub id of DINOv2, file of EfficientNet-Lite0, checkpoint whose parser is `votes`; empty for
    # facebook/dinov2-base, the extra's package, and the bundled `cater`.
    encoder_weights: str = ""
    encoder_dim: int = 768  # width of its features
    encoder_patch: int = 14  # side of its patches in pixels
    encoder_fingerprint: str = ""  # of its weights, set when a model that has used them is saved; others are an error
    iterations_first: int = 1  # of the corrector on the first frame; later frames take one
    transition_heads: int = 4  # of the transformer block between frames
    transition_hidden: int = 128

    def __post_init__(self) -> None:
        self._check_layout(explicit=False)
        self._check_slots(2 if self.initializer == "cluster" else 1, "with clusters 2, for the background")
        self._check_heads(self.layout.dim, self.transition_heads)
        _ = self.features  # patches must divide the frame

    @property
    def features(self) -> tuple[int, int] | None:
        if self.encoder == "conv":
            return None
        return cells_along(self.image_size, self.encoder_patch), self.encoder_dim


FROZEN: dict[str, type[FrozenEncoder]] = {"dinov2": DinoEncoder, LITE0: EfficientNetEncoder, "votes": VotesEncoder}


class ConvEncoder(nn.Module):
    """Frames (N, 3, H, W) in -1..1 to features (N, D, h, w): four 5x5 convolutions, position code, local MLP."""

    def __init__(self, channels: int, stride: int, out_dim: int) -> None:
        super().__init__()
        blocks = [nn.Conv2d(3, channels, 5, stride=stride, padding=2), nn.ReLU()]
        for _ in range(3):
            blocks += [nn.Conv2d(channels, channels, 5, padding=2), nn.ReLU()]
        self.convolutions = nn.Sequential(*blocks)
        init_relu_(self.convolutions)  # else the picture shrinks until the position code drowns it
        self.position = PositionCode(channels)
        self.mlp = nn.Sequential(
            nn.LayerNorm(channels), nn.Linear(channels, out_dim), nn.ReLU(), nn.Linear(out_dim, out_dim)
        )

    def forward(self, frames_N3HW: Tensor) -> Tensor:
        features_NCHW = self.position(self.convolutions(frames_N3HW))
        return self.mlp(features_NCHW.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class FeatureProjection(nn.Module):
    """Features of a frozen encoder (N, F, h, w) to those for the slots (N, D, h, w); `place` adds where they are."""

    def __init__(self, feature_dim: int, out_dim: int, place: bool) -> None:
        super().__init__()
        # A transformer's features and votes know it already, those of convolutions do not.
        self.position = PositionCode(feature_dim) if place else nn.Identity()
        hidden = max(feature_dim, out_dim)
        self.mlp = nn.Sequential(
            nn.LayerNorm(feature_dim), nn.Linear(feature_dim, hidden), nn.ReLU(), nn.Linear(hidden, out_dim)
        )

    def forward(self, features_NFhw: Tensor) -> Tensor:
        return self.mlp(self.position(features_NFhw).permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class GaussianInitializer(nn.Module):
    """First slots drawn from one learned Gaussian, the same for every slot: their number is free at test time."""

    def __init__(self, slot_dim: int) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.randn(slot_dim) * slot_dim**-0.5)
        self.log_deviation = nn.Parameter(torch.zeros(slot_dim))

    def forward(self, batch: int, num_slots: int, generator: Generators = None) -> Tensor:
        """(batch, num_slots, D) slots."""
        size, mean = (num_slots, len(self.mean)), self.mean
        if isinstance(generator, Sequence):
            drawn = [torch.randn(size, generator=one, device=one.device) for one in generator]
            noise_BKD = torch.stack(drawn).to(mean)
        else:
            noise_BKD = torch.randn(batch, *size, generator=generator, device=mean.device, dtype=mean.dtype)
        return self.mean + self.log_deviation.exp() * noise_BKD


class ClusterSlots(nn.Module):
    """First slots from clusters: the mean feature of each cluster, through a small MLP."""

    def __init__(self, slot_dim: int, clusters: ClusterInitializer) -> None:
        super().__init__()
        self.clusters = clusters
        self.mlp = nn.Sequential(
            nn.LayerNorm(slot_dim), nn.Linear(slot_dim, slot_dim), nn.ReLU(), nn.Linear(slot_dim, slot_dim)
        )
        # What a cluster without pixels gives: a slot like any other, since it has no presence that could be 0.
        self.empty = nn.Parameter(torch.randn(slot_dim) * slot_dim**-0.5)

    def forward(self, seen_BCHW: Tensor, features_BDhw: Tensor, num_slots: int) -> tuple[Tensor, Tensor]:
        """(B, num_slots, D) slots, and the share of every location (B, num_slots, h * w) that each cluster covers.

        Args:
            seen_BCHW: what is divided into clusters: frames, or the features of a frozen encoder.
            features_BDhw: whose means the slots are made of.
        """
        found = self.clusters(seen_BCHW, num_slots)
        h, w = features_BDhw.shape[-2:]
        shares_BKL = F.adaptive_avg_pool2d(found.masks, (h, w)).flatten(2)
        weights_BKL = shares_BKL / shares_BKL.sum(dim=-1, keepdim=True).clamp_min(1e-6)
        slots_BKD = self.mlp(weights_BKL @ features_BDhw.flatten(2).transpose(1, 2))
        return torch.where(found.presence[..., None] > 0, slots_BKD, self.empty), shares_BKL


class SlotAttention(nn.Module):
    """The corrector: slots compete for locations, then each is updated with the mean of what it won.

    Weights are a softmax over the slots, renormalised over the locations; the update is a GRU and a residual MLP
    (Locatello et al. 2020; TextOCVP equations 1 and 2).
    """

    def __init__(self, slot_dim: int, hidden: int) -> None:
        super().__init__()
        self.norm_features = nn.LayerNorm(slot_dim)
        self.norm_slots = nn.LayerNorm(slot_dim)
        self.norm_mlp = nn.LayerNorm(slot_dim)
        self.query = nn.Linear(slot_dim, slot_dim, bias=False)
        self.key = nn.Linear(slot_dim, slot_dim, bias=False)
        self.value = nn.Linear(slot_dim, slot_dim, bias=False)
        for layer in (self.query, self.key, self.value):
            # As published. PyTorch's own start is a third of it, and slots stay alike far longer.
            nn.init.xavier_uniform_(layer.weight)
        self.gru = nn.GRUCell(slot_dim, slot_dim)
        self.mlp = nn.Sequential(nn.Linear(slot_dim, hidden), nn.ReLU(), nn.Linear(hidden, slot_dim))

    def forward(
        self, slots_BKD: Tensor, features_BLD: Tensor, iterations: int, given_BKL: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Corrected slots (B, K, D) and the last iteration's attention (B, K, L), which sums to 1 over the slots.

        Args:
            given_BKL: the attention of all iterations, where it is known (clusters); sums to 1 over the slots.
        """
        if iterations < 1:
            raise ValueError(f"slot attention needs at least 1 iteration, not {iterations}")
        B, K, D = slots_BKD.shape
        features_BLD = self.norm_features(features_BLD)
        keys_BLD, values_BLD = self.key(features_BLD), self.value(features_BLD)
        for _ in range(iterations):
            if given_BKL is not None:
                attention_BKL = given_BKL
            else:
                queries_BKD = self.query(self.norm_slots(slots_BKD)) * D**-0.5
                attention_BKL = torch.softmax((queries_BKD @ keys_BLD.transpose(1, 2)).float(), dim=1)
            # The small constant keeps a slot that won nothing at the mean of all locations instead of at 0/0.
            weights_BKL = attention_BKL + 1e-8
            weights_BKL = weights_BKL / weights_BKL.sum(dim=-1, keepdim=True)
            updates_BKD = weights_BKL.to(values_BLD.dtype) @ values_BLD
            slots_BKD = self.gru(updates_BKD.flatten(0, 1), slots_BKD.flatten(0, 1)).view(B, K, D)
            slots_BKD = slots_BKD + self.mlp(self.norm_mlp(slots_BKD))
        return slots_BKD, attention_BKL


class SaviParser(SceneParser):
    """Slot attention for video over clips.

    Slots keep their number through a clip. With `cluster` the clusters are the attention on the first frame, and slots
    compete for locations from the second frame on.
    """

    Config = SaviConfig
    config: SaviConfig

    def __init__(self, config: SaviConfig) -> None:
        super().__init__(config)
        dim = config.layout.dim
        if config.encoder != "conv":
            self.frozen = FROZEN[config.encoder](
                config.encoder_weights,
                dim=config.encoder_dim,
                patch=config.encoder_patch,
                fingerprint=config.encoder_fingerprint,
            )
            self.cells = self.frozen.cells(config.image_size)
            self.encoder: ConvEncoder | FeatureProjection = FeatureProjection(
                config.encoder_dim, dim, place=config.encoder == LITE0
            )
        else:
            self.encoder = ConvEncoder(config.encoder_channels, config.encoder_stride, dim)
        if config.initializer == "gaussian":
            self.initializer: GaussianInitializer | ClusterSlots = GaussianInitializer(dim)
        else:
            clusters = {"conv": ClusterInitializer, "votes": VotedClusters}.get(config.encoder, FeatureClusters)
            self.initializer = ClusterSlots(dim, clusters())
        self.corrector = SlotAttention(dim, hidden=2 * dim)
        # Between frames: one transformer encoder block over the slots (4 heads, MLP of 512 in the paper).
        sizes = (dim, config.transition_heads, config.transition_hidden)
        self.transition = nn.TransformerEncoderLayer(*sizes, dropout=0.0, batch_first=True, norm_first=True)

    def forward(
        self,
        frames_BT3HW: Tensor,
        *,
        num_slots: int | None = None,
        generator: Generators = None,
        features_BTLF: Tensor | None = None,
    ) -> Parsed:
        """Parse clips; see `SceneParser.forward`.

        Args:
            features_BTLF: of the frozen encoder, where they are known already; its weights are then not needed.

        Raises:
            ValueError: if features are given to a parser that learns its encoder.
        """
        B, T = frames_BT3HW.shape[:2]
        K = self.config.num_slots if num_slots is None else num_slots
        if self.frozen is None:
            if features_BTLF is not None:
                raise ValueError("features are for a parser with a frozen encoder: parser.encoder is 'conv'")
            seen_BTCHW = frames_BT3HW
        else:
            if features_BTLF is None:
                features_BTLF = self.frozen(frames_BT3HW.flatten(0, 1)).unflatten(0, (B, T))
            seen_BTCHW = features_BTLF.transpose(2, 3).unflatten(3, (self.cells, self.cells))
        features_NDhw = self.encoder(seen_BTCHW.flatten(0, 1))
        h, w = features_NDhw.shape[-2:]
        features_BTLD = features_NDhw.flatten(2).transpose(1, 2).unflatten(0, (B, T))

        clusters_BKL = None
        if isinstance(self.initializer, GaussianInitializer):
            guess_BKD = self.initializer(B, K, generator)
        else:
            first_BDhw = features_NDhw.unflatten(0, (B, T))[:, 0]
            guess_BKD, clusters_BKL = self.initializer(seen_BTCHW[:, 0], first_BDhw, K)
        slots, attention = [], []
        for t in range(T):
            rounds = self.config.iterations_first if t == 0 else 1
            given_BKL = clusters_BKL if t == 0 else None
            slots_BKD, attention_BKL = self.corrector(guess_BKD, features_BTLD[:, t], rounds, given_BKL)
            slots.append(slots_BKD)
            attention.append(attention_BKL.unflatten(2, (h, w)))
            if t + 1 < T:
                guess_BKD = self.transition(slots_BKD)
        return Parsed(torch.stack(slots, dim=1), torch.stack(attention, dim=1), features_BTLF=features_BTLF)
