"""OCVP-Seq, the predictor that hears no text: Villar-Corrales et al., ICIP 2023; a baseline of TextOCVP.

Every layer is two transformer blocks: the slots of a frame attend to each other, then each slot attends to itself in
the other frames. So a slot hears of another one's past only through what that one carries along. Where the text
decides what happens, it can only guess.
"""

from __future__ import annotations

from torch import Tensor, nn

from textocvp.config import PredictorConfig
from textocvp.layers import FeedForward, KeyValueCache, SelfAttention
from textocvp.predictors.base import Memory, SlotPredictor, mask_bias
from textocvp.slots import SlotLayout


class _Block(nn.Module):
    """Self-attention and, but for the first block of a layer with one, a feed-forward net; pre-norm and residual."""

    def __init__(self, config: PredictorConfig, feed_forward: bool) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(config.dim, eps=1e-6)
        self.attention = SelfAttention(config.dim, config.heads)
        self.feed_forward = (
            nn.Sequential(nn.LayerNorm(config.dim, eps=1e-6), FeedForward(config.dim, config.hidden))
            if feed_forward
            else None
        )

    def forward(
        self,
        x_BMC: Tensor,
        bias: Tensor | None,
        *,
        newest: int | None = None,
        cache: KeyValueCache | None = None,
    ) -> Tensor:
        """The `newest` last tokens (default: all) after the block."""
        attended_BNC = self.attention(self.norm(x_BMC), bias, newest=newest, cache=cache)
        x_BNC = attended_BNC + (x_BMC if newest is None else x_BMC[:, -newest:])
        return x_BNC if self.feed_forward is None else x_BNC + self.feed_forward(x_BNC)


class OcvpSeqLayer(nn.Module):
    """Object attention, then time attention. With `config.feed_forwards` = 2, as published, each has its own
    feed-forward net; with 1 the layer ends in one."""

    def __init__(self, config: PredictorConfig) -> None:
        super().__init__()
        self.objects = _Block(config, feed_forward=config.feed_forwards == 2)
        self.time = _Block(config, feed_forward=True)

    def forward(
        self,
        x_BTKC: Tensor,
        object_bias_N11K: Tensor,
        time_bias_N1TM: Tensor,
        *,
        newest_only: bool,
        cache: KeyValueCache | None,
    ) -> Tensor:
        """The tokens (B, T, K, C) after the layer, or with `newest_only` those of the newest frame (B, 1, K, C)."""
        B, T, K, _ = x_BTKC.shape
        x_BTKC = self.objects(x_BTKC.flatten(0, 1), object_bias_N11K).unflatten(0, (B, T))
        newest = 1 if newest_only and T > 1 else None
        if newest is not None:
            time_bias_N1TM = time_bias_N1TM[..., -1:, :]
        tracks_NTC = self.time(
            x_BTKC.transpose(1, 2).flatten(0, 1), time_bias_N1TM, newest=newest, cache=cache
        )
        return tracks_NTC.unflatten(0, (B, K)).transpose(1, 2)


class OcvpSeq(SlotPredictor):
    """The predictor of object attention and time attention in turn. It takes a text and ignores it.

    Args:
        config: sizes and form; the published ones are 2 layers of 128, 4 heads and a hidden width of 256.
        layout: what the numbers of a slot mean.

    Raises:
        ValueError: if `color_bias` is asked for, which belongs to the attention to the text.
    """

    hears_text = False

    def __init__(self, config: PredictorConfig, layout: SlotLayout) -> None:
        if config.color_bias:
            raise ValueError(
                "predictor.color_bias is part of the attention to the text, and 'ocvp-seq' hears none"
            )
        super().__init__(config, layout, (OcvpSeqLayer(config) for _ in range(config.layers)))

    def _cached_tokens(self, slots: int) -> int:
        return 1  # the caches hold the track of one slot through time, K of them in a batch

    def _transform(
        self,
        x_BTKC: Tensor,
        absent_BMK: Tensor,
        frame_bias: Tensor | None,
        memory: Memory,
        *,
        newest_only: bool,
    ) -> tuple[Tensor, None]:
        frames = x_BTKC.shape[1]
        object_bias_N11K = mask_bias(absent_BMK[:, -frames:].flatten(0, 1))[:, None, None]
        time_bias_BKTM = mask_bias(absent_BMK.transpose(1, 2))[:, :, None]
        if frame_bias is not None:
            time_bias_BKTM = time_bias_BKTM + frame_bias[:, None]
        time_bias_N1TM = time_bias_BKTM.flatten(0, 1)[:, None]
        for index, layer in enumerate(self.layers):
            x_BTKC = layer(
                x_BTKC,
                object_bias_N11K,
                time_bias_N1TM,
                newest_only=newest_only and index == len(self.layers) - 1,
                cache=None if memory.caches is None else memory.caches.layers[index],
            )
        return x_BTKC, None
