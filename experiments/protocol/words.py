"""From the tokens of a text encoder to the words of an instruction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.protocol.arguments import UsageError
from planning import Instruction

#: An instruction of one pair, word by word; a colour is one word, whatever its name.
TEMPLATE = ("put", "the", "block's colour", "block", "in", "the", "bowl's colour", "bowl")

_MARKS = ("\u2581", "##", "\u0120")  # how tokenizers mark the begin of a word, or its going on
_SPECIAL = (("<", ">"), ("[", "]"))  # as in </s> and [CLS]


def merge_words(values: np.ndarray, tokens: Sequence[str], text: str) -> np.ndarray:
    """Values of tokens, summed to values of the words of `TEMPLATE`; special and padding tokens are left out.

    Args:
        values: (..., L); L may be more than there are tokens.
        tokens: of the text, as the encoder sees them.
        text: an instruction of one pair.

    Returns:
        (..., 8).

    Raises:
        UsageError: if the tokens do not spell the words of the text.
    """
    words = spoken(text)
    merged = np.zeros((*values.shape[:-1], len(words)), dtype=values.dtype)
    word, rest = 0, words[0].replace(" ", "")
    for column, token in enumerate(tokens):
        if any(token.startswith(a) and token.endswith(b) for a, b in _SPECIAL):
            continue
        letters = token.lower().replace(" ", "")
        for mark in _MARKS:
            letters = letters.removeprefix(mark)
        if not letters:
            continue
        if not rest:
            word += 1
            rest = words[word].replace(" ", "") if word < len(words) else ""
        if not rest.startswith(letters):
            raise UsageError(f"the tokens {list(tokens)} do not spell the words of {text!r}")
        rest = rest[len(letters) :]
        merged[..., word] += values[..., column]
    if word != len(words) - 1 or rest:
        raise UsageError(f"the tokens {list(tokens)} do not spell the words of {text!r}")
    return merged


def spoken(text: str) -> tuple[str, ...]:
    """`TEMPLATE` with the colours of an instruction of one pair.

    Raises:
        ValueError: if the text names another number of pairs.
    """
    told = Instruction.parse(text)
    return ("put", "the", told.block, "block", "in", "the", told.bowl, "bowl")
