"""Captions read back: what the things of a scene would have to do for a caption to be true."""

import re
from itertools import product

import numpy as np

from .scenes import ACTIONS, CONTAINED, TABLE, TRIES, Act, Action, Clip, Place, Thing, draw_times, free

VERBS: dict[str, Action] = {
    "rotating": "rotate",
    "sliding to": "slide",
    "picked up and placed to": "pick-place",
    "picked up and containing": "contain",
}
SAID = re.compile(rf"the ([a-z ]+) is ({'|'.join(VERBS)})(?: (.+))?")
CELL = re.compile(r"\(?(-?[1-3]), ?(-?[1-3])\)?")
QUADRANTS = {"first": (1, 1), "second": (-1, 1), "third": (-1, -1), "fourth": (1, -1)}  # signs of x and y
EXAMPLE = "'the cone is sliding to (2, -1). the red cube is rotating.'"

Area = tuple[Place, Place]  # lowest and highest x, lowest and highest y
Ask = tuple[int, Action, int | None, Area | None]  # who, does what, over what, to where


def read_caption(text: str, things: tuple[Thing, ...], rng: np.random.Generator) -> Clip:
    """A clip of these things in which happens what a caption says, explicit or ambiguous; the rest is drawn.

    Args:
        text: one sentence, or two about different things.

    Raises:
        ValueError: if the text is no caption, speaks of nothing that is there, or cannot be without a push.
    """
    sentences = [part.strip() for part in text.lower().split(".") if part.strip()]
    if not 1 <= len(sentences) <= 2:
        raise ValueError(f"a caption has one or two sentences, such as {EXAMPLE}, not {len(sentences)}")
    choices = list(product(*(_asked(sentence, things) for sentence in sentences)))
    # Two things do two things, and what is contained stays where it is.
    choices = [
        asks for asks in choices if len({n for who, _, into, _ in asks for n in (who, into)} - {None})
        == len(asks) + sum(into is not None for _, _, into, _ in asks)
    ]  # fmt: skip
    if not choices:
        raise ValueError("two sentences must be about different things")
    for _ in range(TRIES):
        asks = choices[int(rng.integers(len(choices)))]
        clip = Clip(things, tuple(_drawn(ask, things, rng) for ask in asks))
        if free(clip):
            return clip
    raise ValueError("no way was found to do this without pushing something; name another place")


def _asked(sentence: str, things: tuple[Thing, ...]) -> list[Ask]:
    """All that a sentence may mean."""
    said = SAID.fullmatch(sentence)
    if said is None:
        raise ValueError(f"cannot read {sentence!r}; captions are like {EXAMPLE}")
    name, verb, rest = said[1], said[2], said[3] or ""
    action = VERBS[verb]
    able = [number for number in _meant(name, things) if action in ACTIONS[things[number].shape]]
    if not able:
        raise ValueError(f"a {name.split()[-1]} is never {verb.removesuffix(' to')}")
    if action == "contain":
        pairs = product(able, _meant(rest.removeprefix("the "), things))
        asks: list[Ask] = [
            (number, action, into, None)
            for number, into in pairs
            if things[into].shape in CONTAINED and things[into].radius < things[number].radius
        ]
        if not asks:
            raise ValueError(f"a cone contains smaller {', '.join(CONTAINED)}; {sentence!r} cannot be")
        return asks
    return [(number, action, None, None if action == "rotate" else _area(rest)) for number in able]


def _meant(name: str, things: tuple[Thing, ...]) -> list[int]:
    """The numbers of the things that can be called so."""
    words = name.split()
    found = [
        number
        for number, thing in enumerate(things)
        if words and words[-1] == thing.shape and {*words} <= {*thing.name.split()}
    ]
    if not found:
        raise ValueError(f"no {name or 'name'} is here; here are: {', '.join(t.name for t in things)}")
    return found


def _area(said: str) -> Area:
    """Where a cell or a quadrant is."""
    if cell := CELL.fullmatch(said):
        x, y = ((n - 1.0, float(n)) if n > 0 else (float(n), n + 1.0) for n in map(int, cell.groups()))
        return x, y
    signs = QUADRANTS.get(said.removeprefix("the ").removesuffix(" quadrant"))
    if signs is None:
        raise ValueError(f"places are cells, (-3, -3) to (3, 3) without 0, or quadrants, not {said!r}")
    x, y = ((0.0, TABLE) if sign > 0 else (-TABLE, 0.0) for sign in signs)
    return x, y


def _drawn(ask: Ask, things: tuple[Thing, ...], rng: np.random.Generator) -> Act:
    number, action, into, area = ask
    start, stop = draw_times(rng)
    if into is not None:
        return Act(number, action, start, stop, things[into].place, into)
    if area is None:
        return Act(number, action, start, stop, axis=int(rng.integers(3)))
    most = TABLE - things[number].radius
    x, y = (float(rng.uniform(max(low, -most), min(high, most))) for low, high in area)
    return Act(number, action, start, stop, (x, y))
