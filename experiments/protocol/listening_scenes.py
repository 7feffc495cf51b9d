"""Which slots listen to which words, scene by scene."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast

import numpy as np
import torch

from experiments.protocol.arguments import UsageError
from experiments.protocol.listening import Heard, hear, named_most
from experiments.protocol.predicted import HORIZON
from experiments.protocol.scenes import Drawn, TestScene, draw, wrong_text
from experiments.protocol.words import merge_words
from experiments.protocol.workers import StudyModel, Worker
from planning import (
    THRESHOLDS,
    Grounding,
    GroundingError,
    Instruction,
    PinholeCamera,
    Thing,
    ground,
    ground_privileged,
)
from textocvp import Rollout, WorldModel
from textocvp.predictors.textocvp import color_match
from textocvp.slots import SlotState


class Listens(StudyModel, Protocol):
    """A world model whose attention to the words can be read."""

    def words(self, text: str) -> list[str]:
        """What the last axis of the attention stands for."""
        ...

    def rollout(
        self, obs: Rollout, text: Sequence[str], *, horizon: int = 24, seed: int = 0, attention: bool = False
    ) -> Rollout: ...


@dataclass(frozen=True, eq=False)
class ListeningOutcome:
    """One scene, its own instruction and its variants.

    Attributes:
        scene, texts: V texts.
        heard: V, slots named by the simulator's segmentation of the first frame, for measuring only.
        by_looks_VR: as `Heard.most_R`, slots named by their appearance.
        silent: as `heard`, of the model without its colour-matching term; empty if it has none.
        colors_VR: as `Heard.most_R`, of the colour-matching term alone, without any network; None if there is none.
        wrong_R: whether the things that the scene's own instruction names attend most under a sentence that names
            others: nan where it must name the same.
        wrong_ends: whether under that sentence the block still ends in the first bowl.
    """

    scene: TestScene
    texts: tuple[str, ...]
    heard: tuple[Heard, ...]
    by_looks_VR: np.ndarray
    silent: tuple[Heard, ...]
    colors_VR: np.ndarray | None
    wrong_R: np.ndarray
    wrong_ends: bool


@dataclass(frozen=True)
class ListeningScene:
    """A unit of work: imagine one scene under its texts, and read the attention.

    Attributes:
        scene: where. variants: how many other target bowls are named as well. seed: of the slots.
    """

    scene: TestScene
    variants: int
    seed: int

    def run(self, worker: Worker) -> ListeningOutcome:
        """Imagine, name the slots, read."""
        model = cast(Listens, worker.world_model)
        drawn = draw(worker.environment(self.scene), self.scene, self.variants)
        own = [Instruction.parse(text) for text in drawn.texts]
        wrong = wrong_text(drawn)
        parsed = model.parse(drawn.observation["rgb"][None], seed=self.seed)
        truth = ground_privileged(parsed, drawn.info["segmentation"], drawn.info["objects"])[0]
        present_K = parsed.presence[0, 0].numpy() >= 0.5
        texts = [*drawn.texts, wrong]
        attention, rollout = attention_to_words(model, parsed, texts, self.seed)
        heard = [
            hear(a, present_K, truth, i, ends_in_bowl(rollout, b, truth, i))
            for b, (a, i) in enumerate(zip(attention, own, strict=False))
        ]
        looks = _looks(parsed, drawn, own)
        by_looks_VR = np.array(
            [named_most(a.mean((0, 1, 2)), looks, i, present_K) for a, i in zip(attention, own, strict=False)]
        )
        misnamed = hear(
            attention[-1], present_K, _renamed(truth, own[0], wrong), Instruction.parse(wrong), False
        )
        differs_R = [
            own[0].block != Instruction.parse(wrong).block,
            own[0].bowl != Instruction.parse(wrong).bowl,
        ]
        silent_model = without_color_match(worker.world_model)
        silent: list[Heard] = []
        colors_VR = None
        if silent_model is not None:
            attention, muted = attention_to_words(
                cast(Listens, silent_model), parsed, list(drawn.texts), self.seed
            )
            silent = [
                hear(a, present_K, truth, i, ends_in_bowl(muted, b, truth, i))
                for b, (a, i) in enumerate(zip(attention, own, strict=True))
            ]
            colors_VR = _colors_alone(cast(WorldModel, worker.world_model), parsed, drawn, truth, present_K)
        return ListeningOutcome(
            scene=self.scene,
            texts=drawn.texts,
            heard=tuple(heard),
            by_looks_VR=by_looks_VR,
            silent=tuple(silent),
            colors_VR=colors_VR,
            wrong_R=np.where(differs_R, misnamed.most_R, np.nan),
            wrong_ends=ends_in_bowl(rollout, len(own), truth, own[0]),
        )


def attention_to_words(
    model: Listens, parsed: Rollout, texts: Sequence[str], seed: int
) -> tuple[list[np.ndarray], Rollout]:
    """Imagine, and merge each rollout's attention (T, n, h, K, W) to the words of `TEMPLATE`.

    Raises:
        UsageError: if the model hears no text.
    """
    horizon = min(HORIZON, model.longest_horizon or HORIZON)
    try:
        rollout = model.rollout(parsed, list(texts), horizon=horizon, seed=seed, attention=True)
    except ValueError as error:
        raise UsageError(f"{model.checkpoint.name}: {error}") from error
    if rollout.attention is None:
        raise UsageError(f"{model.checkpoint.name} keeps no attention from slots to words: it hears no text")
    attention = rollout.attention.double().cpu().numpy()
    return [
        merge_words(one, model.words(text), text) for one, text in zip(attention, texts, strict=True)
    ], rollout


def ends_in_bowl(rollout: Rollout, index: int, grounding: Grounding, told: Instruction) -> bool:
    """Whether the named block's slot ends near where the named bowl's slot was, for one rollout of a batch."""
    block, bowl = (grounding.things.get(thing, ()) for thing in (told.block_thing, told.bowl_thing))
    if not block or not bowl:
        return False
    places_TK2 = rollout.select(index).positions[0]
    apart = places_TK2[-1, list(block)].mean(0) - places_TK2[0, list(bowl)].mean(0)
    return float(apart.norm()) <= THRESHOLDS.block_bowl_px


def without_color_match(model: object) -> WorldModel | None:
    """A copy of a model whose attention has lost the term that compares colours; None if it never had one."""
    if not isinstance(model, WorldModel):
        return None
    silent = copy.deepcopy(model.model)
    gains = [gain for name, gain in silent.predictor.named_parameters() if name.endswith("color_gain_h")]
    with torch.no_grad():
        for gain in gains:
            gain.zero_()
    return WorldModel(silent, model.checkpoint) if gains else None


@torch.no_grad()
def _colors_alone(
    model: WorldModel, parsed: Rollout, drawn: Drawn, truth: Grounding, present_K: np.ndarray
) -> np.ndarray:
    """What comparing each slot's colour with the lexicon's would say by itself, (V, R) bool."""
    color_BK3 = SlotState.split(parsed.slots[:, 0], parsed.layout).color
    most = []
    for text in drawn.texts:
        match_KL = color_match(color_BK3, torch.from_numpy(present_K)[None], model.model.text([text]))[0]
        match_KW = merge_words(match_KL.numpy(), model.words(text), text)
        most.append(named_most(match_KW, truth, Instruction.parse(text), present_K))
    return np.array(most)


def _looks(parsed: Rollout, drawn: Drawn, own: Sequence[Instruction]) -> Grounding:
    """Slots named by appearance; nothing is named where that fails."""
    try:
        found = ground(parsed, PinholeCamera.from_info(cast(Any, drawn.info)["camera"]))[0]
    except GroundingError:
        return Grounding((), ())
    return found.told([thing for i in own for thing in (i.block_thing, i.bowl_thing)])


def _renamed(truth: Grounding, own: Instruction, wrong: str) -> Grounding:
    """The grounding in which the things of the scene's own instruction bear the names that the wrong one says."""
    said = Instruction.parse(wrong)
    things: dict[Thing, tuple[int, ...]] = {
        said.block_thing: truth.things.get(own.block_thing, ()),
        said.bowl_thing: truth.things.get(own.bowl_thing, ()),
    }
    return replace(truth, things=things)
