import pytest

from planning import Goal, Instruction, Thing
from tests.planning.conftest import put_in


def test_instruction_text_round_trip() -> None:
    instruction = put_in("red", "blue")
    assert instruction.text == "put the red block in the blue bowl"
    assert Instruction.parse(instruction.text) == instruction


@pytest.mark.parametrize(
    "text",
    ["", "put the red block in the blue bowl and the green block in the gray bowl"],
)
def test_instruction_wants_exactly_one_pair(text: str) -> None:
    with pytest.raises(ValueError, match="expected one"):
        Instruction.parse(text)


def test_goal_of_the_environments_grammar() -> None:
    goal = Goal.parse("put the red block in the blue bowl and the green block in the gray bowl")
    assert goal.instructions == (put_in("red", "blue"), put_in("green", "gray"))
    assert goal.things == (
        Thing("red", "block"),
        Thing("blue", "bowl"),
        Thing("green", "block"),
        Thing("gray", "bowl"),
    )


def test_goal_is_checked() -> None:
    with pytest.raises(ValueError, match="at least one instruction"):
        Goal.parse("")
    with pytest.raises(ValueError, match="each thing once"):
        Goal((put_in("red", "blue"), put_in("red", "gray")))


@pytest.mark.parametrize("read", [Goal.parse, Instruction.parse])
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("do not put the red block in the blue bowl", "says what shall not be"),
        ("place the red block into the blue bowl", "cannot read 'place the red block into the blue bowl'"),
        (
            "put the red block in the blue bowl and the green block into the gray bowl",
            "cannot read 'the green block into the gray bowl' in 'put the red",
        ),
    ],
)
def test_what_cannot_be_read_is_named_and_never_left_out(read, text: str, says: str) -> None:
    with pytest.raises(ValueError, match=f"{says}.*form 'put the|{says}.*form is 'put the"):
        read(text)


def test_then_and_commas_stand_between_instructions_too() -> None:
    goal = Goal.parse("Put the red block in the blue bowl, then put the green block in the gray bowl.")
    assert goal.instructions == (put_in("red", "blue"), put_in("green", "gray"))
