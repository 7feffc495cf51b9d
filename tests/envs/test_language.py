from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs import format_instruction, parse_instruction
from envs.colors import COLORS
from envs.language import CHARSET

names = st.sampled_from(sorted(COLORS))
pairs = st.lists(st.tuples(names, names), min_size=1, max_size=3, unique_by=lambda pair: pair[0])


@given(pairs)
def test_parsing_undoes_formatting(wishes: list[tuple[str, str]]) -> None:
    text = format_instruction(wishes)
    assert [tuple(pair) for pair in parse_instruction(text)] == wishes
    assert set(text) <= set(CHARSET)


def test_the_sentence_is_the_papers() -> None:
    assert format_instruction([("red", "blue")]) == "put the red block in the blue bowl"
    assert format_instruction([("red", "blue"), ("green", "yellow")]) == (
        "put the red block in the blue bowl and the green block in the yellow bowl"
    )


def test_case_spaces_and_full_stop_do_not_matter() -> None:
    assert parse_instruction("  Put the RED  block in the blue bowl. ") == (("red", "blue"),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the form is: put the <color> block in the <color> bowl"),
        ("put the red block", "the form is"),
        ("put the red bowl in the blue block", "the form is"),
        ("put the red block in the blue bowl and", "the form is"),
        ("put the mauve block in the blue bowl", "unknown colour 'mauve'; allowed: blue, green"),
        ("put the red block in the blue bowl and the red block in the green bowl", "one block twice"),
        (3, "is a string"),
    ],
)
def test_what_is_not_an_instruction_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_instruction(text)


def test_formatting_refuses_unknown_colours_and_nothing() -> None:
    with pytest.raises(ValueError, match="unknown colour 'mauve'"):
        format_instruction([("red", "mauve")])
    with pytest.raises(ValueError, match="at least one"):
        format_instruction([])
