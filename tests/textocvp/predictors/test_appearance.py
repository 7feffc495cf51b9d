"""Words matched with what slots look like: what is learned from which slots act, and what it changes."""

from __future__ import annotations

import pytest
import torch

from tests.textocvp.predictors.test_predictors import EXPLICIT, IMPLICIT, TEXTS, build, scene, text
from textocvp.predictors.appearance import Appearance, acting_loss
from textocvp.slots import SlotState
from textocvp.training.losses import acting

DIM = 32
# Words: 0 to 3 are colours, 4 to 7 shapes, 8 names nothing; a name is a colour and a shape.
EMBEDDINGS = torch.eye(DIM)[:9]
NOTHING = 8


def drawn(batch: int, generator: torch.Generator, held_out: bool = False):
    """Slots with a colour and a shape, words that name one of them somewhere, and which slot acts.

    Colour i with shape i is never named, unless it is `held_out`: then nothing else is.
    """
    K = 5
    colors, shapes = (torch.randint(4, (batch, K), generator=generator) for _ in range(2))
    named = torch.randint(4, (batch,), generator=generator)  # number of a slot
    rows = torch.arange(batch)
    shapes[rows, named] = (
        colors[rows, named] + (0 if held_out else torch.randint(1, 4, (batch,), generator=generator))
    ) % 4
    for k in range(K):  # none is like the named one
        alike = (colors[:, k] == colors[rows, named]) & (shapes[:, k] == shapes[rows, named]) & (named != k)
        colors[alike, k] = (colors[alike, k] + 1) % 4
    content = torch.nn.functional.one_hot(shapes, EXPLICIT.content).float()
    rgb = torch.tensor([[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, -1]])[colors]
    ids = torch.full((batch, 7), NOTHING)
    at = torch.randint(1, 7, (batch,), generator=generator)
    ids[rows, at - 1], ids[rows, at] = colors[rows, named], 4 + shapes[rows, named]
    presence = torch.ones(batch, K, 1)
    presence[:, 4] = 0
    place = torch.rand(batch, K, 2, generator=generator) * 2 - 1
    state = SlotState(content, rgb, place, torch.full((batch, K, 2), 0.1), presence)
    return state, EMBEDDINGS[ids], torch.nn.functional.one_hot(named, K).bool(), at


def test_who_acts_teaches_what_words_mean_also_in_names_that_were_never_said() -> None:
    torch.manual_seed(0)
    model, generator = Appearance(EXPLICIT, DIM), torch.Generator().manual_seed(1)
    optimizer = torch.optim.Adam(model.parameters(), 5e-3)
    for _ in range(400):
        state, words, acts, _ = drawn(64, generator)
        mask = torch.ones(words.shape[:2])
        loss = acting_loss(*model(state.content, state, words, mask), acts, state.is_thing[..., 0])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.15  # who acts at random would cost .56
    for held_out in (False, True):
        state, words, acts, at = drawn(200, generator, held_out)
        shares, names = model.eval()(state.content, state, words, torch.ones(words.shape[:2]))
        rows = torch.arange(200)
        assert (shares[rows, :, at].argmax(1) == acts.int().argmax(1)).float().mean() > 0.9
        assert names[rows, at].mean() > 0.6
        assert names[(words == EMBEDDINGS[NOTHING]).all(-1)].mean() < 0.25


def test_a_word_that_names_nothing_speaks_of_what_was_named_last() -> None:
    shares = torch.tensor([[0.9, 0.1], [0.2, 0.8]]).log()[None]  # (B, K, 2 names)
    shares = torch.stack(
        [shares[0, :, 0], torch.full((2,), 0.5).log(), shares[0, :, 1], torch.full((2,), 0.5).log()], 1
    )[None]
    names = torch.tensor([[1.0, 0.0, 1.0, 0.0]])
    bias = Appearance.bias(shares, names)
    assert torch.allclose(bias[..., 1], bias[..., 0], atol=1e-2) and torch.allclose(
        bias[..., 3], bias[..., 2], atol=1e-2
    )
    assert bias[0, 0, 0] == 0 and bias[0, 1, 0] < -1
    before = Appearance.bias(shares.flip(2), names.flip(1))
    assert before[0, :, 0].abs().max() < 1e-6  # nothing was named yet


