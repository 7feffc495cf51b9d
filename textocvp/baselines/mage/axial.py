"""The second half of MAGE: codes of the frames so far, and text, to codes of the next frame.

"Make It Move" (CVPR 2022), sections 3.3 and 3.4. The motion anchor is one cross-attention block from the tokens of the
first frame to the words. It stands at time step 0, the frames follow; six axial layers, causal in time; from what they
say at each frame a linear layer scores the codes of the next. All codes of a frame are predicted at once.

Shape suffixes: B videos, T frames, h and w codes along a side of a frame, g tokens along a side, P codes of a token,
C width, K codes in the codebook, L words.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.baselines.mage.attention import AXES, AxialBlock, BiasedAttention, FeedForward
from textocvp.baselines.mage.config import AxialConfig
from textocvp.layers import MASKED, KeyValueCache
from textocvp.text.base import TextTokens


class MotionAnchor(nn.Module):
    """What the words say to each place of the first frame: cross-attention, then a feed-forward net."""

    def __init__(self, dim: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.norm_tokens = nn.LayerNorm(dim)
        self.norm_text = nn.LayerNorm(dim)
        self.attention = BiasedAttention(dim, heads)
        self.norm_feed_forward = nn.LayerNorm(dim)
        self.feed_forward = FeedForward(dim, hidden)

    def forward(self, tokens_BggC: Tensor, text: TextTokens) -> Tensor:
        """(B, g, g, C). Words that are padding are not heard."""
        bias_B11L = torch.zeros_like(text.mask_BL, dtype=tokens_BggC.dtype).masked_fill(~text.mask_BL, MASKED)
        x_BNC = tokens_BggC.flatten(1, 2)
        x_BNC = x_BNC + self.attention(
            self.norm_tokens(x_BNC),
            bias_B11L[:, None, None],
            context_XMC=self.norm_text(text.embeddings_BLC),
        )
        x_BNC = x_BNC + self.feed_forward(self.norm_feed_forward(x_BNC))
        return x_BNC.view(tokens_BggC.shape)


class AxialTransformer(nn.Module):
    """Codes and text to scores of the codes to come.

    Args:
        config: sizes.
        grid: codes along a side of a frame.
        codebook_size: how many codes there are.
        text_dim: width of the words; must be `config.dim`.

    Raises:
        ValueError: if sizes do not fit each other.
    """

    def __init__(self, config: AxialConfig, grid: int, codebook_size: int, text_dim: int) -> None:
        super().__init__()
        C, p = config.dim, config.patch
        if grid % p or C % p**2:
            raise ValueError(
                f"axial.patch={p} does not divide {grid} codes along a side, or its square axial.dim={C}"
            )
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
        """Codes to tokens (B, T, g, g, C), each aware of its neighbours and of where it is."""
        x_BTggC = self.embedding(self.patches(codes_BThw)).flatten(-2)
        B, T = x_BTggC.shape[:2]
        mixed_NCgg = self.neighbours(x_BTggC.flatten(0, 1).permute(0, 3, 1, 2))
        x_BTggC = mixed_NCgg.permute(0, 2, 3, 1).unflatten(0, (B, T))
        return x_BTggC + self.height_gC[:, None] + self.width_gC

    def start(self, first_BggC: Tensor, text: TextTokens, speed_B: Tensor) -> Tensor:
        """The motion anchor (B, 1, g, g, C), as the layers read it.

        Args:
            first_BggC: `tokens` of the first frame.
            speed_B: episode frames between two frames of the video.
        """
        anchor_BggC = self.anchor(first_BggC, text) + speed_B[:, None, None, None] * self.speed_C
        return self.enter_anchor(anchor_BggC)[:, None]

    def layers(self, x_BTggC: Tensor, caches: list[KeyValueCache] | None = None) -> Tensor:
        """The axial layers, from the time step after those in the `caches`, one for each layer along time."""
        begin = caches[0].length if caches else 0
        T = x_BTggC.shape[1]
        x_BTggC = x_BTggC + self.time_TC[begin : begin + T, None, None]
        times = iter(caches or ())
        for block in self.blocks:
            x_BTggC = block(x_BTggC, next(times, None) if block.axis == "time" else None)
        return x_BTggC

    def forward(self, codes_BThw: Tensor, text: TextTokens, speed_B: Tensor) -> Tensor:
        """Scores (B, T, g, g, P, K): from frames 0 to T - 1 those of the codes of frames 1 to T.

        Raises:
            ValueError: if there are as many frames as there are time steps, or more: the motion anchor takes one.
        """
        T = codes_BThw.shape[1]
        if self.config.frames <= T:
            raise ValueError(f"at most {self.config.frames - 1} frames can be read, not {T}: axial.frames")
        tokens_BTggC = self.tokens(codes_BThw)
        anchor_B1ggC = self.start(tokens_BTggC[:, 0], text, speed_B)
        x_BTggC = self.layers(torch.cat([anchor_B1ggC, self.enter_frames(tokens_BTggC)], dim=1))[:, 1:]
        return self.scores(x_BTggC, codes_BThw, codes_BThw[:, :1])

    def scores(self, x_BTggC: Tensor, codes_BThw: Tensor, first_B1hw: Tensor) -> Tensor:
        """(B, T, g, g, P, K) from what the layers say, the codes of these frames, and those of the first frame."""
        P = self.config.patch**2
        scores_BTggPK = self.out(x_BTggC).unflatten(-1, (P, -1))
        if self.keep is None:
            return scores_BTggPK
        bonus_BTggP2 = self.keep(x_BTggC).unflatten(-1, (P, 2)).to(scores_BTggPK.dtype)
        kept = torch.stack([codes_BThw, first_B1hw.expand_as(codes_BThw)], dim=-1)
        kept_BTggP2 = self.patches(kept.movedim(-1, 0)).movedim(0, -1)
        return scores_BTggPK.scatter_add(-1, kept_BTggP2, bonus_BTggP2)

    @torch.no_grad()
    def imagine(
        self,
        seen_BThw: Tensor,
        text: TextTokens,
        horizon: int,
        speed_B: Tensor | None = None,
        *,
        use_cache: bool = True,
    ) -> Tensor:
        """The likeliest codes (B, horizon, h, w) of the frames after the seen ones, each fed back (greedy decoding).

        Args:
            seen_BThw: true codes, T frames from the first one on.
            speed_B: episode frames between two frames; 1 by default.
            use_cache: keep keys and values of past frames; without it they are computed again at every step (slower,
                the same up to rounding; for checks).

        Raises:
            ValueError: if seen and imagined frames are more than `config.frames`.
        """
        B, T = seen_BThw.shape[:2]
        if horizon < 1 or T + horizon > self.config.frames:
            raise ValueError(
                f"{T} seen and {horizon} imagined frames: at least one of each, at most {self.config.frames} in all"
            )
        if speed_B is None:
            speed_B = self.speed_C.new_ones(B)
        if not use_cache:
            codes_BThw = seen_BThw
            for _ in range(horizon):
                scores_BggPK = self(codes_BThw, text, speed_B)[:, -1]
                codes_BThw = torch.cat([codes_BThw, self.frames(scores_BggPK.argmax(-1))[:, None]], dim=1)
            return codes_BThw[:, T:]
        along_time = sum(block.axis == "time" for block in self.blocks)
        caches = [KeyValueCache(self.config.frames) for _ in range(along_time)]
        tokens_BTggC = self.tokens(seen_BThw)
        anchor_B1ggC = self.start(tokens_BTggC[:, 0], text, speed_B)
        x_BTggC = torch.cat([anchor_B1ggC, self.enter_frames(tokens_BTggC)], dim=1)
        newest_B1hw, imagined = seen_BThw[:, -1:], []
        for _ in range(horizon):
            scores_B1ggPK = self.scores(self.layers(x_BTggC, caches)[:, -1:], newest_B1hw, seen_BThw[:, :1])
            newest_B1hw = self.frames(scores_B1ggPK.argmax(-1))
            imagined.append(newest_B1hw)
            x_BTggC = self.enter_frames(self.tokens(newest_B1hw))
        return torch.cat(imagined, dim=1)


def code_loss(scores: Tensor, codes: Tensor, weights: Tensor) -> Tensor:
    """The weighted sum of the cross-entropies of scores (..., K) against codes (...), each weighing `weights` (...)."""
    per_code = F.cross_entropy(scores.float().flatten(0, -2), codes.flatten(), reduction="none")
    return (weights.flatten() * per_code).sum()
