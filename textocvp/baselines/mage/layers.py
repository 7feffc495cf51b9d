"""Attention and feed-forward net of MAGE, which unlike those of TextOCVP have biases.

Shape suffixes: X sequences, N tokens that ask, M tokens that are asked, C width.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import KeyValueCache, join_heads, split_heads


class FeedForward(nn.Module):
    """Linear, GELU, linear."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(dim, hidden)
        self.last = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.last(F.gelu(self.first(x), approximate="tanh"))


class BiasedAttention(nn.Module):
    """Multi-head attention whose projections have biases, with the published initial weights."""

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
        """Attend from tokens to themselves and to those in the cache, or to `context_XMC`; (X, N, C).

        Args:
            bias: added to the logits, broadcastable to (X, heads, N, M).
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
