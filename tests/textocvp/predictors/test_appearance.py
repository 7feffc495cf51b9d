"""Words matched with what slots look like: what is learned from which slots act, and what it changes."""

from __future__ import annotations

import pytest
import torch

from tests.textocvp.predictors.test_predictors import EXPLICIT, IMPLICIT, TEXTS, build, scene, text
from textocvp.predictors.appearance import Appearance, acting_loss
from textocvp.slots import SlotState
from textocvp.training.losses import acting

WORDS, DIM = 6, 32


def drawn(
    batch: int, generator: torch.Generator
) -> tuple[SlotState, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Slots of which one has the look that one word names; the word and the slot are elsewhere each time."""
    K, C = 5, EXPLICIT.content
    looks, words = torch.eye(C)[:4], torch.eye(DIM)[:4]  # four looks and their names
    kinds = torch.stack([torch.randperm(4, generator=generator) for _ in range(batch)])
    content = torch.cat([looks[kinds], torch.zeros(batch, 1, C)], 1)
    named = torch.randint(4, (batch,), generator=generator)  # number of a slot
    embeddings = 0.1 * torch.randn(batch, WORDS, DIM, generator=generator)
    at = torch.randint(WORDS, (batch,), generator=generator)
    embeddings[torch.arange(batch), at] = words[kinds[torch.arange(batch), named]]
    presence = torch.ones(batch, K, 1)
    presence[:, 4] = 0
    place = torch.rand(batch, K, 2, generator=generator) * 2 - 1
    state = SlotState(content, torch.zeros(batch, K, 3), place, torch.full((batch, K, 2), 0.1), presence)
    acts = torch.nn.functional.one_hot(named, K).bool()
    return state, embeddings, acts, at


def test_who_acts_teaches_which_word_speaks_of_what() -> None:
    torch.manual_seed(0)
    model, generator = Appearance(EXPLICIT, DIM), torch.Generator().manual_seed(1)
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    mask = torch.ones(64, WORDS)
    for _ in range(250):
        state, words, acts, _ = drawn(64, generator)
        loss = acting_loss(*model(state.content, state, words, mask), acts, state.is_thing[..., 0])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.1  # who acts at random would cost .56
    state, words, acts, at = drawn(200, generator)
    shares, speaks = model.eval()(state.content, state, words, torch.ones(200, WORDS))
    rows = torch.arange(200)
    meant = shares[rows, :, at].argmax(1)
    assert (meant == acts.int().argmax(1)).float().mean() > 0.97
    others = torch.ones(200, WORDS, dtype=torch.bool)
    others[rows, at] = False
    assert speaks[rows, at].mean() > 0.8 and speaks[others].mean() < 0.1


def test_shares_are_of_things_alone_and_padding_says_nothing() -> None:
    state, words, _, _ = drawn(3, torch.Generator().manual_seed(2))
    mask = torch.ones(3, WORDS)
    mask[:, 4:] = 0
    shares, speaks = Appearance(EXPLICIT, DIM)(state.content, state, words, mask)
    assert torch.allclose(shares.exp().sum(1), torch.ones(3, WORDS), atol=1e-5)
    assert shares[:, 4].exp().max() == 0  # unused
    assert speaks[:, 4:].max() == 0
    assert Appearance.bias(shares, speaks).amax(1).eq(0).all()


def test_of_two_that_are_alike_one_is_meant() -> None:
    state, words, _, _ = drawn(1, torch.Generator().manual_seed(3))
    state.content[:] = state.content[:, :1]
    state.position[:] = torch.tensor([0.5, 0.0])
    state.position[0, 2, 0] = -0.5
    model = Appearance(EXPLICIT, DIM)
    with torch.no_grad():
        model.looks[0].weight[:, -4:-2] = 0  # looks do not depend on the place
    shares, _ = model.eval()(state.content, state, words, torch.ones(1, WORDS))
    assert (shares[0].argmax(0) == 2).all()  # the left one, for every word
    told = torch.tensor([[True, False, False, False, False]])
    shares, _ = model(state.content, state, words, torch.ones(1, WORDS), told)
    assert (shares[0].argmax(0) == 0).all()  # but for who is known to act


def test_the_match_decides_what_the_words_do() -> None:
    model, slots = build(color_bias=False, appearance=True), scene(frames=1)
    with torch.no_grad():
        free = model.rollout(slots, text(), 3).slots_BSKD
        told = torch.zeros(2, slots.shape[2], dtype=torch.bool)
        told[:, 1] = True
        one = model.rollout(slots, text(), 3, acting_BK=told).slots_BSKD
    assert (free - one).abs().max() > 1e-4
    loss = model.words_loss(text(), slots[:, 0], told)
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
    assert not acting(state.join(), EXPLICIT, std).any()
    state.position[0, :, 1, 1] = torch.linspace(0, 0.5, 5)  # goes away
    state.content[0, 3:, 2] += 1.0  # turns
    assert acting(state.join(), EXPLICIT, std)[0].tolist() == [False, True, True, False, False, False]
    state.position[0, :, 1, 1] = 0
    state.position[0, :, 1, 0] = torch.linspace(-0.4, 0.8, 5)  # is put onto the last one
    assert acting(state.join(), EXPLICIT, std)[0].tolist() == [False, True, True, False, True, False]
