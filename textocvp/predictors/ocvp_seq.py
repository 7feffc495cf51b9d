"""OCVP-Seq, a baseline of TextOCVP that uses no text (Villar-Corrales et al., ICIP 2023).

A layer has two transformer blocks. First the slots of a frame attend to each other, then each slot attends to itself
in other frames. A slot knows another one's past only through what that one carries along. Where the text decides
what happens, the predictor can only guess.
"""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn

from textocvp.layers import KeyValueCache, SelfAttention, mask_bias
from textocvp.predictors.base import PredictorConfig, RolloutState, SlotPredictor, feed_forward


@dataclass(frozen=True)
class OCVPSeqConfig(PredictorConfig):
    """Options of OCVP-Seq. Published: 2 layers of 128, 4 heads, hidden width 256, and 2 feed-forward nets."""

    kind: Literal["ocvp-seq"] = "ocvp-seq"


class OCVPSeqPredictor(SlotPredictor):
    """Object attention and time attention in turn."""

    Config = OCVPSeqConfig
    uses_text = False

    def _layer(self, text_dim: int) -> nn.Module:
        return OCVPSeqLayer(self.config)

    def _tokens_per_frame(self, slots: int) -> int:
        return 1  # a cache holds the track of one slot through time, K of them as a batch

    def _transform(self, x_BTKC: Tensor, state: RolloutState, newest_only: bool) -> tuple[Tensor, None]:
        T = x_BTKC.shape[1]
        object_bias_N11K = mask_bias(state.unused_BMK[:, -T:].flatten(0, 1))[:, None, None]
        masked_BTMK = self._masked(state.unused_BMK, T)
        time_bias_N1TM = mask_bias(masked_BTMK.permute(0, 3, 1, 2).flatten(0, 1))[:, None]
        for index, layer in enumerate(self.layers):
            cut = newest_only and index == len(self.layers) - 1
            x_BTKC = layer(x_BTKC, object_bias_N11K, time_bias_N1TM, cut, state.caches[index])
        return x_BTKC, None


class OCVPSeqLayer(nn.Module):
    """Object attention, then time attention; each has a feed-forward net, or with one net only the second."""

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__()
        self.objects = _Block(config, config.feed_forwards == 2)
        self.time = _Block(config, True)

    def forward(
        self,
        x_BTKC: Tensor,
        object_bias_N11K: Tensor,
        time_bias_N1TM: Tensor,
        newest_only: bool,
        cache: KeyValueCache | None,
    ) -> Tensor:
        """The tokens (B, T, K, C) after the layer, or only those of the newest frame (B, 1, K, C)."""
        B, T, K, _ = x_BTKC.shape
        x_BTKC = self.objects(x_BTKC.flatten(0, 1), object_bias_N11K).unflatten(0, (B, T))
        newest = 1 if newest_only and T > 1 else None
        if newest is not None:
            time_bias_N1TM = time_bias_N1TM[..., -1:, :]
        tracks_NTC = x_BTKC.transpose(1, 2).flatten(0, 1)
        tracks_NTC = self.time(tracks_NTC, time_bias_N1TM, newest, cache)
        return tracks_NTC.unflatten(0, (B, K)).transpose(1, 2)


class _Block(nn.Module):
    """Self-attention and perhaps a feed-forward net, both pre-norm and residual."""

    def __init__(self, config: PredictorConfig, with_feed_forward: bool) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(config.dim, eps=1e-6)
        self.attention = SelfAttention(config.dim, config.heads)
        self.feed_forward = feed_forward(config) if with_feed_forward else None

    def forward(
        self, x_BMC: Tensor, bias: Tensor, newest: int | None = None, cache: KeyValueCache | None = None
    ) -> Tensor:
        """The last `newest` tokens (default: all) after the block."""
        attended_BNC = self.attention(self.norm(x_BMC), bias, newest, cache)
        x_BNC = attended_BNC + (x_BMC if newest is None else x_BMC[:, -newest:])
        return x_BNC if self.feed_forward is None else x_BNC + self.feed_forward(x_BNC)
