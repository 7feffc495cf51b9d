"""What tasks say and understand."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.colors import COLORS
from envs.geometry import Sizes
from envs.spaces import CHARSET
from envs.splits import SPLITS
from envs.tasks import TASKS, In

TASK = TASKS["put_blocks_in_bowls"]
between = In().between

names = st.sampled_from(sorted(COLORS))
pairs = st.lists(st.tuples(names, names), min_size=1, max_size=3, unique_by=lambda pair: pair[0])


@given(pairs)
def test_parsing_undoes_formatting(wanted: list[tuple[str, str]]) -> None:
    steps = tuple(between(*pair) for pair in wanted)
    text = TASK.format(steps)
    assert TASK.parse(text) == steps
    assert set(text) <= set(CHARSET)


def test_the_sentence_is_the_papers() -> None:
    assert TASK.format([between("red", "blue")]) == "put the red block in the blue bowl"
    assert TASK.format([between("red", "blue"), between("green", "yellow")]) == (
        "put the red block in the blue bowl and the green block in the yellow bowl"
    )


def test_case_spaces_and_full_stop_do_not_matter() -> None:
    assert TASK.parse("  Put the RED  block in the blue bowl. ") == (between("red", "blue"),)


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
        TASK.parse(text)


def test_formatting_refuses_unknown_colours_and_nothing() -> None:
    with pytest.raises(ValueError, match="unknown colour 'mauve'"):
        TASK.format([between("red", "mauve")])
    with pytest.raises(ValueError, match="at least one"):
        TASK.format([])


@pytest.mark.parametrize("name", TASKS)
def test_the_vocabulary_is_exactly_the_words_of_all_sentences(name: str) -> None:
    task = TASKS[name]
    said = set()
    for relation in task.relations:
        for colors in permutations(COLORS, 2):
            said |= set(task.format([relation.between(*colors)] * task.pairs[1]).split())
    assert set(task.vocabulary) == said and len(task.vocabulary) == len(said)


@pytest.mark.parametrize("name", SPLITS)
def test_the_questions_of_a_scene_are_every_block_in_every_bowl(name: str) -> None:
    task = TASKS[SPLITS[name].task]
    for seed in range(10):
        objects = task.sample(np.random.default_rng(seed), task.request(), Sizes()).objects
        expected = {
            (f"put the {block.color} block in the {bowl.color} bowl", i, j)
            for i, block in enumerate(objects)
            for j, bowl in enumerate(objects)
            if (block.kind, bowl.kind) == ("block", "bowl")
        }
        questions = task.questions(objects)
        assert set(questions) == expected and len(questions) == len(expected) >= 5
        for question in questions:
            (pair,) = task.find_goal(objects, task.parse(question.text))
            assert (pair.thing, pair.target) == (question.moves, question.ends_at)
