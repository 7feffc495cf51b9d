"""The tabletop's sentence in other words: every kind that users were seen to write, drawn at random."""

from pathlib import Path

import numpy as np

VERBS = ("place", "move", "set", "drop", "put")
IN = ("in", "into", "inside")
BLOCKS = ("the {} block", "a {} block", "the {} cube", "{} block", "the {} blocks", "{} cubes")
BOWLS = ("the {} bowl", "a {} bowl", "the {} dish", "{} bowl", "the {} bowls", "{} dishes")
ORDERS = (
    "{verb} {block} {into} {bowl}",
    "{verb} {block} {into} {bowl}",
    "{into} {bowl} {verb} {block}",
    "pick up {block} and {verb} it {into} {bowl}",
    "pick up {block}. Then {verb} it {into} {bowl}",
)
BEFORE = ("", "", "please ", "could you ", "now ")
AFTER = ("", "", ".", "!", ", please.")


def paraphrase(number: int, block: str, bowl: str) -> str:
    """Wording `number` of "put the {block} block in the {bowl} bowl", of colours; the same for the same number."""
    rng = np.random.default_rng([number, 7])

    def one_of(parts: tuple[str, ...]) -> str:
        return parts[int(rng.integers(len(parts)))]

    spelled = {"gray": one_of(("gray", "grey"))}
    block, bowl = (one_of(nouns).format(spelled.get(c, c)) for nouns, c in ((BLOCKS, block), (BOWLS, bowl)))
    text = one_of(BEFORE) + one_of(ORDERS).format(verb=one_of(VERBS), into=one_of(IN), block=block, bowl=bowl)
    return (text, text, text.capitalize(), text.upper())[int(rng.integers(4))] + one_of(AFTER)


FREE = Path(__file__).with_name("free-wordings.txt")
"""Written by somebody who had seen neither the models' rules nor the wordings that these were made from."""


def free_wording(number: int, block: str, bowl: str) -> str:
    """One of `FREE` instead of "put the {block} block in the {bowl} bowl"."""
    wordings = FREE.read_text().splitlines()
    return wordings[number % len(wordings)].format(block=block, bowl=bowl)
