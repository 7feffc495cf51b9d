"""What is asked for: things, instructions and goals, as text and as values."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Kind = Literal["block", "bowl"]

_PAIR = re.compile(r"the ([a-z]+) block in the ([a-z]+) bowl")


@dataclass(frozen=True, order=True)
class Thing:
    """An object as language names it. No two objects of one scene share a colour."""

    color: str
    kind: Kind


@dataclass(frozen=True, order=True)
class Instruction:
    """One pick-and-place: the block of one colour into the bowl of another.

    Attributes:
        block, bowl: colour names.
    """

    block: str
    bowl: str

    @property
    def text(self) -> str:
        """The sentence, in the caption grammar of the data (paper, section 4.1)."""
        return f"put the {self.block} block in the {self.bowl} bowl"

    @property
    def block_thing(self) -> Thing:
        return Thing(self.block, "block")

    @property
    def bowl_thing(self) -> Thing:
        return Thing(self.bowl, "bowl")

    @classmethod
    def parse(cls, text: str) -> Instruction:
        """The inverse of `text`.

        Raises:
            ValueError: if the text does not name exactly one pair `the C block in the C bowl`.
        """
        pairs = _PAIR.findall(text.lower())
        if len(pairs) != 1:
            raise ValueError(f"expected one 'put the <colour> block in the <colour> bowl', got {text!r}")
        return cls(*pairs[0])


@dataclass(frozen=True)
class Goal:
    """Which blocks shall lie in which bowls at the end; the order does not matter.

    Raises:
        ValueError: if there is no pair, or one block is sent to two bowls.
    """

    pairs: tuple[Instruction, ...]

    def __post_init__(self) -> None:
        blocks = [pair.block for pair in self.pairs]
        if not blocks or len(set(blocks)) < len(blocks):
            raise ValueError(f"a goal needs at least one pair and each block once, got blocks {blocks}")

    @classmethod
    def parse(cls, text: str) -> Goal:
        """All pairs that an instruction of one or several steps names, as in "put the red block in the blue
        bowl and the green block in the gray bowl".

        Raises:
            ValueError: if it names none, or one block twice.
        """
        return cls(tuple(Instruction(*pair) for pair in _PAIR.findall(text.lower())))

    @property
    def things(self) -> tuple[Thing, ...]:
        """Every block and bowl that the goal names."""
        return tuple(dict.fromkeys(t for p in self.pairs for t in (p.block_thing, p.bowl_thing)))
