"""Other wordings of the sentences that a model was trained on.

The rules are data of the model's configuration (`WordsConfig.rewrites`), because they depend on what its captions say.
"""

from __future__ import annotations

import re
from functools import lru_cache

# Whoever has never read one of these imagines the opposite of what is said.
NEGATIONS = frozenset((
    "not", "no", "never", "nor", "neither", "none", "nothing", "without", "except", "avoid", "cannot", "cant", "dont",
    "doesnt", "mustnt", "shouldnt", "wont",
))  # fmt: skip

# Of any script: what cannot be read is to be named. A number keeps its sign, but "pick-2" is two words.
_WORD = re.compile(r"(?<![\w'])-\d+(?![\w'])|[\w']+")
_NAME = re.compile(r"{([a-z]+)}")


def split(text: str) -> list[str]:
    """The words of a text in lower case, without punctuation."""
    return _WORD.findall(text.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'"))


def is_negation(word: str) -> bool:
    """Whether a word of `split` denies what is said."""
    return word.replace("'", "") in NEGATIONS or word.endswith("n't")


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
