"""Building blocks that several parts of the models share: attention, position codes, initial weights.

Shape suffixes: B batch, N tokens that ask, M tokens that are asked, L words, C width, h heads, d width of a head.
"""

import math
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Added to the logits of what may not be attended to. Finite, so that a row without any token is not NaN.
MASKED = -1e9


def mask_bias(masked: Tensor) -> Tensor:
    """Logit terms of the same shape: `MASKED` where `masked` is True, else 0."""
    return torch.zeros(masked.shape, device=masked.device).masked_fill(masked, MASKED)


def attend(q_BhNd: Tensor, k_BhMd: Tensor, v_BhMd: Tensor, bias: Tensor | None) -> tuple[Tensor, Tensor]:
    """Scaled dot-product attention: the values (B, h, N, d), and the weights (B, h, N, M), which sum to 1 over M.

    `bias` is added to the logits and broadcastable to (B, h, N, M).
    """
    logits_BhNM = (q_BhNd * q_BhNd.shape[-1] ** -0.5) @ k_BhMd.transpose(-1, -2)
    if bias is not None:
        logits_BhNM = logits_BhNM + bias
    weights_BhNM = logits_BhNM.softmax(dim=-1)
    return weights_BhNM.to(v_BhMd.dtype) @ v_BhMd, weights_BhNM


def split_heads(x_BNC: Tensor, heads: int) -> Tensor:
    """(B, N, h*d) -> (B, h, N, d)"""
    return x_BNC.unflatten(-1, (heads, -1)).transpose(1, 2)


def join_heads(x_BhNd: Tensor) -> Tensor:
    """(B, h, N, d) -> (B, N, h*d)"""
    return x_BhNd.transpose(1, 2).flatten(2)


class KeyValueCache:
    """Keys and values of the tokens that one layer has seen, at most `capacity` of them."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.length = 0
        self._seen: list[Tensor] = []  # keys and values

    def append(self, k_BhNd: Tensor, v_BhNd: Tensor) -> tuple[Tensor, Tensor]:
        """Add N tokens and return keys and values of all M, each (B, h, M, d); a ValueError if they are too many."""
        start, end = self.length, self.length + k_BhNd.shape[2]
        if end > self.capacity:
            raise ValueError(f"the cache holds {self.capacity} tokens, {end} were given")
        added, self.length = [k_BhNd, v_BhNd], end
        # Autograd must not see a buffer change that it still needs, so with gradients tokens are concatenated.
        if torch.is_grad_enabled():
            pairs = zip(self._seen, added, strict=True)
            self._seen = [torch.cat(pair, dim=2) for pair in pairs] if self._seen else added
            return self._seen[0], self._seen[1]
        # Without gradients they are written into buffers of the final size: nothing is copied twice.
        if not self._seen:
            self._seen = [x.new_empty(*x.shape[:2], self.capacity, x.shape[3]) for x in added]
        for buffer, x in zip(self._seen, added, strict=True):
            buffer[:, :, start:end] = x
        return self._seen[0][:, :, :end], self._seen[1][:, :, :end]


class SelfAttention(nn.Module):
    """Multi-head self-attention with one fused projection and, as published, no biases."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"width {dim} cannot be divided into {heads} heads")
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim, bias=False)
        self.out = nn.Linear(dim, dim, bias=False)

    def forward(
        self, x_BMC: Tensor, bias: Tensor | None, newest: int | None = None, cache: KeyValueCache | None = None
    ) -> Tensor:
        """(B, N, C): the last N = `newest` tokens (default: all) attend to all tokens and to those in the cache."""
        dim = x_BMC.shape[-1]
        if newest is None:
            q_BNC, k_BMC, v_BMC = self.qkv(x_BMC).chunk(3, dim=-1)
        else:
            q_BNC = F.linear(x_BMC[:, -newest:], self.qkv.weight[:dim])
            k_BMC, v_BMC = F.linear(x_BMC, self.qkv.weight[dim:]).chunk(2, dim=-1)
        k_BhMd, v_BhMd = split_heads(k_BMC, self.heads), split_heads(v_BMC, self.heads)
        if cache is not None:
            k_BhMd, v_BhMd = cache.append(k_BhMd, v_BhMd)
        q_BhNd = split_heads(q_BNC, self.heads)
        # On a CPU the fused attention takes 0.75 of the time of `attend` in float32, but 1.8 of it in bfloat16.
        if q_BhNd.device.type == "cpu" and q_BhNd.dtype != torch.float32:
            values_BhNd, _ = attend(q_BhNd, k_BhMd, v_BhMd, bias)
        else:
            values_BhNd = F.scaled_dot_product_attention(q_BhNd, k_BhMd, v_BhMd, attn_mask=bias)
        return self.out(join_heads(values_BhNd))


