"""The tabletop's sentence in other words: every kind that users were seen to write, drawn at random."""

from __future__ import annotations

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


# Written by somebody who had seen neither the models' rules nor the wordings that these were made from.
FREE = (
    "place the {block} block in the {bowl} bowl",
    "move the {block} block to the {bowl} bowl",
    "set the {block} block down in the {bowl} bowl",
    "drop the {block} block into the {bowl} bowl",
    "put the {block} block inside the {bowl} bowl",
    "put the {block} block into the {bowl} bowl",
    "stick the {block} block within the {bowl} bowl",
    "transfer the {block} block over into the {bowl} bowl",
    "in the {bowl} bowl put the {block} block",
    "into the {bowl} bowl, drop the {block} block",
    "inside the {bowl} bowl, place the {block} one",
    "the {bowl} bowl is where you should put the {block} block",
    "put all the {block} blocks in the {bowl} bowl",
    "put a {block} block in a {bowl} bowl",
    "move those {block} blocks into that {bowl} bowl",
    "drop any {block} block in the {bowl} bowl",
    "Could you please put the {block} block in the {bowl} bowl?",
    "hey robot, would you mind moving the {block} block into the {bowl} bowl? thanks!",
    "Good morning! Please place the {block} block inside the {bowl} bowl for me.",
    "ok next one, can you drop the {block} block in the {bowl} bowl please",
    "PUT THE {block} BLOCK IN THE {bowl} BOWL",
    "Put The {block} Block In The {bowl} Bowl!!!",
    "{block} block,in the {bowl} bowl...",
    "put   the {block} block , in the {bowl} bowl .",
    "put the {block} cube in the {bowl} dish",
    "place the {block} brick inside the {bowl} container",
    "drop the {block} box into the {bowl} basin",
    "set the {block} piece in the {bowl} cup",
    "pick up the {block} block and put it in the {bowl} bowl",
    "grab the {block} block, then drop it into the {bowl} bowl",
    "take the {block} block and place it inside the {bowl} bowl",
    "lift the {block} cube and set it down in the {bowl} bowl",
    "Pick up the {block} block. Put it in the {bowl} bowl.",
    "See the {block} block? Move it into the {bowl} bowl.",
    "Find the {bowl} bowl. Put the {block} block in it.",
    "Get the {block} block. Now drop it in the {bowl} bowl.",
    "the {block} block should go in the {bowl} bowl",
    "I want the {block} block in the {bowl} bowl",
    "I'd like to see the {block} block inside the {bowl} bowl",
    "the {block} block belongs in the {bowl} bowl",
)


def free_wording(number: int, block: str, bowl: str) -> str:
    """One of `FREE` instead of "put the {block} block in the {bowl} bowl"."""
    return FREE[number % len(FREE)].format(block=block, bowl=bowl)
