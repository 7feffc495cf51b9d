"""What is asked for: things, instructions and goals, as values and as sentences.

    put the red block in the blue bowl and the green block in the gray bowl

The grammar of the data's captions (paper, section 4.1); `RELATIONS` has what may stand between two "and".
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.relations import RELATIONS


@dataclass(frozen=True, order=True)
class Thing:
    """An object as language names it. No two objects of one scene share a colour."""

    color: str
    kind: str

    def __str__(self) -> str:
        return f"{self.color} {self.kind}"


@dataclass(frozen=True, order=True)
class Instruction:
    """One pick-and-place: a thing is moved so that it stands to its target in a relation.

    Raises:
        ValueError: if there is no such relation, it does not join these kinds of things, or both are one thing.
    """

    relation: str  # a key of `RELATIONS`
    thing: Thing
    target: Thing

    def __post_init__(self) -> None:
        if self.relation not in RELATIONS:
            raise ValueError(f"no relation {self.relation!r}; there are: {', '.join(RELATIONS)}")
        kinds = RELATIONS[self.relation].kinds
        if (self.thing.kind, self.target.kind) != kinds:
            raise ValueError(
                f"{self.relation!r} joins {' and '.join(kinds)}, not {self.thing} and {self.target}"
            )
        if self.thing == self.target:
            raise ValueError(f"the {self.thing} cannot be {self.relation} itself")

    @property
    def text(self) -> str:
        """The sentence."""
        return "put " + RELATIONS[self.relation].template.format(thing=self.thing, target=self.target)

    @property
    def things(self) -> tuple[Thing, Thing]:
        """The thing and its target."""
        return self.thing, self.target

    @classmethod
    def parse(cls, text: str) -> Instruction:
        """The inverse of `text`.

        Raises:
            ValueError: if the sentence does not ask for exactly one thing.
        """
        asked = _parse(text)
        if len(asked) != 1:
            forms = ", ".join(f"'put {relation.template}'" for relation in RELATIONS.values())
            raise ValueError(f"expected one instruction of the form {forms}, got {text!r}")
        return asked[0]


@dataclass(frozen=True)
class Goal:
    """Instructions that shall be fulfilled at the end, in any order.

    Raises:
        ValueError: if there is no instruction, or one thing is sent to two places.
    """

    instructions: tuple[Instruction, ...]

    def __post_init__(self) -> None:
        moved = [str(one.thing) for one in self.instructions]
        if not moved or len(set(moved)) < len(moved):
            raise ValueError(f"a goal needs at least one instruction and moves each thing once, got {moved}")

    @classmethod
    def parse(cls, text: str) -> Goal:
        """All instructions of a sentence, in its order. Raises as `Goal`."""
        return cls(_parse(text))

    @property
    def steps(self) -> int:
        """How many sentences it takes, if each comes true."""
        return len(self.instructions)

    @property
    def things(self) -> tuple[Thing, ...]:
        """Everything that the goal names."""
        return tuple(dict.fromkeys(thing for one in self.instructions for thing in one.things))


@dataclass(frozen=True, eq=False)
class PictureGoal:
    """A picture of how all shall be, taken by the camera that the robot sees with."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    things: tuple[Thing, ...] = ()  # what language says of it: nothing
    steps: int = 1  # that count for the attempts at it


AnyGoal = Goal | PictureGoal


_NEGATIONS = re.compile(r"\b(not|never|no|without|don't)\b")
_BETWEEN = re.compile(r"\s*(?:,|;|\.|\b(?:and|then)\b)+\s*")  # between two instructions


def _parse(text: str) -> tuple[Instruction, ...]:
    """Whatever a sentence asks for, in its order; a ValueError if a part of it cannot be read, or it is a negation."""
    forms = ", ".join(f"'put {relation.template}'" for relation in RELATIONS.values())
    if not isinstance(text, str):
        raise TypeError(f"a goal is a sentence, not {type(text).__name__}; its form is {forms}")
    if _NEGATIONS.search(text.lower()):
        raise ValueError(f"{text!r} says what shall not be; a goal says what shall be, in the form {forms}")
    found = []
    for part in filter(None, _BETWEEN.split(text.lower())):
        for name, relation in RELATIONS.items():
            if match := relation.pattern.search(part):
                kind, target_kind = relation.kinds
                things = Thing(match["thing"], kind), Thing(match["target"], target_kind)
                found.append(Instruction(name, *things))
                break
        else:
            raise ValueError(f"cannot read {part!r} in {text!r}; the form is {forms}")
    return tuple(found)
