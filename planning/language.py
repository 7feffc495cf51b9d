"""What is asked for: things, instructions and goals, as values and as sentences.

    put the red block in the blue bowl and the green block in the gray bowl

The grammar of the data's captions (paper, section 4.1); `RELATIONS` has what may stand between two "and".
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .relations import RELATIONS


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
        ValueError: if there is no such relation, it does not join these kinds of things, or both have one colour.
    """

    relation: str  # a key of `RELATIONS`
    thing: Thing
    target: Thing

    def __post_init__(self) -> None:
        if self.relation not in RELATIONS:
            raise ValueError(f"no relation {self.relation!r}; there are: {', '.join(RELATIONS)}")
        kinds = RELATIONS[self.relation].kinds
        if (self.thing.kind, self.target.kind) != kinds:
            raise ValueError(f"{self.relation!r} joins {' and '.join(kinds)}, not {self.thing} and {self.target}")
        if self.thing == self.target:
            raise ValueError(f"the {self.thing} cannot be {self.relation} itself")
        if self.thing.color == self.target.color:
            raise ValueError(f"{self.text!r} names two things of one colour; no scene shows two such things")

    @property
    def text(self) -> str:
        """The sentence."""
        return "put " + RELATIONS[self.relation].template.format(thing=self.thing, target=self.target)

    @property
    def things(self) -> tuple[Thing, Thing]:
        """The thing and its target."""
        return self.thing, self.target

    @property
    def block(self) -> str:
        """The colour of the thing: what it was called when there were blocks and bowls alone, and users still say."""
        return self.thing.color

    @property
    def bowl(self) -> str:
        """The colour of the target, likewise."""
        return self.target.color

    @classmethod
    def parse(cls, text: str) -> Instruction:
        """The inverse of `text`. Raises as `Goal.parse`, and if the sentence asks for more than one thing."""
        asked = _parse(text)
        if len(asked) != 1:
            raise ValueError(f"expected one instruction of the form {_forms()}, got {text!r}")
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
        """All instructions of a sentence, in its order.

        It is read as a whole or not at all: a robot acts on it. Case, punctuation and CLIPort's own wording, "the red
        blocks in a blue bowl", do not matter. `WorldModel.reads` puts other wordings into this form.

        Raises:
            TypeError: if the text is no string.
            ValueError: as `Goal`, or if a part of the sentence is of no known form or names no colour; the message has
                the text and the forms.
        """
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


def _forms() -> str:
    each = (
        relation.template.format(thing=f"<color> {relation.kinds[0]}", target=f"<color> {relation.kinds[1]}")
        for relation in RELATIONS.values()
    )
    return " or ".join(f"'put {form}'" for form in each)


def _parse(text: str) -> tuple[Instruction, ...]:
    """What a sentence asks for, in its order."""
    if not isinstance(text, str):
        raise TypeError(f"a goal's text must be a string, not {type(text).__name__}")
    words = " ".join(re.sub(r"[^\w\s'-]", " ", text.lower()).split())
    found: list[Instruction] = []
    while words:
        first = r"(?:and )?(?:then )?(?:put )?" if found else "put "
        for name, relation in RELATIONS.items():
            if match := re.match(rf"{first}{relation.pattern.pattern}(?: |$)", words):
                things = (
                    Thing(match[role], kind) for role, kind in zip(("thing", "target"), relation.kinds, strict=True)
                )
                found.append(Instruction(name, *things))
                words = words[match.end() :]
                break
        else:
            raise ValueError(f"cannot read {words!r} in {text!r}; it takes {_forms()}, several joined by 'and'")
    from matplotlib.colors import is_color_like  # takes longer to import than all of the planner

    for thing in (thing for one in found for thing in one.things):
        # Names of CSS, and of the XKCD survey.
        if not (is_color_like(thing.color) or is_color_like(f"xkcd:{thing.color}")):
            raise ValueError(f"{thing.color!r} in {text!r} is no colour; it takes {_forms()}")
    return tuple(found)
