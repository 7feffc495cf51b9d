"""Does the imagined object end where the sentence says? Measured on held-out episodes, whose questions are asked.

The first frame's true masks say which slot holds which object; nothing is trained on that. Episodes without masks or
questions, and slots without explicit places, are measured by how far imagined slots are from parsed ones. A predictor
of whole sentences is measured by how often everything ends where it should.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from textocvp.data.cache import FrameCache
from textocvp.data.episodes import Episodes, Question
from textocvp.data.slot_batches import padded
from textocvp.layers import pixel_grid
from textocvp.metrics.intervals import Interval, bootstrap_interval
from textocvp.model import TextOCVP, evaluating
from textocvp.predictors.base import SlotPredictor
from textocvp.slots import SlotLayout, SlotState
from textocvp.training.losses import MOVES
from textocvp.training.run import Metrics

PIXEL = 2 / 64  # the thresholds are for 64x64 frames; in -1..1
REACHED = 6 * PIXEL  # an object that ends closer than this to where the other's slot started is at it
RIGHT = 3 * PIXEL  # a slot that is foreseen to end closer than this to where it ends is foreseen
MATCHED = 4 * PIXEL  # a slot farther than this from an object's centroid does not hold it
BATCH = 64  # rollouts at a time

NO_QUESTIONS = "the held-out episodes have no masks and questions: no instruction following"
NO_PLACES = "slots have no explicit places: no instruction following"


@dataclass(frozen=True)
class InstructionFollowing(Metrics):
    """Shares of held-out episodes."""

    group: ClassVar[str] = "following"

    original: float  # the object that the episode's instruction moves ends where the instruction says
    other_target: float  # the same with a sentence that moves the same object to another one
    wrong_text: float  # given any other sentence, the first object still ends where the instruction says
    error_px: float  # median distance between where that object ends in the rollout and in the episode, pixels of 64
    grounded: float  # both objects of the instruction have a slot in the first frame (the ceiling of the first two)
    episodes: int  # how many were tried

    def __str__(self) -> str:
        return (
            f"original {self.original:.3f}, other target {self.other_target:.3f}, "
            f"wrong text {self.wrong_text:.3f}, median error {self.error_px:.2f} px, "
            f"grounded {self.grounded:.3f} ({self.episodes} episodes)"
        )


@dataclass(frozen=True)
class SlotErrors(Metrics):
    """How far imagined slots are from parsed ones, a mean over episodes with its 95 % bootstrap interval."""

    # Distance of the places of slots that move, pixels of 64; without explicit places the root mean square error
    # of all numbers of all slots. None where nothing moves.
    error: Interval | None
    still_error: Interval | None  # what it would be if nothing moved
    left_out: str  # why instruction following was not measured

    def __str__(self) -> str:
        return f"slot error {self.error}, if nothing moved {self.still_error} ({self.left_out})"


@dataclass(frozen=True)
class Outcomes(Metrics):
    """How well the ends of sentences are foreseen from their beginnings."""

    group: ClassVar[str] = "outcomes"

    right: float  # share of held-out episodes in which every slot ends where it should
    error_px: float  # median distance of slots that move from where they end, pixels of 64
    episodes: int  # how many were tried

    def __str__(self) -> str:
        return f"all ends right {self.right:.3f}, median error {self.error_px:.2f} px ({self.episodes} episodes)"


@dataclass(frozen=True)
class Trial:
    """A sentence for an episode, the slot that should move, and that at which it should end; -1 if there is none."""

    episode: int
    text: str
    moves: int
    ends_at: int


@dataclass(frozen=True)
class Trials:
    """What is asked of the held-out episodes: at most one trial of each kind an episode; see `InstructionFollowing`."""

    original: list[Trial] = field(default_factory=list)
    other_target: list[Trial] = field(default_factory=list)
    wrong_text: list[Trial] = field(default_factory=list)

    def add(
        self,
        episode: int,
        played: Question,
        questions: Sequence[Question],
        slot_of: Mapping[int, int],
        rng: np.random.Generator,
    ) -> None:
        """Add what a scene allows. `slot_of` is the slot that holds each object, by the object's id; -1 for none."""
        moves, ends_at = slot_of[played.moves], slot_of[played.ends_at]
        self.original.append(Trial(episode, played.text, moves, ends_at))
        elsewhere = [q for q in questions if q.moves == played.moves and q.ends_at != played.ends_at]
        if elsewhere:
            other = elsewhere[rng.integers(len(elsewhere))]
            self.other_target.append(Trial(episode, other.text, moves, slot_of[other.ends_at]))
        wrong = [q for q in questions if q != played]
        if wrong:
            text = wrong[rng.integers(len(wrong))].text
            self.wrong_text.append(Trial(episode, text, moves, ends_at))