def test_shares_are_of_things_alone_and_padding_says_nothing() -> None:
    state, words, _, _ = drawn(3, torch.Generator().manual_seed(2))
    mask = torch.ones(3, 7)
    mask[:, 4:] = 0
    shares, speaks = Appearance(EXPLICIT, DIM)(state.content, state, words, mask)
    assert torch.allclose(shares.exp().sum(1), torch.ones(3, 7), atol=1e-5)
    assert shares[:, 4].exp().max() == 0  # unused
    assert speaks[:, 4:].max() == 0
    assert Appearance.bias(shares, speaks).amax(1).abs().max() < 1e-6


def test_of_two_that_are_alike_one_is_meant() -> None:
    state, words, _, _ = drawn(1, torch.Generator().manual_seed(3))
    state.content[:] = state.content[:, :1]
    state.position[:] = torch.tensor([0.5, 0.0])
    state.position[0, 2, 0] = -0.5
    state.color[:] = state.color[:, :1]
    model = Appearance(EXPLICIT, DIM)
    with torch.no_grad():
        model.size[0].weight[:, :2] = 0  # looks do not depend on the place
    shares, _ = model.eval()(state.content, state, words, torch.ones(1, 7))
    assert (shares[0].argmax(0) == 2).all()  # the left one, for every word
    told = torch.tensor([[True, False, False, False, False]])
    shares, _ = model(state.content, state, words, torch.ones(1, 7), told)
    assert (shares[0].argmax(0) == 0).all()  # but for who is known to act


def test_the_match_decides_what_the_words_do() -> None:
    model, slots = build(color_bias=False, appearance=True), scene(frames=1)
    with torch.no_grad():
        free = model.rollout(slots, text(), 3).slots_BSKD
        told = torch.zeros(2, slots.shape[2], dtype=torch.bool)
        told[:, 1] = True
        one = model.rollout(slots, text(), 3, acting_BK=told).slots_BSKD
    assert (free - one).abs().max() > 1e-4
    loss = model.words_loss(text(), slots[:, 0], told, torch.ones_like(told))
    loss.backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.appearance.parameters())
    assert len(TEXTS) == 2


def test_slots_stay_a_set() -> None:
    model, slots = build(color_bias=False, appearance=True), scene(frames=2)
    order = torch.randperm(slots.shape[2], generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        rolled = model.rollout(slots, text(), 3).slots_BSKD
        shuffled = model.rollout(slots[:, :, order], text(), 3).slots_BSKD
    torch.testing.assert_close(shuffled, rolled[:, :, order], atol=1e-5, rtol=1e-4)


def test_options_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="exclude each other"):
        build(appearance=True)
    with pytest.raises(ValueError, match="explicit"):
        build(layout=IMPLICIT, color_bias=False, appearance=True)


def test_who_acts_is_seen_in_the_slots() -> None:
    slots = scene(batch=1, frames=5, slots=6, absent=1)
    state = SlotState.split(slots, EXPLICIT)
    for name in ("content", "position", "scale"):
        part = getattr(state, name)
        part[:] = part[:, :1]
    state.position[0, :, :5, 0] = torch.linspace(-0.8, 0.8, 5)  # apart from each other
    state.position[0, :, :5, 1] = 0
    std = torch.ones(EXPLICIT.content)
    assert not acting(state.join(), EXPLICIT, std)[1].any()
    state.position[0, :, 1, 1] = torch.linspace(0, 0.5, 5)  # goes away
    state.content[0, 3:, 2] += 1.0  # turns
    acts, may = acting(state.join(), EXPLICIT, std)
    assert acts[0].tolist() == [False, True, False, False, False, False]
    assert may[0].tolist() == [False, True, True, False, False, False]
    state.position[0, :, 1, 1] = 0
    state.position[0, :, 1, 0] = torch.linspace(-0.4, 0.8, 5)  # is put onto the last one
    assert acting(state.join(), EXPLICIT, std)[0][0].tolist() == [False, True, False, False, True, False]
