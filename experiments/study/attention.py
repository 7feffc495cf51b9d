"""Which words the slots of imagined rollouts attend to (paper, section 4.5)."""

import copy
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from experiments.study.methods import HORIZON
from experiments.study.predictions import reach
from experiments.study.run import UsageError
from planning import RELATIONS, Grounding, Instruction
from textocvp import Rollout, WorldModel
from textocvp.predictors.textocvp import color_match
from textocvp.slots import SlotState

TEMPLATE = ("put", "the", "block's colour", "block", "in", "the", "bowl's colour", "bowl")
"""An instruction, word by word; a colour is one word, whatever its name."""
COLOR_WORDS = (2, 6)  # places in it
GROUPS = ("named block", "named bowl", "arm", "other blocks", "other bowls", "table")
"""What a map of attention has a row for."""
NO_LETTERS = re.compile(r"^<.*>$|^\[.*\]$|^(\u2581|##|\u0120)|\s")
"""What spells nothing: special tokens as </s> and [CLS], and how tokenizers mark where a word begins or goes on."""


def merge_tokens(values: np.ndarray, tokens: Sequence[str], text: str) -> np.ndarray:
    """Values of tokens, summed to values of the words of `TEMPLATE`: (..., L) -> (..., 8).

    Special tokens are left out, and what comes after the last token.

    Raises:
        UsageError: if the tokens do not spell the words of the text.
    """
    block, bowl = (thing.color.replace(" ", "") for thing in Instruction.parse(text).things)
    words = ("put", "the", block, "block", "in", "the", bowl, "bowl")
    spelled = [NO_LETTERS.sub("", token).lower() for token in tokens]
    merged = np.zeros((*values.shape[:-1], len(words)), dtype=values.dtype)
    ends, letters = np.cumsum([len(word) for word in words]), 0
    if "".join(spelled) != "".join(words):
        raise UsageError(f"the tokens {list(tokens)} do not spell the words of {text!r}")
    for column, token in enumerate(spelled):
        if token:
            merged[..., np.searchsorted(ends, letters, side="right")] += values[..., column]
        letters += len(token)
    return merged


@dataclass(frozen=True, eq=False)
class AttentionReading:
    """How the slots of one rollout attend. Axes: R roles, T steps, n layers, h heads, G groups, W words.

    A slot attends most to a word if it gives it a larger share of its attention than any other present slot does; its
    shares sum to 1 over the words. Equal is not more. A thing of several slots attends most if one of them does; one
    without a slot never does.
    """

    most_R: np.ndarray  # whether the named thing attends most to its colour word, by means over T, n and h
    most_Rnh: np.ndarray  # the same for each layer and head, by means over T
    most_RT: np.ndarray  # the same for each step, by means over n and h
    chance_R: np.ndarray  # the thing's share of the present slots
    lead_R: np.ndarray  # how far its share is above the largest of all others; -inf without a slot
    shares_RTG: np.ndarray  # each group's mean share for the role's colour word; nan without such a thing
    map_nhGW: np.ndarray  # each group's mean shares over T
    ends_in_bowl: bool  # whether the named block's slot ends near where the named bowl's slot was


def read_attention(
    attention_TnhKW: np.ndarray, present_K: np.ndarray, grounding: Grounding, asked: Instruction, ends: bool
) -> AttentionReading:
    """Read one rollout's attention, merged to the words of `TEMPLATE`; `ends` is for `ends_in_bowl`."""
    slots_R, others = named_slots(grounding, asked), dict[str, list[int]](block=[], bowl=[])
    for thing, its in grounding.things.items():
        if thing not in asked.things:
            others[thing.kind] += its
    groups = [*slots_R, list(grounding.arm), *others.values(), list(grounding.background)]
    shares_R = [attention_TnhKW[..., word] for word in COLOR_WORDS]

    def leads(*axes: int) -> np.ndarray:
        pairs = zip(shares_R, slots_R, strict=True)
        return np.array([lead(shares.mean(axes), slots, present_K) for shares, slots in pairs])

    lead_R = leads(0, 1, 2)
    return AttentionReading(
        most_R=lead_R > 0,
        most_Rnh=leads(0) > 0,
        most_RT=leads(1, 2) > 0,
        chance_R=np.array([present_K[slots].sum() / present_K.sum() for slots in slots_R]),
        lead_R=lead_R,
        shares_RTG=np.array([_group_means(shares.mean((1, 2)), groups) for shares in shares_R]),
        map_nhGW=_group_means(attention_TnhKW.mean(0).swapaxes(-1, -2), groups).swapaxes(-1, -2),
        ends_in_bowl=ends,
    )


