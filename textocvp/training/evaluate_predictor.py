"""Does the imagined block end in the named bowl? Measured during training, on held-out episodes.

The simulator's first segmentation says which slot is which thing. That is for measuring only: nothing is
trained on it, and the planner grounds slots by their looks (`planning`)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from textocvp.layers import pixel_grid
from textocvp.model import TextOCVP, evaluating
from textocvp.slots import SlotLayout, SlotState

if TYPE_CHECKING:
    from textocvp.data.episodes import Episode, EpisodeFile
    from textocvp.data.slot_cache import SlotCache


PIXEL = 2 / 64  # the thresholds are for 64x64 frames; in -1..1
REACHED = 6 * PIXEL  # a block that ends closer than this to where the bowl's slot started is in the bowl
MATCHED = 4 * PIXEL  # a slot farther than this from a thing's centroid does not hold it


@dataclass(frozen=True)
class InstructionFollowing:
    """Shares of held-out episodes.

    Attributes:
        original: the block named by the episode's instruction ends in the bowl that it names.
        other_bowl: the same with another bowl of the scene named.
        wrong_text: told to move another block, or into another bowl, the first block still ends in the first
            bowl.
        error_px: median distance between where the named block ends in the rollout and in the episode, pixels
            of 64.
        grounded: both named things have a slot in the first frame (the ceiling of the first two).
        episodes: how many were tried.
    """

    original: float
    other_bowl: float
    wrong_text: float
    error_px: float
    grounded: float
    episodes: int

    def __str__(self) -> str:
        return (
            f"original {self.original:.3f}, other bowl {self.other_bowl:.3f}, "
            f"wrong text {self.wrong_text:.3f}, median error {self.error_px:.2f} px, "
            f"grounded {self.grounded:.3f} ({self.episodes} episodes)"
        )

    def figures(self) -> dict[str, float]:
        """The figures, named for a log."""
        return {
            f"following/{name}": getattr(self, name)
            for name in self.__dataclass_fields__
            if name != "episodes"
        }


@dataclass(frozen=True)
class Thing:
    """A block or a bowl in the first frame of an episode, by the simulator.

    Attributes:
        kind, color: as captions name it.
        place: centroid (x, y) of what is seen of it, -1..1; NaN if it is hidden.
        size: standard deviation (x, y) of it, same unit. A block lies in the middle of its bowl, and only its size
            tells the two apart.
        named: whether the episode's instruction names it.
    """

    kind: str
    color: str
    place: tuple[float, float]
    size: tuple[float, float]
    named: bool


@dataclass(frozen=True)
class Question:
    """One scene: which slots its named things are in (-1: in none), and three sentences about it.

    Attributes:
        block, bowl, other_bowl: slots. Without another bowl in the scene `other_bowl` is None, and so is
            `other`.
        original, other, wrong: sentences: the episode's own; the block into the other bowl; something else,
            if there is.
    """

    block: int
    bowl: int
    other_bowl: int | None
    original: str
    other: str | None
    wrong: str | None


def things_of(episode: Episode) -> list[Thing]:
    """The blocks and bowls in the first frame of an episode."""
    labels_HW = episode.segmentation[0]
    grid_HW2 = pixel_grid(*labels_HW.shape).numpy()
    things = []
    for item in episode.objects:
        mask_HW = labels_HW == 2 + item.id
        seen_N2 = grid_HW2[mask_HW] if mask_HW.any() else np.full((1, 2), math.nan)
        (x, y), (wide, high) = seen_N2.mean(axis=0).tolist(), seen_N2.std(axis=0).tolist()
        things.append(Thing(item.kind, item.color, (x, y), (wide, high), item.id in episode.target))
    return things


def following_questions(
    cache: SlotCache, episodes: EpisodeFile, layout: SlotLayout, seed: int = 0
) -> list[Question]:
    """A question about each of the cache's episodes."""
    rng = np.random.default_rng(seed)
    return [ask(things_of(episodes.episode(i)), cache.episode(i)[0], layout, rng) for i in range(len(cache))]


