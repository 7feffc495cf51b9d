"""The transformer pieces of MAGE: attention with biases, along one axis of a video at a time.

"Axial Attention in Multidimensional Transformers" (Ho et al. 2019); its order and sizes here are from "Make It Move"
(CVPR 2022), section 3.4.

Shape suffixes: B videos, T frames, g tokens along a side of a frame, C width, X sequences, N tokens that ask, M tokens
that are asked.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import KeyValueCache, join_heads, split_heads

Axis = Literal["time", "height", "width"]
AXES: tuple[Axis, ...] = ("time", "height", "width")


class FeedForward(nn.Module):
    """Linear, GELU, linear."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(dim, hidden)
        self.last = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.last(F.gelu(self.first(x), approximate="tanh"))


class BiasedAttention(nn.Module):
    """Multi-head attention with biases, as MAGE has them.

    Raises:
        ValueError: if the width cannot be divided into the heads.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"width {dim} cannot be divided into {heads} heads")
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        nn.init.xavier_uniform_(self.qkv.weight)
        for linear in (self.qkv, self.out):
            nn.init.zeros_(linear.bias)

    def forward(
        self,
        x_XNC: Tensor,
        bias: Tensor | None = None,
        *,
        context_XMC: Tensor | None = None,
        cache: KeyValueCache | None = None,
    ) -> Tensor:
        """Attend from tokens to themselves, or to `context_XMC`; (X, N, C).

        Args:
            bias: added to the logits, broadcastable to (X, heads, N, M).
            cache: keys and values of earlier tokens, which are attended to as well; gets those of these tokens.
        """
        if context_XMC is None:
            q_XNC, k_XMC, v_XMC = self.qkv(x_XNC).chunk(3, dim=-1)
        else:
            dim = x_XNC.shape[-1]
            q_XNC = F.linear(x_XNC, self.qkv.weight[:dim], self.qkv.bias[:dim])
            k_XMC, v_XMC = F.linear(context_XMC, self.qkv.weight[dim:], self.qkv.bias[dim:]).chunk(2, dim=-1)
        q, k, v = (split_heads(x, self.heads) for x in (q_XNC, k_XMC, v_XMC))
        if cache is not None:
            k, v = cache.append(k, v)
        return self.out(join_heads(F.scaled_dot_product_attention(q, k, v, attn_mask=bias)))


class AxialBlock(nn.Module):
    """Pre-norm transformer block whose attention runs along one axis of a video.

    Along time it is causal: no frame sees a later one. Along height and width all tokens of a frame see each other.
    """

    def __init__(self, axis: Axis, dim: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.axis = axis
        self.norm_attention = nn.LayerNorm(dim)
        self.attention = BiasedAttention(dim, heads)
        self.norm_feed_forward = nn.LayerNorm(dim)
        self.feed_forward = FeedForward(dim, hidden)

    def forward(self, x_BTggC: Tensor, cache: KeyValueCache | None = None) -> Tensor:
        """The block on frames; with a `cache` (for `time` blocks only) they follow those seen before."""
        x_BTggC = x_BTggC + self._attend(self.norm_attention(x_BTggC), cache)
        return x_BTggC + self.feed_forward(self.norm_feed_forward(x_BTggC))

    def _attend(self, x_BTggC: Tensor, cache: KeyValueCache | None) -> Tensor:
        B, T, g, _, C = x_BTggC.shape
        if self.axis == "width":
            return self.attention(x_BTggC.flatten(0, 2)).view(x_BTggC.shape)
        if self.axis == "height":
            found_XgC = self.attention(x_BTggC.transpose(2, 3).reshape(B * T * g, g, C))
            return found_XgC.view(B, T, g, g, C).transpose(2, 3)
        past = 0 if cache is None else cache.length
        bias_TM = None
        if T > 1:
            later_TM = torch.ones(T, past + T, dtype=torch.bool, device=x_BTggC.device).triu(past + 1)
            bias_TM = torch.zeros_like(later_TM, dtype=x_BTggC.dtype).masked_fill(later_TM, float("-inf"))
        found_XTC = self.attention(
            x_BTggC.permute(0, 2, 3, 1, 4).reshape(B * g * g, T, C), bias_TM, cache=cache
        )
        return found_XTC.view(B, g, g, T, C).permute(0, 3, 1, 2, 4)