def named_slots(grounding: Grounding, asked: Instruction) -> list[list[int]]:
    """The slots of the named block and of the named bowl."""
    return [list(grounding.things.get(thing, ())) for thing in asked.things]


def lead(shares: np.ndarray, slots: Sequence[int], present_K: np.ndarray) -> np.ndarray:
    """How much larger the share of these slots is than that of every other present one: (..., K) -> (...).

    -inf for a thing without a present slot.
    """
    own_K = np.zeros_like(present_K)
    own_K[list(slots)] = True
    own, others = (np.where(some_K & present_K, shares, -np.inf).max(-1) for some_K in (own_K, ~own_K))
    with np.errstate(invalid="ignore"):  # no slot of either kind
        return np.where(np.isneginf(own), -np.inf, own - others)


def _group_means(shares: np.ndarray, groups: Sequence[list[int]]) -> np.ndarray:
    """(..., K) -> (..., G), nan for an empty group."""
    empty = np.full(shares.shape[:-1], np.nan)
    return np.stack([shares[..., group].mean(-1) if group else empty for group in groups], axis=-1)


def ends_in_bowl(rollout: Rollout, index: int, grounding: Grounding, asked: Instruction) -> bool:
    """Whether the named block's slot ends near where the named bowl's slot was, for one rollout of a batch."""
    block, bowl = named_slots(grounding, asked)
    if not block or not bowl:
        return False
    places_TK2 = rollout.select(index).positions[0]
    apart = places_TK2[-1, block].mean(0) - places_TK2[0, bowl].mean(0)
    return float(apart.norm()) <= RELATIONS[asked.relation].within_px


def without_color_term(model: object) -> WorldModel | None:
    """A copy of a model whose attention has lost the term that compares colours; None if it never had one."""
    if not isinstance(model, WorldModel):
        return None
    network = copy.deepcopy(model.model)
    gains = [gain for name, gain in network.predictor.named_parameters() if name.endswith("color_gain_h")]
    for gain in gains:
        gain.data.zero_()
    return WorldModel(network, model.checkpoint) if gains else None


def imagine(model: WorldModel, parsed: Rollout, texts: Sequence[str], seed: int) -> tuple[list[np.ndarray], Rollout]:
    """Imagine, and merge each rollout's attention (T, n, h, K, W) to the words of `TEMPLATE`."""
    rollout = model.rollout(parsed, list(texts), horizon=reach(model, HORIZON), seed=seed, attention=True)
    assert rollout.attention is not None  # `check_model` saw to it
    pairs = zip(rollout.attention.cpu().double().numpy(), texts, strict=True)
    return [merge_tokens(attention, model.words(text), text) for attention, text in pairs], rollout


@torch.no_grad()
def color_term(model: WorldModel, parsed: Rollout, texts: Sequence[str], present_K: np.ndarray) -> list[np.ndarray]:
    """What comparing each slot's colour with the lexicon's says by itself, as an attention of one step and head."""
    color_1K3 = SlotState.split(parsed.slots[:, 0], parsed.layout).color
    present_1K, merged = torch.from_numpy(present_K)[None], []
    for text in texts:
        match_1KL = color_match(color_1K3, present_1K, model.model.text([text]))
        merged.append(merge_tokens(match_1KL.numpy()[None, None], model.words(text), text))
    return merged


def glow(frames_THW3: np.ndarray, masks_TKHW: np.ndarray, shares_SK: np.ndarray) -> np.ndarray:
    """Frames in faint grey, with each slot as bright as its share of attention to one word.

    Args:
        frames_THW3: uint8.
        masks_TKHW: 0..1.
        shares_SK: of the S = T - 1 steps; step s looked at frame s and imagined frame s + 1, over which it is painted.
            The brightest share of the whole video is full.
    """
    shares_TK = np.concatenate([shares_SK[:1], shares_SK])[: len(frames_THW3)]
    strength = np.einsum("tkhw,tk->thw", masks_TKHW, shares_TK / max(float(shares_SK.max()), 1e-9))[..., None]
    grey = 0.25 * frames_THW3.mean(-1, keepdims=True) + 24
    orange = np.array((255.0, 138.0, 30.0))
    return (grey * (1 - strength) + orange * strength).clip(0, 255).round().astype(np.uint8)