class TextAttention(nn.Module):
    """Cross-attention from slots to words. Keys and values are apart, because a rollout needs them only once."""

    def __init__(self, dim: int, heads: int, text_dim: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_text = nn.LayerNorm(text_dim, eps=1e-6)
        self.q = nn.Linear(dim, dim, bias=False)
        self.kv = nn.Linear(text_dim, 2 * dim, bias=False)
        self.out = nn.Linear(dim, dim)

    def keys_values(self, text_BLC: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values of the words, each (B, h, L, d)."""
        k_BLC, v_BLC = self.kv(self.norm_text(text_BLC)).chunk(2, dim=-1)
        return split_heads(k_BLC, self.heads), split_heads(v_BLC, self.heads)

    def forward(self, x_BNC: Tensor, keys_values: tuple[Tensor, Tensor], bias: Tensor) -> tuple[Tensor, Tensor]:
        """The text's update of each token (B, N, C), and the attention (B, h, N, L)."""
        values_BhNd, weights_BhNL = attend(split_heads(self.q(x_BNC), self.heads), *keys_values, bias)
        return self.out(join_heads(values_BhNd)), weights_BhNL


class FeedForward(nn.Sequential):
    """Linear, ReLU, linear."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__(nn.Linear(dim, hidden), nn.ReLU(), nn.Linear(hidden, dim))


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """Switch autocast off: what is computed within is as precise as its inputs."""
    if device.type == "meta":  # it has no autocast
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


def pixel_grid(height: int, width: int, *, device: torch.device | str | None = None) -> Tensor:
    """The pixel centres (x, y) in the unit of `SlotState.position`, (height, width, 2) float32; edges are -1 and 1."""
    y = (torch.arange(height, device=device, dtype=torch.float32) + 0.5) * (2 / height) - 1
    x = (torch.arange(width, device=device, dtype=torch.float32) + 0.5) * (2 / width) - 1
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([grid_x, grid_y], dim=-1)


class PositionCode(nn.Module):
    """Adds to a feature map a learned linear code of each location's distances to the four edges."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.project = nn.Linear(4, channels)

    def forward(self, features_BCHW: Tensor) -> Tensor:
        H, W = features_BCHW.shape[-2:]
        grid_HW2 = pixel_grid(H, W, device=features_BCHW.device)
        edges_HW4 = torch.cat([1 + grid_HW2, 1 - grid_HW2], dim=-1) / 2  # 0..1 from left, top, right, bottom
        return features_BCHW + self.project(edges_HW4).permute(2, 0, 1)


def init_relu_(module: nn.Module) -> None:
    """Initial weights with which ReLU layers keep the scale of their input (He et al. 2015)."""
    # With PyTorch's own it shrinks from layer to layer: an autoencoder draws the mean picture for hundreds of updates.
    for layer in module.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear)):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def sinusoids(length: int, dim: int) -> Tensor:
    """Sinusoidal position codes (length, dim), as in "Attention Is All You Need" (2017)."""
    position_L1 = torch.arange(length, dtype=torch.float32)[:, None]
    rate_c = torch.exp(-math.log(10_000.0) * torch.arange(0, dim, 2, dtype=torch.float32) / dim)
    codes_LC = torch.zeros(length, dim)
    codes_LC[:, 0::2] = torch.sin(position_L1 * rate_c)
    codes_LC[:, 1::2] = torch.cos(position_L1 * rate_c[: dim // 2])
    return codes_LC
