"""The caption grammar: ``put the red block in the blue bowl [and the green block in the yellow bowl
...]``."""

from __future__ import annotations

import re
import string
from collections.abc import Iterable
from typing import NamedTuple

from envs.colors import COLORS

GRAMMAR = "put the <color> block in the <color> bowl [and the <color> block in the <color> bowl ...]"

CHARSET = string.ascii_lowercase + " "
"""Characters an instruction is made of. Gymnasium's default charset for ``Text`` lacks the space."""

_PAIR = re.compile(r"the ([a-z]+) block in the ([a-z]+) bowl")


class ColorPair(NamedTuple):
    """One wish of an instruction: the block of colour ``block`` goes into the bowl of colour ``bowl``."""

    block: str
    bowl: str


def format_instruction(pairs: Iterable[tuple[str, str]]) -> str:
    """The instruction for (block colour, bowl colour) pairs, in their order.

    Raises:
        ValueError: for no pair at all, or a colour that does not exist.
    """
    wishes = [ColorPair(*pair) for pair in pairs]
    if not wishes:
        raise ValueError("an instruction needs at least one (block colour, bowl colour) pair")
    for wish in wishes:
        _check_colors(wish)
    return "put " + " and ".join(f"the {w.block} block in the {w.bowl} bowl" for w in wishes)


def parse_instruction(text: str) -> tuple[ColorPair, ...]:
    """The (block colour, bowl colour) pairs an instruction names; the inverse of `format_instruction`.

    Letter case, repeated spaces and a final full stop do not matter.

    Raises:
        ValueError: when the text is not of the grammar, names an unknown colour, or names a block twice.
    """
    if not isinstance(text, str):
        raise ValueError(f"an instruction is a string of the form '{GRAMMAR}', not {type(text).__name__}")
    plain = " ".join(text.lower().rstrip(". ").split())
    if not plain.startswith("put "):
        raise ValueError(f"cannot read the instruction {text!r}; the form is: {GRAMMAR}")
    wishes = []
    for part in plain.removeprefix("put ").split(" and "):
        match = _PAIR.fullmatch(part)
        if match is None:
            raise ValueError(f"cannot read {part!r} in the instruction {text!r}; the form is: {GRAMMAR}")
        wishes.append(ColorPair(*match.groups()))
        _check_colors(wishes[-1])
    blocks = [wish.block for wish in wishes]
    if len(set(blocks)) < len(blocks):
        raise ValueError(f"the instruction {text!r} names one block twice")
    return tuple(wishes)


def _check_colors(wish: ColorPair) -> None:
    for color in wish:
        if color not in COLORS:
            raise ValueError(f"unknown colour {color!r}; allowed: {', '.join(COLORS)}")
