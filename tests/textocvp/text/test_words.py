"""Encoders of words: what they know, what padding does, and that colours are looked up, not learned by name."""

from __future__ import annotations

import pytest
import torch

from textocvp.presets import TABLETOP_COLORS, TABLETOP_WORDS
from textocvp.text import build_text_encoder
from textocvp.text.base import TextEncoder
from textocvp.text.words import COLOR, TABLEAU_10, WordsConfig, palette

CAPTION = "put the red block in the gray bowl"


WORDS = {"lexicon": TABLETOP_WORDS, "transformer": TABLETOP_WORDS + TABLETOP_COLORS}


def encoder(kind: str, **changes: object) -> TextEncoder:
    torch.manual_seed(0)
    return build_text_encoder(WordsConfig(kind, 32, hidden=64, **{"vocabulary": WORDS[kind], **changes})).eval()


@pytest.mark.parametrize("kind", ["transformer", "lexicon"])
def test_padding_changes_nothing(kind):
    model = encoder(kind)
    alone = model([CAPTION])
    longer = "put the red block in the gray bowl and the blue block in the green bowl"
    together = model([CAPTION, longer])
    length = alone.mask_BL.shape[1]
    assert together.mask_BL.sum(dim=1).tolist() == [8, 16]
    torch.testing.assert_close(together.embeddings_BLC[:1, :length], alone.embeddings_BLC)
    assert together.embeddings_BLC[0, length:].abs().max() == 0


@pytest.mark.parametrize("kind", ["transformer", "lexicon"])
def test_word_order_and_every_word_matter(kind):
    model = encoder(kind)
    tokens = model([CAPTION, "put the gray block in the red bowl"]).embeddings_BLC
    assert (tokens[0] - tokens[1]).abs().amax(dim=-1).min() > 1e-4


def test_unknown_words_are_named_once_and_in_order():
    assert encoder("lexicon").unknown_words("Put the Zorble block in the wug bowl, zorble!") == ["zorble", "wug"]
    assert encoder("lexicon").unknown_words("put the turquoise block in the light blue bowl") == []
    assert encoder("transformer").unknown_words("put the red block in the turquoise bowl") == ["turquoise"]


def test_words_that_no_caption_contained_are_unknown_too_and_left_out():
    config = WordsConfig(untrained=("move", "onto"), vocabulary=(*TABLETOP_WORDS, "onto"))
    model = build_text_encoder(config)
    assert model.unknown_words("move the red block onto the blue bowl, move!") == ["move", "onto"]
    with_them, without = "move the red block zorble onto the bowl", "the red block the bowl"
    assert model.words(with_them) == without.split()
    assert torch.equal(model([with_them]).embeddings_BLC, model([without]).embeddings_BLC)
    with pytest.raises(ValueError, match=r"got 'move onto'; it knows put, the, .*names of colours"):
        model(["move onto"])


def test_the_vocabulary_is_in_the_configuration():
    model = encoder("lexicon", vocabulary=("stack", "the"))
    assert model.embedding.weight.shape == (3 + 2, 32)
    assert model.unknown_words("stack the red block") == ["block"]
    for wrong, message in (
        ({"vocabulary": ("put", "put")}, "word twice"),
        ({"vocabulary": ("Put",)}, "'Put' is no word"),
        ({"untrained": ("stack",)}, "'stack' is not in text.vocabulary"),
    ):
        with pytest.raises(ValueError, match=message):
            WordsConfig(**wrong)


def test_new_captions_bring_new_words_and_old_ones_keep_their_rows():
    lexicon = WordsConfig(vocabulary=("the", "in", "red")).for_captions(["Stack the red block on the light block"])
    assert lexicon.vocabulary == ("the", "in", "red", "block", "light", "on", "stack")  # red has a row already
    assert lexicon.untrained == ("in",)
    lexicon = WordsConfig().for_captions(["put the red block"], vocabulary=("under", "gray", "put"))
    assert lexicon.vocabulary == ("under", "put", "block", "the")  # red and gray are in the palette
    words = WordsConfig("transformer", vocabulary=("in",)).for_captions(
        [CAPTION], ("under", "gray", "red", "in", "a/b")
    )
    assert words.vocabulary == ("in", "under", "gray", "red", "block", "bowl", "put", "the")
    assert words.untrained == ("under",)
    assert WordsConfig().vocabulary == ()


def test_colors_of_the_lexicon_differ_in_rgb_only():
    model = encoder("lexicon")
    words = model.lookup(["put the red block in the turquoise bowl"])
    named = words.names_color_BL[0]
    assert named.tolist() == [False, False, True, False, False, False, True, False]
    assert (words.ids_BL[0][named] == COLOR).all()
    torch.testing.assert_close(words.colors_BL3[0, 2], torch.tensor(palette()["red",]) * 2 - 1)
    assert (words.colors_BL3[0][~named] == 0).all()
    assert not encoder("transformer").lookup([CAPTION]).names_color_BL.any()


def test_a_color_name_of_two_words_is_one_token():
    assert encoder("lexicon").words("Put the light blue block") == ["put", "the", "light blue", "block"]
    words = (*WORDS["transformer"], "light")
    assert encoder("transformer", vocabulary=words).words("Put the light blue block") == [
        "put",
        "the",
        "light",
        "blue",
        "block",
    ]


def test_palettes_are_asked_in_order():
    assert palette()["red",] == pytest.approx((225 / 255, 87 / 255, 89 / 255))  # Tableau, not CSS or XKCD
    assert palette()["turquoise",] == pytest.approx((64 / 255, 224 / 255, 208 / 255))  # CSS, not XKCD
    assert ("windows", "blue") in palette()  # XKCD only
    assert ("wug",) not in palette() and len(palette()) > 900 and len(TABLEAU_10) == 12


def test_channel_permutation_moves_colors_only():
    words = encoder("lexicon").lookup([CAPTION, CAPTION])
    order = torch.tensor([[2, 0, 1], [0, 1, 2]])
    permuted = words.permute_channels(order)
    torch.testing.assert_close(permuted.colors_BL3[0], words.colors_BL3[0][:, [2, 0, 1]])
    torch.testing.assert_close(permuted.colors_BL3[1], words.colors_BL3[1])
    assert permuted.ids_BL is words.ids_BL


def test_bad_texts():
    model = encoder("lexicon")
    for empty in ("", "  ", "?!"):
        with pytest.raises(ValueError, match="at least one word"):
            model([CAPTION, empty])
    with pytest.raises(ValueError, match="at most 64 words"):
        model(["put " * 65])
    with pytest.raises(TypeError, match="sequence of sentences"):
        model(CAPTION)


def test_gradients_reach_every_parameter_that_was_used():
    model = encoder("lexicon")
    model([CAPTION]).embeddings_BLC.square().sum().backward()
    unused = [name for name, p in model.named_parameters() if p.grad is None]
    assert unused == []
    assert model.color_projection.weight.grad.abs().max() > 0
