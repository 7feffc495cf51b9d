"""The predictor: published size, slots as a set, causality, the cache, and what explicit slots may do."""

from __future__ import annotations

import pytest
import torch

from textocvp.config import PredictorConfig, TextConfig
from textocvp.predictor import Predictor
from textocvp.predictor_layer import color_match
from textocvp.slots import SlotLayout, SlotState
from textocvp.text import build_text_encoder

EXPLICIT = SlotLayout(content=6)
IMPLICIT = SlotLayout(content=12, explicit=False)
TEXTS = [
    "put the red block in the gray bowl",
    "put the teal block in the yellow bowl and the red block in the blue bowl",
]


def build(attention="causal", layout=EXPLICIT, **changes) -> Predictor:
    torch.manual_seed(1)
    sizes = dict(dim=32, layers=3, heads=4, hidden=48, window=8, color_bias=layout.explicit, feed_forwards=1)
    model = Predictor(PredictorConfig(attention=attention, **{**sizes, **changes}), layout, 32).eval()
    with torch.no_grad():  # random networks barely move: make every path count
        model.slot_out.weight.mul_(5)
    return model


def scene(layout=EXPLICIT, batch=2, frames=4, slots=7, absent=2) -> torch.Tensor:
    """Random slots; in the explicit layout the last `absent` are unused."""
    generator = torch.Generator().manual_seed(2)
    if not layout.explicit:
        return torch.randn(batch, frames, slots, layout.dim, generator=generator)
    color = torch.rand(batch, 1, slots, 3, generator=generator).expand(-1, frames, -1, -1) * 2 - 1
    presence = torch.ones(batch, frames, slots, 1)
    presence[:, :, slots - absent :] = 0
    return SlotState(
        torch.randn(batch, frames, slots, layout.content, generator=generator),
        color,
        torch.rand(batch, frames, slots, 2, generator=generator) * 2 - 1,
        torch.rand(batch, frames, slots, 2, generator=generator) * 0.3 + 0.02,
        presence,
    ).join()


def text(texts=TEXTS):
    torch.manual_seed(3)
    return build_text_encoder(TextConfig(dim=32, hidden=64)).eval()(texts)


@pytest.mark.parametrize(
    ("slot_dim", "count"),
    [
        pytest.param(128, 33_761_408, id="TextOCVP"),
        pytest.param(512, 34_155_008, id="one holistic slot of 512"),
    ],
)
def test_published_parameter_count(slot_dim, count):
    with torch.device("meta"):
        model = Predictor(PredictorConfig(), SlotLayout(slot_dim, explicit=False), text_dim=512)
    assert sum(p.numel() for p in model.parameters() if p.requires_grad) == count


