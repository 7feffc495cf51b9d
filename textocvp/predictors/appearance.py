"""Which slot a word speaks of, learned from what moves: no lexicon of colours, no labels.

A caption of CATER names things by size, colour, material and shape, and where there are two alike it may mean either.
Every name is matched with what each slot looks like in the first frame. How surely a word names a slot that acts is
learned, too. Together they say which slots act, which the training clips show: those that move, or are reached by one
that moves; what merely turns counts neither for nor against (a noisy-or over the words, as in learning from bags of
instances, Maron and Lozano-Perez 1998). While the predictor trains, it is told which slots acted, so that a sentence
that fits two things does not teach it to move both by half.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import MASKED, full_precision
from textocvp.slots import SlotLayout, SlotState

PHRASE = 5  # words of the longest name, as in "the large red metal cone"
WIDTH = 64  # of the space in which words and slots are compared
LEAST = -8.0  # logarithm of the share of a word's meaning below which all slots are alike
# What a slot at the right edge loses against one at the left: of two that fit alike one is meant.
LEFT_FIRST = 0.5
UNLIKELY = -6.0  # how much less a word speaks of a slot that is known not to act


class Appearance(nn.Module):
    """Matches words with slots.

    What words say of a thing adds up over the last `PHRASE` words: at "cone", all of "the large red metal cone" counts.
    What is not said anew is said of the thing that was named last: in "the cone is sliding to (1, 2)" the 1 and the 2
    are the cone's. The slots' layout must be explicit.
    """

    def __init__(self, layout: SlotLayout, text_dim: int) -> None:
        super().__init__()
        # Apart from each other, so that what is learned of red things holds for a shape that was never red.
        self.color = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, WIDTH))
        self.size = nn.Sequential(nn.Linear(4, 32), nn.ReLU(), nn.Linear(32, WIDTH))
        self.shape = nn.Sequential(nn.Dropout(0.2), nn.Linear(layout.content + 2, 64), nn.ReLU(), nn.Linear(64, WIDTH))
        self.words = nn.Linear(text_dim, WIDTH)
        self.phrase_P = nn.Parameter(torch.ones(PHRASE))  # weight of a word by how far back it is
        self.names = nn.Linear(text_dim, 1)

    def forward(
        self, content_BKC: Tensor, state: SlotState, words_BLC: Tensor, mask_BL: Tensor, acting_BK: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Which slot each word names, and whether it names one that acts.

        Args:
            content_BKC: of the slots, standardised.
            words_BLC: embeddings of the words, each without the others.
            acting_BK: which slots act, where that is known.

        Returns:
            logarithms of shares (B, K, L), which sum to 1 over the things, and (B, L) in 0..1.
        """
        with full_precision(content_BKC.device):
            scale = state.scale.clamp_min(1e-3).log() + 2
            ratio = scale - scale.mean(-1, keepdim=True)
            looks_BKW = self.color(state.color.float())
            looks_BKW = looks_BKW + self.size(torch.cat([state.position, scale], -1).float())
            looks_BKW = looks_BKW + self.shape(torch.cat([content_BKC, ratio], -1).float())
            words_BLC = words_BLC.float() * mask_BL[..., None]
            said_BLW = self.words(words_BLC) * mask_BL[..., None]
            phrase_BLW = sum(
                weight * F.pad(said_BLW, (0, 0, back, 0))[:, : said_BLW.shape[1]]
                for back, weight in enumerate(self.phrase_P)
            )
            logits_BKL = looks_BKW @ phrase_BLW.transpose(1, 2) / WIDTH**0.5  # type: ignore[union-attr]
            if not self.training:
                logits_BKL = logits_BKL - LEFT_FIRST / 2 * (state.position[..., :1] + 1)
            if acting_BK is not None:
                logits_BKL = logits_BKL + UNLIKELY * (~acting_BK)[..., None]
            logits_BKL = logits_BKL.masked_fill(~state.is_thing, MASKED)
            names_BL = self.names(words_BLC)[..., 0].sigmoid() * mask_BL
            return logits_BKL.log_softmax(1), names_BL

    @staticmethod
    def bias(shares_BKL: Tensor, names_BL: Tensor) -> Tensor:
        """A logit term (B, K, L) for the attention to the words: 0 for the slot that a word speaks of, below 0 else."""
        with full_precision(shares_BKL.device):
            # The chance that what was named last, up to a word, is what another word names.
            left_BL = (1 - names_BL.clamp(max=1 - 1e-4)).log().cumsum(1)
            last_BLL = (left_BL[:, :, None] - left_BL[:, None]).clamp(max=0).exp() * names_BL[:, None]
            last_BLL = last_BLL.tril()
            spoken_BKL = shares_BKL.exp() @ last_BLL.transpose(1, 2)
            sure_BL = last_BLL.sum(-1)
            shares_BKL = (spoken_BKL / sure_BL[:, None].clamp_min(1e-6)).clamp_min(1e-6).log()
            best_B1L = shares_BKL.amax(1, keepdim=True)
            return (shares_BKL - best_B1L).clamp_min(LEAST) * sure_BL[:, None]


def acting_loss(shares_BKL: Tensor, names_BL: Tensor, acting_BK: Tensor, known_BK: Tensor) -> Tensor:
    """Cross-entropy of which slots act by the words against which slots did, a mean over those of which it is known."""
    with full_precision(shares_BKL.device):
        # ln P(does not act)
        left_BK = (1 - (names_BL[:, None] * shares_BKL.exp()).clamp(max=1 - 1e-4)).log().sum(2)
        acts_BK = (1 - left_BK.exp()).clamp_min(1e-6).log()
        loss_BK = -torch.where(acting_BK, acts_BK, left_BK.clamp_min(-14))
        return (loss_BK * known_BK).sum() / known_BK.sum().clamp_min(1)
