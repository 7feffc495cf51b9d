"""Which slots listen to which words: how one rollout's attention is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.protocol.words import TEMPLATE
from planning import Grounding, Instruction

#: The two things that an instruction names, and where their colours stand in it.
ROLES = ("block", "bowl")
COLOR_WORDS = (TEMPLATE.index("block's colour"), TEMPLATE.index("bowl's colour"))
#: What a map of attention has a row for.
GROUPS = ("named block", "named bowl", "arm", "other blocks", "other bowls", "table")


@dataclass(frozen=True, eq=False)
class Heard:
    """How the slots of one rollout listened. Axes: R roles, T steps, n layers, h heads, G groups, W words.

    A slot attends most to a word if it gives it a larger share of its attention than any other present slot does; its
    shares sum to 1 over the words. Equal is not more. A thing of several slots attends most if one of them does; one
    without a slot never does.

    Attributes:
        most_R: whether the named thing attends most to its own colour word, shares averaged over steps, layers, heads.
        most_Rnh: the same for each layer and head, shares averaged over steps.
        most_RT: the same for each step, shares averaged over layers and heads.
        chance_R: the thing's share of the present slots.
        margin_R: how much larger its share is than the largest of all other slots (negative: smaller), or nan.
        shares_RTG: mean share of each group's slots for the role's colour word; nan where the scene has no such thing.
        map_nhGW: mean shares of each group's slots over steps.
        ends_in_bowl: whether the named block's slot ends within `block_bowl_px` of where the named bowl's slot was.
    """

    most_R: np.ndarray
    most_Rnh: np.ndarray
    most_RT: np.ndarray
    chance_R: np.ndarray
    margin_R: np.ndarray
    shares_RTG: np.ndarray
    map_nhGW: np.ndarray
    ends_in_bowl: bool


def attends_most(shares: np.ndarray, slots: Sequence[int], present_K: np.ndarray) -> np.ndarray:
    """Whether one of these slots has a larger share than every other present slot: (..., K) -> (...) bool."""
    return _lead(shares, slots, present_K) > 0


def named_most(
    shares_KW: np.ndarray, grounding: Grounding, told: Instruction, present_K: np.ndarray
) -> list[bool]:
    """Whether the named block and the named bowl attend most to their own colour words."""
    things = (told.block_thing, told.bowl_thing)
    return [
        bool(attends_most(shares_KW[:, word], grounding.things.get(thing, ()), present_K))
        for thing, word in zip(things, COLOR_WORDS, strict=True)
    ]


def _lead(shares: np.ndarray, slots: Sequence[int], present_K: np.ndarray) -> np.ndarray:
    own_K = np.zeros_like(present_K)
    own_K[list(slots)] = True
    own = np.where(own_K & present_K, shares, -np.inf).max(-1)
    others = np.where(~own_K & present_K, shares, -np.inf).max(-1)
    with np.errstate(invalid="ignore"):  # no slot of either kind
        lead: np.ndarray = own - others
    return np.where(np.isneginf(own), -np.inf, lead)


def hear(
    attention_TnhKW: np.ndarray,
    present_K: np.ndarray,
    grounding: Grounding,
    told: Instruction,
    ends_in_bowl: bool,
) -> Heard:
    """Read one rollout's attention, merged to the words of `TEMPLATE`."""
    slots_R = [grounding.things.get(thing, ()) for thing in (told.block_thing, told.bowl_thing)]
    groups = _groups(grounding, told)
    most, most_nh, most_T, chance, margin, shares = [], [], [], [], [], []
    for slots, word in zip(slots_R, COLOR_WORDS, strict=True):
        shares_TnhK = attention_TnhKW[..., word]
        lead = _lead(shares_TnhK.mean((0, 1, 2)), slots, present_K)
        most.append(lead > 0)
        most_nh.append(attends_most(shares_TnhK.mean(0), slots, present_K))
        most_T.append(attends_most(shares_TnhK.mean((1, 2)), slots, present_K))
        chance.append(present_K[list(slots)].sum() / present_K.sum())
        margin.append(lead if np.isfinite(lead) else np.nan)
        shares.append(_group_means(shares_TnhK.mean((1, 2)), groups))
    map_nhWG = _group_means(attention_TnhKW.mean(0).swapaxes(-1, -2), groups)
    return Heard(
        np.array(most),
        np.array(most_nh),
        np.array(most_T),
        np.array(chance),
        np.array(margin, dtype=np.float64),
        np.array(shares),
        map_nhWG.swapaxes(-1, -2),
        ends_in_bowl,
    )


def _groups(grounding: Grounding, told: Instruction) -> list[list[int]]:
    """The slots of each of `GROUPS`."""
    named = (told.block_thing, told.bowl_thing)
    others = {
        kind: [
            k
            for thing, its in grounding.things.items()
            if thing.kind == kind and thing not in named
            for k in its
        ]
        for kind in ROLES
    }
    own = [list(grounding.things.get(thing, ())) for thing in named]
    return [*own, list(grounding.arm), others["block"], others["bowl"], list(grounding.background)]


def _group_means(shares: np.ndarray, groups: Sequence[Sequence[int]]) -> np.ndarray:
    """(..., K) -> (..., G), nan for an empty group."""
    empty = np.full(shares.shape[:-1], np.nan)
    return np.stack([shares[..., list(g)].mean(-1) if len(g) else empty for g in groups], axis=-1)
