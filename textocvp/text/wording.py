"""Other wordings of the sentences that a model was trained on.

Rules (`WordsConfig.rewrites`) replace words; they depend on what the captions say, and are data of the model's
configuration. What is of no form of the captions (`WordsConfig.forms`) after that is matched to one by the things that
it names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise, permutations
from typing import NamedTuple

# Whoever has never read one of these imagines the opposite of what is said.
NEGATIONS = frozenset((
    "not", "no", "never", "nor", "neither", "none", "nothing", "without", "except", "avoid", "cannot", "cant", "dont",
    "doesnt", "mustnt", "shouldnt", "wont", "stop", "refrain", "refuse", "forbid", "forbidden", "prevent", "outside",
))  # fmt: skip
DENYING = (  # the second word somewhere after the first
    ("anywhere", "but"), ("anything", "but"), ("everywhere", "but"), ("all", "but"), ("keep", "out"), ("keep", "away"),
    ("keep", "off"), ("stay", "out"), ("stay", "away"), ("leave", "out"),
)  # fmt: skip

# Whoever says one of these before a thing means another place than the words "in" and "on" of a form do.
ELSEWHERE = frozenset((
    "of", "from", "off", "on", "onto", "upon", "atop", "over", "above", "under", "underneath", "below", "beneath",
    "behind", "beside", "by", "near", "around", "against", "between", "past", "toward", "towards", "away", "alongside",
    "opposite",
))  # fmt: skip
HOLE = "{}"  # stands for a colour in a form

# Of any script: what cannot be read is to be named. A number keeps its sign, but "pick-2" is two words.
_WORD = re.compile(r"(?<![\w'])-\d+(?![\w'])|[\w']+")
_NAME = re.compile(r"{([a-z]+)}")


def split(text: str) -> list[str]:
    """The words of a text in lower case, without punctuation."""
    return _WORD.findall(text.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'"))


def denials(text: str) -> list[str]:
    """The words of a text that deny what is said."""
    words = split(text)
    found = [one for one in words if one.replace("'", "") in NEGATIONS or one.endswith("n't")]
    for first, second in DENYING:
        if first in words and second in words[words.index(first) :]:
            found.append(f"{first} ... {second}")
    return found


def reword(text: str, rules: tuple[str, ...]) -> list[str]:
    """The words of a text after each rule in turn; errors as `compile_rules`.

    A rule is `wording | other wording => words`: where one of the wordings stands, it becomes the words, or nothing. A
    rule with names, as `in {place} put {thing} => put {thing} in {place}`, is for whole sentences; each name stands
    for some words.
    """
    words = " ".join(split(text))
    for pattern, replacement in compile_rules(rules):
        words = " ".join(pattern.sub(replacement, words).split())
    return words.split()


@lru_cache(maxsize=64)
def compile_rules(rules: tuple[str, ...]) -> tuple[tuple[re.Pattern[str], str], ...]:
    """Rules as expressions and what takes their place; a ValueError for what is no rule."""
    return tuple(_compiled(rule) for rule in rules)


def _compiled(rule: str) -> tuple[re.Pattern[str], str]:
    left, arrow, right = (part.strip() for part in rule.partition("=>"))
    wordings, names = [" ".join(one.split()) for one in left.split("|")], _NAME.findall(left)
    wrong = not arrow or not all(wordings) or len(set(names)) < len(names) or set(_NAME.findall(right)) - set(names)
    if wrong or (names and len(wordings) > 1) or set(_NAME.sub("", left + right)) & set("{}\\"):
        raise ValueError(f"{rule!r} is no rule: write 'wording | other wording => words' or 'a {{x}} => b {{x}}'")
    # Longer wordings first: "on top of" is not to be read as "on".
    either = "|".join(re.escape(one) for one in sorted(wordings, key=len, reverse=True))
    if names:
        return re.compile(re.sub(r"\\{([a-z]+)\\}", r"(?P<\1>.+)", f"^{either}$")), _NAME.sub(r"\\g<\1>", right)
    return re.compile(rf"(?<!\S)(?:{either})(?!\S)"), right


class _Thing(NamedTuple):
    """A thing that a sentence names."""

    color: str
    noun: str | None  # None for a word that no form has
    said: tuple[str, ...]  # the words between the thing before it and its colour


def match_form(
    tokens: Sequence[str], forms: Sequence[str], is_color: Callable[[str], bool], knows: Callable[[str], bool]
) -> list[str] | None:
    """The sentence of the one form that says what these tokens say, or None.

    A thing is a colour with a noun of the forms, or with a word that the model does not know. Things take the places
    of their nouns; where two places have the same noun, the word that leads to the second place tells them apart.
    Words that the model does not know are left out, unless they are of `ELSEWHERE` and lead to a thing. So "Find the
    blue bowl, the red block should be in it" is "put the {red} block in the {blue} bowl", and "put the red block
    beside the blue bowl" is nothing.
    """
    split_forms = [form.split() for form in forms]
    pairs = [pair for form in split_forms for pair in pairwise(form)]
    nouns, articles = {b for a, b in pairs if a == HOLE}, {a for a, b in pairs if b == HOLE}
    things = _things([token for token in tokens if token not in articles], nouns, is_color, knows)
    if not things or all(thing.noun is None for thing in things):
        return None
    known = {token for token in tokens if knows(token) and not is_color(token)}
    found = [sentence for form in split_forms if known <= set(form) for sentence in _placed(form, things)]
    return found[0] if len(found) == 1 else None


def _things(
    tokens: Sequence[str], nouns: set[str], is_color: Callable[[str], bool], knows: Callable[[str], bool]
) -> list[_Thing]:
    """The things that a sentence names, each once; none if a colour belongs to nothing."""
    things: list[_Thing] = []
    begin = 0
    for at in [at for at, token in enumerate(tokens) if is_color(token)]:
        rest = list(tokens[at + 1 : at + 4])
        near = next((k for k, token in enumerate(rest) if knows(token)), len(rest))  # "red wooden block"
        before = [token for token in tokens[begin:at] if knows(token)]
        last, noun = at, None
        if rest[near : near + 1] and rest[near] in nouns:
            last, noun = at + 1 + near, rest[near]
        elif near > 0 and not {*rest[:near]} & ELSEWHERE:  # "red box"
            last = at + 1
        elif before and before[-1] in nouns and not knows(tokens[at - 1]):  # "the block that is red"
            noun = before[-1]
        else:
            return []
        if (tokens[at], noun) not in [thing[:2] for thing in things]:  # "Pick up the red block. Put the red block ..."
            things.append(_Thing(tokens[at], noun, tuple(tokens[begin:at])))
        begin = last + 1
    return things


def _placed(form: list[str], things: list[_Thing]) -> Iterator[list[str]]:
    """The sentences of a form with these things at its places."""
    holes = [at for at, word in enumerate(form) if word == HOLE]
    places = [form[at + 1] if at + 1 < len(form) else None for at in holes]
    if len(holes) != len(things) or len(holes) > 3:
        return
    # The words that lead to a place: those since the place before, but for its noun and those of the form's beginning.
    leads = [
        set(form[a:b]) - {HOLE, *form[: holes[0]], *places} for a, b in zip([holes[0], *holes], holes, strict=False)
    ]
    leading = set().union(*leads)
    for order in permutations(things):
        led = [next((word for word in reversed(one.said) if word in leading | ELSEWHERE), None) for one in order]
        fits = all(one.noun in (None, noun) for one, noun in zip(order, places, strict=True))
        right = all(word is None or word in lead for word, lead in zip(led, leads, strict=True))
        told_apart = len({*places}) == len(places) and sum(one.noun is None for one in order) < 2
        if fits and right and (told_apart or list(map(bool, led)) == list(map(bool, leads))):
            colors = iter(one.color for one in order)
            yield [next(colors) if word == HOLE else word for word in form]