@dataclass(frozen=True)
class HeldOut:
    """Held-out episodes as true slots, padded with their last frame, and what is asked of them, if anything can be."""

    slots_ETKD: Tensor
    instructions: tuple[str, ...]
    layout: SlotLayout
    trials: Trials

    @classmethod
    def of(cls, episodes: Episodes, slots: FrameCache, layout: SlotLayout, frames: int, every: int = 1) -> HeldOut:
        """Held-out episodes at a length of so many frames, counting every `every`-th."""
        rng, trials = np.random.default_rng(0), Trials()
        for index in range(len(episodes)) if layout.explicit else ():
            truth = episodes.truth(index)
            played = truth and truth.question(episodes.instructions[index])
            if truth is None or truth.segmentation is None or not played:
                continue
            state = SlotState.split(torch.from_numpy(slots.episode(index)[0].astype(np.float32)), layout)
            slot_of = {
                item.id: slot_at(state, *place_and_size(truth.segmentation[0] == item.label)) for item in truth.objects
            }
            trials.add(index, played, truth.questions, slot_of, rng)
        return cls(padded(slots, frames, every).float(), episodes.instructions, layout, trials)

    @property
    def file(self) -> str:
        """What the file of the figures is called."""
        return "following.json" if self.trials.original else "slot_errors.json"

    def measure(self, model: TextOCVP, count: int | None = None) -> InstructionFollowing | SlotErrors:
        """Figures of the first `count` episodes (default: all)."""
        return (_following if self.trials.original else _slot_errors)(model, self, count)


def measure_outcomes(model: TextOCVP, held: HeldOut, count: int | None = None) -> Outcomes:
    """Figures of `model.outcome` on the first `count` episodes (default: all), each given as its first and last frame.

    Raises:
        ValueError: if slots have no explicit places.
    """
    if not held.layout.explicit:
        raise ValueError(f"{NO_PLACES}, and so none of the ends of sentences")
    true_E2KD = held.slots_ETKD[:count]
    foreseen = _imagine(model, true_E2KD, held.instructions[:count], model.outcome)
    foreseen_EKD = torch.cat(list(foreseen))
    true = SlotState.split(true_E2KD, held.layout)
    position_EK2 = SlotState.split(foreseen_EKD, held.layout).position
    error_EK = (position_EK2 - true.position[:, 1]).norm(dim=-1)
    thing_EK = true.is_thing[:, 0, :, 0]
    moves_EK = thing_EK & ((true.position[:, 1] - true.position[:, 0]).norm(dim=-1) > MOVES)
    right_E = (error_EK < RIGHT) | ~thing_EK
    errors = error_EK[moves_EK].numpy() / PIXEL
    error_px = float(np.median(errors)) if len(errors) else math.nan
    return Outcomes(_share(right_E.all(1).tolist()), error_px, len(right_E))


def place_and_size(mask_HW: np.ndarray) -> tuple[Tensor, Tensor]:
    """Centroid and standard deviation (x, y) of a mask, -1..1; NaN if it is empty."""
    grid_HW2 = pixel_grid(*mask_HW.shape).numpy()
    seen_N2 = grid_HW2[mask_HW] if mask_HW.any() else np.full((1, 2), math.nan, np.float32)
    return torch.from_numpy(seen_N2.mean(axis=0)), torch.from_numpy(seen_N2.std(axis=0))