@pytest.mark.parametrize("attention", ["window", "causal"])
@pytest.mark.parametrize("layout", [EXPLICIT, IMPLICIT], ids=["explicit", "implicit"])
def test_slots_are_a_set(attention, layout):
    model, slots = build(attention, layout), scene(layout)
    order = torch.randperm(slots.shape[2], generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        rolled = model.rollout(slots, text(), 3).slots_BSKD
        shuffled = model.rollout(slots[:, :, order], text(), 3).slots_BSKD
    torch.testing.assert_close(shuffled, rolled[:, :, order], atol=1e-5, rtol=1e-4)
    assert (rolled[:, 0] - slots[:, -1]).abs().max() > 0.01


def test_causal_frames_do_not_see_the_future():
    model, slots = build(), scene(frames=6)
    changed = slots.clone()
    changed[:, 4:, :, : EXPLICIT.content] += 1.0
    with torch.no_grad():
        before, after = model(slots, text()), model(changed, text())
    torch.testing.assert_close(before[:, :4], after[:, :4])
    assert (before[:, 4:] - after[:, 4:]).abs().max() > 0.1


def test_forgetful_sequences_see_one_frame_at_a_time():
    model, slots = build(), scene(frames=4)
    changed = slots.clone()
    changed[:, 1, :, : EXPLICIT.content] += 1.0
    forgetful = torch.tensor([True, False])
    with torch.no_grad():
        before, after = model(slots, text(), forgetful), model(changed, text(), forgetful)
        torch.testing.assert_close(before[1], model(slots, text())[1])
    torch.testing.assert_close(before[0, [0, 2, 3]], after[0, [0, 2, 3]])
    assert (before[1, 2] - after[1, 2]).abs().max() > 1e-3


def test_window_frames_see_each_other_but_nothing_older_than_the_window():
    model = build("window", window=3)
    slots = scene(frames=5)
    changed = slots.clone()
    changed[:, :2, :, : EXPLICIT.content] += 1.0  # older than the window of the first step
    with torch.no_grad():
        assert torch.equal(
            model.rollout(slots, text(), 1).slots_BSKD, model.rollout(changed, text(), 1).slots_BSKD
        )
        model.rollout(slots, text(), 10)  # goes on for ever
        changed[:, 2, :, : EXPLICIT.content] += 1.0
        assert (
            model.rollout(slots, text(), 1).slots_BSKD - model.rollout(changed, text(), 1).slots_BSKD
        ).abs().max() > 0


@pytest.mark.parametrize("seed_frames", [1, 3])
@pytest.mark.parametrize("layout", [EXPLICIT, IMPLICIT], ids=["explicit", "implicit"])
def test_cached_and_uncached_rollouts_agree(layout, seed_frames):
    model, slots = build(layout=layout), scene(layout, frames=seed_frames)
    with torch.no_grad():
        cached = model.rollout(slots, text(), 5, return_attention=True)
        plain = model.rollout(slots, text(), 5, use_cache=False, return_attention=True)
    torch.testing.assert_close(cached.slots_BSKD, plain.slots_BSKD, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(cached.attention_BSnhKL, plain.attention_BSnhKL, atol=1e-5, rtol=1e-4)
    with_gradients = model.rollout(slots, text(), 5).slots_BSKD  # another cache implementation
    torch.testing.assert_close(with_gradients, cached.slots_BSKD, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("attention", ["window", "causal"])
def test_one_step_of_a_rollout_is_the_teacher_forced_prediction(attention):
    model, slots = build(attention), scene(frames=4)
    with torch.no_grad():
        forced = model(slots, text())[:, -1]
        rolled = model.rollout(slots, text(), 1).slots_BSKD[:, 0]
    torch.testing.assert_close(forced, rolled, atol=1e-5, rtol=1e-4)


def test_text_padding_changes_nothing():
    model, slots, tokens = build(), scene(), text()
    with torch.no_grad():
        together = model.rollout(slots, tokens, 3).slots_BSKD
        alone = model.rollout(slots[:1], text(TEXTS[:1]), 3).slots_BSKD
    torch.testing.assert_close(together[:1], alone, atol=1e-5, rtol=1e-4)
    assert (model.rollout(slots[:1], tokens.select(slice(1, 2)), 3).slots_BSKD - alone).abs().max() > 1e-3


def test_color_and_presence_are_carried_and_absent_slots_are_neither_heard_nor_changed():
    model, slots = build(), scene(absent=2)
    with torch.no_grad():
        before = model.rollout(slots, text(), 3).slots_BSKD
        slots[:, :, -2:, : EXPLICIT.content + 7] = torch.randn(2, 4, 2, EXPLICIT.content + 7).abs()
        after = model.rollout(slots, text(), 3).slots_BSKD
        forced = model(slots, text())
    torch.testing.assert_close(before[:, :, :-2], after[:, :, :-2])
    assert torch.equal(after[:, :, -2:], slots[:, -1:, -2:].expand(-1, 3, -1, -1))
    assert torch.equal(forced[:, :, -2:], slots[:, :, -2:])
    carried, given = SlotState.split(after, EXPLICIT), SlotState.split(slots[:, -1:], EXPLICIT)
    assert torch.equal(carried.color, given.color.expand(-1, 3, -1, -1))
    assert torch.equal(carried.presence, given.presence.expand(-1, 3, -1, -1))
    assert (carried.scale > 0).all()


def test_attention_maps_are_distributions_over_the_words():
    model, tokens = build(), text()
    maps = model.rollout(scene(absent=2), tokens, 3, return_attention=True).attention_BSnhKL
    assert maps.shape == (2, 3, 3, 4, 7, tokens.mask_BL.shape[1])
    torch.testing.assert_close(maps[..., :5, :].sum(dim=-1), torch.ones(2, 3, 3, 4, 5))
    assert maps[0, ..., 8:].abs().max() == 0  # padding of the shorter text


def test_color_match_compares_the_slots_of_a_scene():
    colors = torch.tensor([[[1.0, -1, -1], [0.8, -0.4, -0.4], [-1, -1, 1]]])
    tokens = text(["put the red block in the blue bowl"])
    match = color_match(colors, torch.tensor([[False, True, True]]), tokens)[0]
    red, blue, block = 2, 6, 3
    assert match[1, red] == 0 and match[2, blue] == 0 and match[2, red] < -1
    assert (match[:, block] == 0).all()
    assert (match[0] <= 0).all()  # an absent slot never outdoes the best present one


@pytest.mark.parametrize("attention", ["window", "causal"])
@pytest.mark.parametrize("layout", [EXPLICIT, IMPLICIT], ids=["explicit", "implicit"])
def test_gradients_flow_through_a_rollout(attention, layout):
    model = build(attention, layout)
    slots = scene(layout).requires_grad_()
    model.rollout(slots, text(), 4).slots_BSKD[:, -1].square().sum().backward()
    assert slots.grad[:, 0].abs().max() > 0  # through all steps and the past
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    if layout.explicit:
        assert all(layer.color_gain_h.grad.abs().max() > 0 for layer in model.layers)


def test_bad_input_is_named():
    model, slots = build(), scene()
    with pytest.raises(ValueError, match="at least 1 step"):
        model.rollout(slots, text(), 0)
    with pytest.raises(ValueError, match="1 to 8 frames"):
        model.rollout(slots, text(), 6)  # 4 + 6 - 1 = 9 frames of past
    with pytest.raises(ValueError, match="1 to 8 frames"):
        model(scene(frames=9), text())
    with pytest.raises(ValueError, match=r"slots must be \(B, T, K, 14\)"):
        model(slots[..., 1:], text())
    with pytest.raises(ValueError, match="one text for each scene"):
        model(slots[:1], text())
    with pytest.raises(ValueError, match="explicit"):
        build(layout=IMPLICIT, color_bias=True)
    with pytest.raises(ValueError, match="heads"):
        build(heads=5)
