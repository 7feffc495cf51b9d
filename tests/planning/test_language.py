import pytest

from planning import Goal, Instruction, Thing
from tests.planning.conftest import put_in


def test_instruction_text_round_trip() -> None:
    instruction = put_in("red", "blue")
    assert instruction.text == "put the red block in the blue bowl"
    assert Instruction.parse(instruction.text) == instruction


@pytest.mark.parametrize("text", ["", "put the red block in the blue bowl and the green block in the gray bowl"])
def test_instruction_wants_exactly_one_pair(text: str) -> None:
    with pytest.raises(ValueError, match="expected one"):
        Instruction.parse(text)


def test_goal_of_the_environments_grammar() -> None:
    goal = Goal.parse("put the red block in the blue bowl and the green block in the gray bowl")
    assert goal.instructions == (put_in("red", "blue"), put_in("green", "gray"))
    assert goal.things == (Thing("red", "block"), Thing("blue", "bowl"), Thing("green", "block"), Thing("gray", "bowl"))


@pytest.mark.parametrize(
    ("text", "unread"),
    [
        ("hello", "hello"),
        ("do not put the red block in the blue bowl", "do not put the red block in the blue bowl"),
        ("put the red block in the blue bowl, not in the gray bowl", "not in the gray bowl"),
        ("put the red block in the blue bowl and sing", "and sing"),
        ("place the red block into the blue bowl", "place the red block into the blue bowl"),
        ("put the red block in the blue bowl \N{CYRILLIC SMALL LETTER YA}", "\N{CYRILLIC SMALL LETTER YA}"),
        ("put the big red wooden block in the blue bowl", "put the big red wooden block in the blue bowl"),
    ],
)
def test_a_goal_is_read_as_a_whole_or_refused_with_its_text_and_the_forms(text: str, unread: str) -> None:
    with pytest.raises(ValueError) as refused:
        Goal.parse(text)
    message = str(refused.value)
    assert f"cannot read {unread!r} in {text!r}" in message
    assert "'put the <color> block in the <color> bowl' or 'put the <color> block on the <color> block'" in message


def test_a_goal_of_several_sentences_in_capitals_with_names_of_two_words() -> None:
    goal = Goal.parse("Put the light blue blocks in a gray bowl. Then put the red block on the brown block!")
    on = Instruction("on", Thing("red", "block"), Thing("brown", "block"))
    assert goal.instructions == (put_in("light blue", "gray"), on)


def test_goal_is_checked() -> None:
    with pytest.raises(ValueError, match="at least one instruction"):
        Goal.parse("")
    with pytest.raises(ValueError, match="each thing once"):
        Goal((put_in("red", "blue"), put_in("red", "gray")))
    with pytest.raises(ValueError, match="'put the red block in the red bowl' names two things of one colour"):
        Goal.parse("put the red block in the red bowl")
    with pytest.raises(ValueError, match="'octarine' in 'put the octarine block in the blue bowl'"):
        Goal.parse("put the octarine block in the blue bowl")
    with pytest.raises(TypeError, match="must be a string, not int"):
        Goal.parse(3)  # type: ignore[arg-type]


def test_then_and_commas_stand_between_instructions_too() -> None:
    goal = Goal.parse("Put the red block in the blue bowl, then put the green block in the gray bowl.")
    assert goal.instructions == (put_in("red", "blue"), put_in("green", "gray"))
