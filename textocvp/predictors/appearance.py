"""Which slot a word speaks of, learned from what moves: no lexicon of colours, no labels.

A caption of CATER names things by size, colour, material and shape, and where there are two alike it may mean either.
Every word (with its neighbours in mind, as the text encoder gives it) is matched with what each slot looks like in the
first frame. How surely a word speaks of a slot that acts is learned, too. Together they say which slots act, which the
training clips show: those that move, turn, or are reached by one that moves (a noisy-or over the words, as in learning
from bags of instances, Maron and Lozano-Perez 1998). While the predictor trains, it is told which slots acted, so that
a sentence that fits two things does not teach it to move both by half.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from textocvp.layers import MASKED, full_precision
from textocvp.slots import SlotLayout, SlotState

WIDTH = 64  # of the space in which words and slots are compared
LEAST = -8.0  # logarithm of the share of a word's meaning below which all slots are alike
# What a slot at the right edge loses against one at the left: of two that fit alike one is meant.
LEFT_FIRST = 0.5
UNLIKELY = -6.0  # how much less a word speaks of a slot that is known not to act


class Appearance(nn.Module):
    """Matches words with slots.

    Args:
        layout: of the slots, which must be explicit.
        text_dim: width of a word's embedding.
    """

    def __init__(self, layout: SlotLayout, text_dim: int) -> None:
        super().__init__()
        self.looks = nn.Sequential(nn.Linear(layout.content + 7, 128), nn.ReLU(), nn.Linear(128, WIDTH))
        self.norm = nn.LayerNorm(text_dim, eps=1e-6)
        self.words = nn.Linear(text_dim, WIDTH)
        self.acts = nn.Linear(text_dim, 1)

    def forward(
        self,
        content_BKC: Tensor,
        state: SlotState,
        embeddings_BLC: Tensor,
        mask_BL: Tensor,
        acting_BK: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Of which slot each word speaks, and whether of one that acts.

        Args:
            content_BKC: of the slots, standardised.
            state: of the slots.
            acting_BK: which slots act, where that is known.

        Returns:
            logarithms of shares (B, K, L), which sum to 1 over the things, and (B, L) in 0..1.
        """
        with full_precision(content_BKC.device):
            looks = [content_BKC, state.color, state.position, state.scale.clamp_min(1e-3).log() + 2]
            looks_BKW = self.looks(torch.cat(looks, -1).float())
            words_BLC = self.norm(embeddings_BLC.float())
            logits_BKL = looks_BKW @ self.words(words_BLC).transpose(1, 2) / WIDTH**0.5
            if not self.training:
                logits_BKL = logits_BKL - LEFT_FIRST / 2 * (state.position[..., :1] + 1)
            if acting_BK is not None:
                logits_BKL = logits_BKL + UNLIKELY * (~acting_BK)[..., None]
            logits_BKL = logits_BKL.masked_fill(~state.is_thing, MASKED)
            acts_BL = self.acts(words_BLC)[..., 0].sigmoid() * mask_BL
            return logits_BKL.log_softmax(1), acts_BL

    @staticmethod
    def bias(shares_BKL: Tensor, acts_BL: Tensor) -> Tensor:
        """A logit term (B, K, L) for the attention to the words: 0 for the slot that a word speaks of, below 0 else."""
        best_B1L = shares_BKL.amax(1, keepdim=True)
        return (shares_BKL - best_B1L).clamp_min(LEAST) * acts_BL[:, None]


def acting_loss(shares_BKL: Tensor, acts_BL: Tensor, acting_BK: Tensor, things_BK: Tensor) -> Tensor:
    """Cross-entropy, a mean over things, of which slots act by the words against which slots did."""
    with full_precision(shares_BKL.device):
        left_BK = (
            (1 - (acts_BL[:, None] * shares_BKL.exp()).clamp(max=1 - 1e-4)).log().sum(2)
        )  # ln P(does not act)
        acts_BK = (1 - left_BK.exp()).clamp_min(1e-6).log()
        loss_BK = -torch.where(acting_BK, acts_BK, left_BK.clamp_min(-14))
        return (loss_BK * things_BK).sum() / things_BK.sum().clamp_min(1)
