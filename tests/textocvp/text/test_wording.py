"""Other wordings: what they become, what is refused, and that a model's own sentences stay as they are."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from planning import Goal
from tests.textocvp.conftest import PLACED, build
from textocvp import WorldModel
from textocvp.presets import TABLETOP_REWRITES, TABLETOP_WORDS
from textocvp.text import build_text_encoder
from textocvp.text.wording import compile_rules, match_form, reword
from textocvp.text.words import MOST_FORMS, WordsConfig
from textocvp.world_model import bundled_checkpoints

PLAIN = "put the red block in the blue bowl"
SAME = [
    "Put the RED block in the blue bowl!",
    "put red block in blue bowl",
    "place the red block into the blue bowl",
    "move the red cube inside the blue dish",
    "please set the red block in a blue bowl",
    "Could you drop the red blocks inside of the blue dishes?",
    "in the blue bowl put the red block",
    "Into the blue bowl, please place a red cube.",
    "pick up the red block and put it in the blue bowl",
    "take the red block and place it into the blue bowl",
    "Pick up the red block. Put it in the blue bowl.",
    "Take the red cube, then drop it into the blue dish",
    "Grab the red block and set it down inside the blue bowl!",
    "the red block should go into the blue bowl",
    "I want the red block in the blue bowl",
    "I'd like you to have the red block placed in the blue bowl.",
    "to the blue bowl move the red block",
    "put all of the red blocks in the blue bowl",
    "Hi robot, would you mind putting the red block into the blue bowl? Thanks!",
    "red block in blue bowl",
]


@pytest.fixture(scope="module")
def shipped() -> WorldModel:
    return WorldModel.from_pretrained()


@pytest.mark.parametrize("text", SAME)
def test_a_paraphrase_is_encoded_as_what_the_model_was_trained_on(shipped: WorldModel, text: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert shipped.reads(text) == PLAIN
    tokens, plain = shipped.model.text([text]), shipped.model.text([PLAIN])
    assert torch.equal(tokens.embeddings_BLC, plain.embeddings_BLC)
    assert torch.equal(tokens.colors_BL3, plain.colors_BL3)
    assert Goal.parse(shipped.reads(text)) == Goal.parse(PLAIN)


@pytest.mark.parametrize(
    ("text", "unknown"),
    [
        ("drop the red box into the blue basin", ["box"]),
        ("inside the blue bowl, place the red one", ["one"]),
        ("Find the blue bowl. Put the red block in it.", ["it"]),
        ("the block that is red should end up in the bowl that is blue", ["is"]),
        ("Fill the blue bowl with the red block", ["fill", "with"]),
        ("put the big red wooden block from the table into the blue bowl", ["big", "wooden", "from", "table"]),
        ("Pick up the red block. The red block should go in the blue bowl.", []),
        ("Next, red block, blue bowl!", []),
    ],
)
def test_what_a_sentence_names_decides_its_form(shipped: WorldModel, text: str, unknown: list[str]) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert shipped.reads(text) == PLAIN
    assert shipped.model.text.unknown_words(text) == unknown
    named = " ".join(str(warning.message) for warning in caught)
    assert len(caught) == bool(unknown) and all(repr(word) in named for word in unknown)


@pytest.mark.parametrize(
    "text",
    [
        "put the red block next to the blue bowl",
        "put the red block under the blue bowl",
        "take the red block out of the blue bowl",
        "move the red block to the left of the blue bowl",
        "put the red block in front of the blue bowl",
        "put the blue bowl in the red block",
        "put the red block on the blue bowl",
        "swap the red block and the blue block",
        "put the red block and the green block in the blue bowl",
        "put the red thing in the blue thing",
    ],
)
def test_another_place_or_another_number_of_things_is_no_form(shipped: WorldModel, text: str) -> None:
    with pytest.warns(UserWarning, match="trained on 'put the {} block in the {} bowl'"):
        shipped.reads(text)


def test_two_of_one_noun_are_told_apart_by_the_word_between(shipped: WorldModel) -> None:
    assert match_form(["b", "{}", "on", "{}", "b"], ("a {} b on {} b",), "{}".__eq__, "ab on".__contains__) is None
    forms = ("put the {} cup on the {} cup", "put the {} cup in the {} pot")
    known = {word for form in forms for word in form.split()} - {"{}"}
    colors = {"red", "blue", "gray"}

    def read(text: str) -> str | None:
        found = match_form(text.split(), forms, colors.__contains__, (known | colors).__contains__)
        return found and " ".join(found)

    on = "put the red cup on the blue cup"
    for text in (on, "on the blue cup the red cup", "balance the red cup on the blue thing", "red cup on blue cup"):
        assert read(text) == on
    for text in (
        "the red cup and the blue cup",
        "red cup beside blue cup",
        "on the red cup on the blue cup",
        "red cup",
    ):
        assert read(text) is None
    assert read("the gray pot holds the red cup") == "put the red cup in the gray pot"
    assert read("put the red cup on the gray pot") is None


def test_what_stands_on_something_is_no_bowl(shipped: WorldModel) -> None:
    on = "put the red block on the green block"
    for text in ("on the green block put the red block", "Stack the red cube on top of the green cube", on):
        assert shipped.reads(text) == on


@pytest.mark.parametrize("name", [name for name in bundled_checkpoints() if name not in ("mage-small", "cater")])
def test_sentences_of_the_captions_stay_as_they_are(name: str) -> None:
    """The rules change no embedding of a plain sentence, to the last bit."""
    encoder = WorldModel.from_pretrained(name).model.text
    plain = [form.format("light blue", "gray") for form in encoder.config.forms]
    ruled = encoder(plain).embeddings_BLC
    assert len(plain) >= 1 and encoder.config.rewrites == TABLETOP_REWRITES
    encoder.config = WordsConfig(**{**vars(encoder.config), "rewrites": ()})
    assert torch.equal(ruled, encoder(plain).embeddings_BLC)


@pytest.mark.parametrize(
    "text",
    [
        f"do not {PLAIN}",
        f"don't {PLAIN}",
        f"don\N{RIGHT SINGLE QUOTATION MARK}t {PLAIN}",
        f"never {PLAIN}",
        "put nothing in the blue bowl",
        "stop putting the red block in the blue bowl",
        "refrain from putting the red block in the blue bowl",
        "put the red block anywhere but in the blue bowl",
        "keep the red block out of the blue bowl",
        "leave the red block outside the blue bowl",
    ],
)
def test_a_negation_is_refused_with_its_text(placed_world_model: WorldModel, scene: np.ndarray, text: str) -> None:
    with pytest.raises(ValueError, match="never met: it would imagine what is not to be") as refused:
        placed_world_model.rollout(scene, [PLAIN, text], horizon=1)
    assert repr(text) in str(refused.value)


def test_a_negation_that_captions_contain_is_read() -> None:
    encoder = build_text_encoder(PLACED.text.for_captions([f"do not {PLAIN}"]))
    assert encoder.negations(f"do not {PLAIN}, never") == ["never"]
    assert encoder.words(f"do not {PLAIN}")[:2] == ["do", "not"]


def test_an_order_that_no_caption_has_is_a_warning(shipped: WorldModel) -> None:
    for text in ("red block the put bowl blue in", f"{PLAIN} and the green block in the gray bowl", "put"):
        with pytest.warns(UserWarning, match=r"trained on 'put the \{\} block in the \{\} bowl'") as caught:
            shipped.reads(text)
        assert repr(text) in str(caught[0].message)


def test_another_script_is_named(shipped: WorldModel, placed_world_model: WorldModel, scene: np.ndarray) -> None:
    text = "\N{CYRILLIC SMALL LETTER YA}"
    with pytest.raises(ValueError, match="at least one word that the model knows, got '\N{CYRILLIC SMALL LETTER YA}'"):
        placed_world_model.rollout(scene, text)
    with pytest.warns(UserWarning, match=f"never met '{text}'"):
        assert shipped.reads(f"{PLAIN} {text}") == PLAIN


def test_rules_are_for_whole_words_and_longer_wordings_come_first() -> None:
    rules = ("on | on top of => over", "a {x} b {y} => {y} {x}", "please => ")
    assert reword("Please, button ON top of it; on and on!", rules) == ["button", "over", "it", "over", "and", "over"]
    assert reword("a one two b three", rules) == ["three", "one", "two"]
    assert reword("do a one b two", rules) == ["do", "a", "one", "b", "two"]


@pytest.mark.parametrize(
    "rule", ["in", "=> in", "a | => b", "{x} {x} => {x}", "{x} => {y}", "{x} | a => b", r"\d => {"]
)
def test_what_is_no_rule_is_refused(rule: str) -> None:
    with pytest.raises(ValueError, match="is no rule: write"):
        compile_rules((rule,))
    with pytest.raises(ValueError, match=r"text\.rewrites: .* is no rule"):
        WordsConfig(rewrites=(rule,))


def test_forms_are_learned_from_captions_and_foreign_rules_dropped() -> None:
    config = WordsConfig(vocabulary=TABLETOP_WORDS, rewrites=TABLETOP_REWRITES)
    own = config.for_captions([PLAIN, "put the gray block in the white bowl", "put the cyan block on the red block"])
    assert set(own.forms) == {"put the {} block in the {} bowl", "put the {} block on the {} block"}
    assert own.rewrites == TABLETOP_REWRITES and "on" not in own.untrained
    later = own.met(["put the red block with the green block"])
    assert later.forms == (*own.forms, "put the {} block with the {} block")
    assert set(own.untrained) - set(later.untrained) == {"with"}
    others = config.for_captions(["place the cube on a dish"])  # these rules would make other words of its words
    assert others.rewrites == () and others.tokens("place the cube on a dish") == [
        "place",
        "the",
        "cube",
        "on",
        "a",
        "dish",
    ]
    free = config.for_captions([f"{'very ' * n}well" for n in range(MOST_FORMS + 1)])
    assert free.forms == ()
    encoder = build(PLACED).text
    assert encoder.forms_but("red put") == ()  # nobody listed any