def ask(things: Sequence[Thing], slots_KD: Tensor, layout: SlotLayout, rng: np.random.Generator) -> Question:
    """The question that a scene allows.

    Args:
        things: what the simulator says is there.
        slots_KD: the slots of the first frame.
        layout: what their numbers mean.
        rng: picks the other bowl and the wrong sentence.
    """
    state = SlotState.split(slots_KD, layout)
    is_thing_K = state.is_thing[:, 0]

    def slot(thing: Thing) -> int:
        off_K = (state.position - torch.tensor(thing.place)).norm(dim=-1)
        other_size_K = (state.scale - torch.tensor(thing.size)).norm(dim=-1)
        cost_K = (off_K + other_size_K).masked_fill(~is_thing_K | ~(off_K < MATCHED), math.inf)
        return int(cost_K.argmin()) if cost_K.isfinite().any() else -1

    def sentence(block: Thing, bowl: Thing) -> str:
        return f"put the {block.color} block in the {bowl.color} bowl"

    blocks = [thing for thing in things if thing.kind == "block"]
    bowls = [thing for thing in things if thing.kind == "bowl"]
    block, bowl = (next(thing for thing in group if thing.named) for group in (blocks, bowls))
    others = [thing for thing in bowls if thing is not bowl]
    other = others[rng.integers(len(others))] if others else None
    wrong = [sentence(a, b) for a in blocks for b in bowls if a is not block or b is not bowl]
    return Question(
        block=slot(block),
        bowl=slot(bowl),
        other_bowl=None if other is None else slot(other),
        original=sentence(block, bowl),
        other=None if other is None else sentence(block, other),
        wrong=wrong[rng.integers(len(wrong))] if wrong else None,
    )


class FollowingTest:
    """Held-out scenes and the questions about them.

    Args:
        slots_ETKD: true slots of whole episodes, padded with their last frame.
        questions: one an episode.
        layout: what the numbers of a slot mean.
        batch: rollouts at a time.
    """

    def __init__(
        self, slots_ETKD: Tensor, questions: Sequence[Question], layout: SlotLayout, batch: int = 64
    ) -> None:
        self.slots_ETKD, self.questions, self.layout, self.batch = slots_ETKD, list(questions), layout, batch

    def measure(self, model: TextOCVP, episodes: int | None = None) -> InstructionFollowing:
        """Imagine the first `episodes` (default: all) and see where the named blocks end."""
        asked = self.questions[:episodes]
        everyone = range(len(asked))
        other = [i for i in everyone if asked[i].other is not None]
        wrong = [i for i in everyone if asked[i].wrong is not None]
        ends = self._ends(model, everyone, [question.original for question in asked])
        ends_other = self._ends(model, other, [asked[i].other or "" for i in other])
        ends_wrong = self._ends(model, wrong, [asked[i].wrong or "" for i in wrong])
        errors = [
            float((ends[i][asked[i].block] - self._place(i, -1, asked[i].block)).norm())
            for i in everyone
            if asked[i].block >= 0
        ]
        return InstructionFollowing(
            original=_share(self._reached(i, ends[i], asked[i].bowl) for i in everyone),
            other_bowl=_share(self._reached(i, ends_other[i], asked[i].other_bowl) for i in other),
            wrong_text=_share(self._reached(i, ends_wrong[i], asked[i].bowl) for i in wrong),
            error_px=float(np.median(errors)) / PIXEL if errors else math.nan,
            grounded=_share(question.block >= 0 and question.bowl >= 0 for question in asked),
            episodes=len(asked),
        )

    @torch.no_grad()
    def _ends(self, model: TextOCVP, episodes: Sequence[int], sentences: Sequence[str]) -> dict[int, Tensor]:
        """Where the slots of the episodes end, (K, 2) each, when told the sentences."""
        ends: dict[int, Tensor] = {}
        steps = self.slots_ETKD.shape[1] - 1
        for at in range(0, len(episodes), self.batch):
            chosen = list(episodes[at : at + self.batch])
            seed = self.slots_ETKD[chosen, :1].to(model.device)
            with evaluating(model):
                text = model.text(sentences[at : at + self.batch])
                imagined = model.predictor.rollout(seed, text, steps)
            last = SlotState.split(imagined.slots_BSKD[:, -1].float().cpu(), self.layout)
            ends.update(zip(chosen, last.position, strict=True))
        return ends

    def _place(self, episode: int, frame: int, slot: int) -> Tensor:
        return SlotState.split(self.slots_ETKD[episode, frame, slot], self.layout).position

    def _reached(self, episode: int, ends_K2: Tensor, bowl: int | None) -> bool:
        block = self.questions[episode].block
        if block < 0 or bowl is None or bowl < 0:
            return False
        return float((ends_K2[block] - self._place(episode, 0, bowl)).norm()) < REACHED


def _share(outcomes: Iterable[bool]) -> float:
    values = list(outcomes)
    return sum(values) / len(values) if values else math.nan
