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
    "Place the {block} block into the {bowl} bowl.",
    "please put the {block} cube in the {bowl} bowl",
    "Could you drop the {block} block into the {bowl} dish?",
    "Pick up the {block} block and put it in the {bowl} bowl.",
    "Take the {block} cube. Put it inside the {bowl} bowl.",
    "I'd like the {block} block to be in the {bowl} bowl.",
    "In the {bowl} bowl, put the {block} block.",
    "Grab the {block} brick and drop it in the {bowl} bowl",
    "The {block} block goes in the {bowl} bowl.",
    "move the {block} block to the inside of the {bowl} bowl",
    "Can you please move the {block} cube into the {bowl} basin?",
    "Okay, now set the {block} block down inside the {bowl} bowl, please.",
    "PUT THE {block} BLOCK INTO THE {bowl} BOWL",
    "I want you to place the {block} block within the {bowl} bowl.",
    "Hey robot, stick the {block} block in the {bowl} bowl!",
    "See the {block} block? Put it in the {bowl} bowl.",
    "Get the {block} one of the blocks and place it in the {bowl} bowl.",
    "Would you mind putting the {block} block in the {bowl} bowl?",
    "Fill the {bowl} bowl with the {block} block.",
    "Find the {block} block, then drop it into the {bowl} bowl.",
    "Put the {block} block in the bowl that is {bowl}.",
    "Please take the block that's {block} and put it into the {bowl} bowl",
    "{block} block into the {bowl} bowl, please.",
    "Just pop the {block} cube into the {bowl} bowl, would you?",
    "The {bowl} bowl should have the {block} block in it.",
    "Lift the {block} block and lower it into the {bowl} bowl.",
    "Transfer the {block} block into the {bowl} container.",
    "Into the {bowl} bowl goes the {block} cube!",
    "Let's put the {block} toy block in the {bowl} bowl.",
    "I need the {block} brick inside the {bowl} dish, thanks.",
    "Pick the {block} block up. Now drop it in the {bowl} bowl.",
    "Um, can you put the {block} block in the {bowl} bowl for me?",
    "Make sure the {block} block ends up in the {bowl} bowl.",
    "Use the {bowl} bowl to hold the {block} block.",
    "Find the {bowl} bowl and put the {block} block in it.",
    "Pick up the {block} block and put the {block} block inside the {bowl} bowl.",
    "Of all the blocks, put the {block} one in the {bowl} bowl.",
    "Of the bowls, choose the {bowl} one and drop the {block} block into it.",
    "It would be great if you could get the {block} cube into the {bowl} bowl.",
    "so, take the {block} square block and tuck it inside the {bowl} cup",
)


def free_wording(number: int, block: str, bowl: str) -> str:
    """One of `FREE` instead of "put the {block} block in the {bowl} bowl"."""
    return FREE[number % len(FREE)].format(block=block, bowl=bowl)
