"""The second half of MAGE: codes of the frames so far, and text, to codes of the next frame.

"Make It Move" (CVPR 2022), sections 3.3 and 3.4. The motion anchor stands at time step 0, the frames follow. Each layer
attends along one axis ("Axial Attention in Multidimensional Transformers", Ho et al. 2019). From each frame a linear
layer scores the codes of the next, all at once.

Shape suffixes: B videos, T frames, h and w codes along a side of a frame, g tokens along a side, P codes of a token,
C width, K codes in the codebook, L words.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.baselines.mage.layers import BiasedAttention, FeedForward
from textocvp.layers import KeyValueCache, mask_bias
from textocvp.text.base import TextTokens

Axis = Literal["time", "height", "width"]
AXES: tuple[Axis, ...] = ("time", "height", "width")  # in the order of the dimensions after B


@dataclass(frozen=True)
class AxialConfig:
    """Options of `AxialTransformer`."""

    dim: int = 512  # token width
    layers: int = 6  # one axis each: time, height, width, time, ...
    heads: int = 16  # of the attention
    hidden: int = 2048  # width of the feed-forward nets
    frames: int = 20  # the longest video, the seen frame included
    # Side of the square of codes that make one token; 1 as published. With 2, a frame of 16x16 codes is 64 tokens and
    # so four times as cheap.
    patch: int = 1
    # Add a bonus, read off the token, to the scores of the code that a place has now and of the one it had first. So
    # the model need not learn code by code to leave a place as it is. Not published; for training in minutes.
    copy: bool = False


class AxialBlock(nn.Module):
    """Pre-norm transformer block whose attention runs along one axis of a video, causally where that is time."""

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
        axis = 1 + AXES.index(self.axis)
        moved = x_BTggC.movedim(axis, -2)
        bias_TM, T = None, x_BTggC.shape[1]
        if self.axis == "time" and T > 1:
            past = 0 if cache is None else cache.length
            bias_TM = x_BTggC.new_full((T, past + T), float("-inf")).triu(past + 1)
        found_XNC = self.attention(moved.flatten(0, -3), bias_TM, cache=cache)
        return found_XNC.view(moved.shape).movedim(-2, axis)


class MotionAnchor(nn.Module):
    """What the words mean for each place of the first frame: one cross-attention block."""

    def __init__(self, dim: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.norm_tokens = nn.LayerNorm(dim)
        self.norm_text = nn.LayerNorm(dim)
        self.attention = BiasedAttention(dim, heads)
        self.norm_feed_forward = nn.LayerNorm(dim)
        self.feed_forward = FeedForward(dim, hidden)

    def forward(self, tokens_BggC: Tensor, text: TextTokens) -> Tensor:
        """(B, g, g, C). Padding is masked."""
        bias_B11L = mask_bias(~text.mask_BL)[:, None, None]
        x_BNC = tokens_BggC.flatten(1, 2)
        text_BLC = self.norm_text(text.embeddings_BLC)
        x_BNC = x_BNC + self.attention(self.norm_tokens(x_BNC), bias_B11L, context_XMC=text_BLC)
        x_BNC = x_BNC + self.feed_forward(self.norm_feed_forward(x_BNC))
        return x_BNC.view(tokens_BggC.shape)


class AxialTransformer(nn.Module):
    """Codes and text to scores of the next codes.

    Args:
        grid: codes along a side of a frame.
        text_dim: width of the words; must be `config.dim`.

    Raises:
        ValueError: if sizes do not fit each other.
    """

    def __init__(self, config: AxialConfig, grid: int, codebook_size: int, text_dim: int) -> None:
        super().__init__()
        C, p = config.dim, config.patch
        if grid % p or C % p**2:
            raise ValueError(f"axial.patch={p} does not divide {grid} codes along a side, or its square axial.dim={C}")
        if text_dim != C:
            raise ValueError(f"text.dim is {text_dim}, but must be axial.dim, which is {C}")
        self.config = config
        self.embedding = nn.Embedding(codebook_size, C // p**2)
        nn.init.normal_(self.embedding.weight, std=0.02)
        self.neighbours = nn.Conv2d(C, C, 3, padding=1, bias=False)
        scale = C**-0.5
        self.height_gC = nn.Parameter(scale * torch.randn(grid // p, C))
        self.width_gC = nn.Parameter(scale * torch.randn(grid // p, C))
        self.time_TC = nn.Parameter(scale * torch.randn(config.frames, C))
        self.speed_C = nn.Parameter(scale * torch.randn(C))
        self.anchor = MotionAnchor(C, config.heads, config.hidden)
        self.enter_anchor = nn.Linear(C, C)
        self.enter_frames = nn.Linear(C, C)
        blocks = [AxialBlock(AXES[i % 3], C, config.heads, config.hidden) for i in range(config.layers)]
        for block in blocks:  # what the layers add stays small at first, however many there are
            for weight in (block.attention.out.weight, block.feed_forward.last.weight):
                nn.init.normal_(weight, std=(2 * C * config.layers) ** -0.5)
        self.blocks = nn.ModuleList(blocks)
        self.out = nn.Linear(C, p**2 * codebook_size)
        self.keep = nn.Linear(C, 2 * p**2) if config.copy else None

    def patches(self, codes: Tensor) -> Tensor:
        """Codes (..., h, w) as the codes (..., g, g, P) of each token."""
        p = self.config.patch
        *lead, h, w = codes.shape
        return codes.reshape(*lead, h // p, p, w // p, p).transpose(-3, -2).flatten(-2)

    def frames(self, patches: Tensor) -> Tensor:
        """The inverse of `patches`."""
        p = self.config.patch
        *lead, rows, columns, _ = patches.shape
        return patches.unflatten(-1, (p, p)).transpose(-3, -2).reshape(*lead, rows * p, columns * p)

    def tokens(self, codes_BThw: Tensor) -> Tensor:
        """Codes to tokens (B, T, g, g, C), each mixed with its neighbours and marked with its place."""
        x_BTggC = self.embedding(self.patches(codes_BThw)).flatten(-2)
        mixed_NCgg = self.neighbours(x_BTggC.flatten(0, 1).permute(0, 3, 1, 2))
        x_BTggC = mixed_NCgg.permute(0, 2, 3, 1).unflatten(0, x_BTggC.shape[:2])
        return x_BTggC + self.height_gC[:, None] + self.width_gC

    def start(self, codes_BThw: Tensor, text: TextTokens, speed_B: Tensor) -> Tensor:
        """What the layers read (B, 1 + T, g, g, C): the motion anchor, then the frames; `speed_B` as in `imagine`."""
        tokens_BTggC = self.tokens(codes_BThw)
        anchor_BggC = self.anchor(tokens_BTggC[:, 0], text) + speed_B[:, None, None, None] * self.speed_C
        return torch.cat([self.enter_anchor(anchor_BggC)[:, None], self.enter_frames(tokens_BTggC)], dim=1)

    def layers(self, x_BTggC: Tensor, caches: list[KeyValueCache] | None = None) -> Tensor:
        """The axial layers, from the time step after those in the `caches`, one for each layer along time."""
        begin = caches[0].length if caches else 0
        x_BTggC = x_BTggC + self.time_TC[begin : begin + x_BTggC.shape[1], None, None]
        times = iter(caches or ())
        for block in self.blocks:
            x_BTggC = block(x_BTggC, next(times, None) if block.axis == "time" else None)
        return x_BTggC

    def forward(self, codes_BThw: Tensor, text: TextTokens, speed_B: Tensor) -> Tensor:
        """Scores (B, T, g, g, P, K): from frames 0 to T - 1 those of the codes of frames 1 to T.

        Raises:
            ValueError: unless T is less than `config.frames`: the motion anchor takes one time step.
        """
        T = codes_BThw.shape[1]
        if self.config.frames <= T:
            raise ValueError(f"at most {self.config.frames - 1} frames can be read, not {T}: axial.frames")
        x_BTggC = self.layers(self.start(codes_BThw, text, speed_B))[:, 1:]
        return self.scores(x_BTggC, codes_BThw, codes_BThw[:, :1])

    def scores(self, x_BTggC: Tensor, codes_BThw: Tensor, first_B1hw: Tensor) -> Tensor:
        """(B, T, g, g, P, K) from the layers' output, the codes of these frames, and those of the first frame."""
        P = self.config.patch**2
        scores_BTggPK = self.out(x_BTggC).unflatten(-1, (P, -1))
        if self.keep is None:
            return scores_BTggPK
        bonus_BTggP2 = self.keep(x_BTggC).unflatten(-1, (P, 2)).to(scores_BTggPK.dtype)
        kept = torch.stack([codes_BThw, first_B1hw.expand_as(codes_BThw)], dim=-1)
        kept_BTggP2 = self.patches(kept.movedim(-1, 0)).movedim(0, -1)
        return scores_BTggPK.scatter_add(-1, kept_BTggP2, bonus_BTggP2)

    @torch.no_grad()
    def imagine(self, seen_BThw: Tensor, text: TextTokens, horizon: int, speed_B: Tensor | None = None) -> Tensor:
        """The likeliest codes (B, horizon, h, w) of the frames after T seen ones, each fed back (greedy decoding).

        Args:
            speed_B: episode frames between two frames of the video; 1 by default.

        Raises:
            ValueError: if seen and imagined frames are more than `config.frames`.
        """
        B, T = seen_BThw.shape[:2]
        if horizon < 1 or T + horizon > self.config.frames:
            raise ValueError(
                f"{T} seen and {horizon} imagined frames: at least one of each, at most {self.config.frames} in all"
            )
        along_time = sum(block.axis == "time" for block in self.blocks)
        caches = [KeyValueCache(self.config.frames) for _ in range(along_time)]
        x_BTggC = self.start(seen_BThw, text, self.speed_C.new_ones(B) if speed_B is None else speed_B)
        newest_B1hw, imagined = seen_BThw[:, -1:], []
        for _ in range(horizon):
            scores_B1ggPK = self.scores(self.layers(x_BTggC, caches)[:, -1:], newest_B1hw, seen_BThw[:, :1])
            newest_B1hw = self.frames(scores_B1ggPK.argmax(-1))
            imagined.append(newest_B1hw)
            x_BTggC = self.enter_frames(self.tokens(newest_B1hw))
        return torch.cat(imagined, dim=1)


def code_loss(scores: Tensor, codes: Tensor, weights: Tensor) -> Tensor:
    """The weighted sum of the cross-entropies of scores (..., K) against codes (...)."""
    per_code = F.cross_entropy(scores.float().flatten(0, -2), codes.flatten(), reduction="none")
    return (weights.flatten() * per_code).sum()