def slot_at(state: SlotState, place_2: Tensor, size_2: Tensor) -> int:
    """The slot of a frame that is of this place and size; -1 if there is none close enough."""
    # An object may lie in the middle of another, and only its size tells the two apart.
    off_K = (state.position - place_2).norm(dim=-1)
    other_size_K = (state.scale - size_2).norm(dim=-1)
    cost_K = (off_K + other_size_K).masked_fill(~state.is_thing[:, 0] | ~(off_K < MATCHED), math.inf)
    return int(cost_K.argmin()) if cost_K.isfinite().any() else -1


def _following(model: TextOCVP, held: HeldOut, count: int | None) -> InstructionFollowing:
    """Imagine the trials and see where the objects end."""
    places_ETK2 = SlotState.split(held.slots_ETKD, held.layout).position
    shares: dict[str, float] = {}
    errors: list[float] = []
    both_found: list[bool] = []
    for kind, trials in vars(held.trials).items():
        asked = [trial for trial in trials if count is None or trial.episode < count]
        slots_NTKD = held.slots_ETKD[[trial.episode for trial in asked]]
        reached = []
        imagined = _imagine(model, slots_NTKD, [trial.text for trial in asked])
        for trial, imagined_SKD in zip(asked, imagined, strict=True):
            ends_K2, true_TK2 = SlotState.split(imagined_SKD[-1], held.layout).position, places_ETK2[trial.episode]
            found = trial.moves >= 0 and trial.ends_at >= 0
            away = float((ends_K2[trial.moves] - true_TK2[0, trial.ends_at]).norm())
            reached.append(found and away < REACHED)
            if kind == "original":
                both_found.append(found)
                if trial.moves >= 0:
                    errors.append(float((ends_K2[trial.moves] - true_TK2[-1, trial.moves]).norm()))
        shares[kind] = _share(reached)
    error_px = float(np.median(errors)) / PIXEL if errors else math.nan
    return InstructionFollowing(**shares, error_px=error_px, grounded=_share(both_found), episodes=len(both_found))


def _slot_errors(model: TextOCVP, held: HeldOut, count: int | None) -> SlotErrors:
    """Imagine the episodes with their own sentences, and compare with the true slots."""
    errors, still_errors = [], []
    slots_ETKD = held.slots_ETKD[:count]
    imagined = _imagine(model, slots_ETKD, held.instructions[:count])
    for true_TKD, imagined_SKD in zip(slots_ETKD, imagined, strict=True):
        errors.append(_slot_error(imagined_SKD, true_TKD, held.layout))
        still_errors.append(_slot_error(true_TKD[:1].expand_as(imagined_SKD), true_TKD, held.layout))
    left_out = NO_QUESTIONS if held.layout.explicit else NO_PLACES
    if np.isnan(errors).all():
        return SlotErrors(None, None, left_out)
    return SlotErrors(bootstrap_interval(errors), bootstrap_interval(still_errors), left_out)


def _slot_error(imagined_SKD: Tensor, true_TKD: Tensor, layout: SlotLayout) -> float:
    """See `SlotErrors.error`; NaN where nothing moves."""
    if not layout.explicit:
        return float((imagined_SKD - true_TKD[1:]).square().mean().sqrt())
    true, imagined = SlotState.split(true_TKD, layout), SlotState.split(imagined_SKD, layout)
    moves_K = ((true.position - true.position[:1]).norm(dim=-1) > MOVES).any(dim=0) & true.is_thing[0, :, 0]
    return float((imagined.position - true.position[1:]).norm(dim=-1)[:, moves_K].mean()) / PIXEL


@torch.no_grad()
def _imagine(
    model: TextOCVP, slots_NTKD: Tensor, sentences: Sequence[str], predictor: SlotPredictor | None = None
) -> Iterator[Tensor]:
    """The slots (T - 1, K, D) that follow each first frame, imagined by the model's predictor or another."""
    predictor = predictor or model.predictor
    for at in range(0, len(sentences), BATCH):
        first_B1KD = slots_NTKD[at : at + BATCH, :1].to(model.device)
        with evaluating(model):
            text = model.text(sentences[at : at + BATCH])
            rollout = predictor.rollout(first_B1KD, text, slots_NTKD.shape[1] - 1)
        yield from rollout.slots_BSKD.float().cpu()


def _share(outcomes: Sequence[bool]) -> float:
    return sum(outcomes) / len(outcomes) if outcomes else math.nan
