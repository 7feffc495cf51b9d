"""All predictors: published size, slots as a set, causality, the cache, and what explicit slots may do."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from textocvp.predictors import PREDICTORS, PredictorConfig, SlotPredictor, build_predictor
from textocvp.predictors.textocvp import TextOCVPConfig, TextOCVPPredictor, color_match
from textocvp.slots import SlotLayout, SlotState
from textocvp.text import build_text_encoder
from textocvp.text.words import WordsConfig

EXPLICIT = SlotLayout(content=6)
IMPLICIT = SlotLayout(content=12, explicit=False)
TEXTS = [
    "put the red block in the gray bowl",
    "put the teal block in the yellow bowl and the red block in the blue bowl",
]


every_kind = pytest.mark.parametrize("kind", PREDICTORS)
both_forms = pytest.mark.parametrize("attention", ["window", "causal"])
both_layouts = pytest.mark.parametrize("layout", [EXPLICIT, IMPLICIT], ids=["explicit", "implicit"])


def build(attention="causal", layout=EXPLICIT, kind="textocvp", **changes) -> SlotPredictor:
    torch.manual_seed(1)
    sizes = dict(dim=32, layers=3, heads=4, hidden=48, window=8, feed_forwards=1)
    if kind == "textocvp":
        sizes["color_bias"] = layout.explicit
    config = PREDICTORS[kind].Config(attention=attention, **{**sizes, **changes})
    model = build_predictor(config, layout, 32).eval()
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
    vocabulary = tuple(
        sorted({word for one in TEXTS for word in one.split()} - {"red", "gray", "teal", "yellow", "blue"})
    )
    return build_text_encoder(WordsConfig(dim=32, hidden=64, vocabulary=vocabulary)).eval()(texts)


@pytest.mark.parametrize(
    ("slot_dim", "count"),
    [pytest.param(128, 33_761_408, id="TextOCVP"), pytest.param(512, 34_155_008, id="one holistic slot of 512")],
)
def test_published_parameter_count(slot_dim, count):
    with torch.device("meta"):
        model = TextOCVPPredictor(TextOCVPConfig(), SlotLayout(slot_dim, explicit=False), text_dim=512)
    assert sum(p.numel() for p in model.parameters() if p.requires_grad) == count


@every_kind
@both_forms
@both_layouts
def test_slots_are_a_set(kind, attention, layout):
    model, slots = build(attention, layout, kind), scene(layout)
    order = torch.randperm(slots.shape[2], generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        rolled = model.rollout(slots, text(), 3).slots_BSKD
        shuffled = model.rollout(slots[:, :, order], text(), 3).slots_BSKD
    torch.testing.assert_close(shuffled, rolled[:, :, order], atol=1e-5, rtol=1e-4)
    assert (rolled[:, 0] - slots[:, -1]).abs().max() > 0.01


@every_kind
def test_causal_frames_do_not_see_the_future(kind):
    model, slots = build(kind=kind), scene(frames=6)
    changed = slots.clone()
    changed[:, 4:, :, : EXPLICIT.content] += 1.0
    with torch.no_grad():
        before, after = model(slots, text()), model(changed, text())
    torch.testing.assert_close(before[:, :4], after[:, :4])
    assert (before[:, 4:] - after[:, 4:]).abs().max() > 0.1


@every_kind
def test_window_frames_see_each_other_but_nothing_older_than_the_window(kind):
    model = build("window", kind=kind, window=3)
    slots = scene(frames=5)
    changed = slots.clone()
    changed[:, :2, :, : EXPLICIT.content] += 1.0  # older than the window of the first step
    with torch.no_grad():
        assert torch.equal(model.rollout(slots, text(), 1).slots_BSKD, model.rollout(changed, text(), 1).slots_BSKD)
        model.rollout(slots, text(), 10)  # goes on for ever
        changed[:, 2, :, : EXPLICIT.content] += 1.0
        assert (
            model.rollout(slots, text(), 1).slots_BSKD - model.rollout(changed, text(), 1).slots_BSKD
        ).abs().max() > 0


@every_kind
@pytest.mark.parametrize("seed_frames", [1, 3])
@both_layouts
def test_cached_and_uncached_rollouts_agree(kind, layout, seed_frames):
    # In double precision, so that it depends on no processor's order of sums.
    model, slots = build(layout=layout, kind=kind).double(), scene(layout, frames=seed_frames).double()
    words = text()
    words = replace(words, **{name: x.double() for name, x in vars(words).items() if x.is_floating_point()})
    asked = dict(return_attention=model.uses_text)
    with torch.no_grad():
        cached = model.rollout(slots, words, 5, **asked)
        plain = model.rollout(slots, words, 5, use_cache=False, **asked)
    torch.testing.assert_close(cached.slots_BSKD, plain.slots_BSKD, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(cached.attention_BSnhKL, plain.attention_BSnhKL, atol=1e-9, rtol=1e-9)
    with_gradients = model.rollout(slots, words, 5).slots_BSKD  # another cache implementation
    torch.testing.assert_close(with_gradients, cached.slots_BSKD, atol=1e-9, rtol=1e-9)


@every_kind
@pytest.mark.parametrize("use_cache", [True, False])
def test_a_direct_rollout_reads_the_last_given_frame_for_every_new_one(kind, use_cache):
    model, slots = build(kind=kind, direct=True), scene(frames=2)
    with torch.no_grad():
        rolled = model.rollout(slots, text(), 4, use_cache=use_cache).slots_BSKD
        forced = model(torch.cat([slots, slots[:, -1:].expand(-1, 3, -1, -1)], 1), text())[:, 1:]
        iterated = build(kind=kind).rollout(slots, text(), 4).slots_BSKD
    torch.testing.assert_close(rolled, forced, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(rolled[:, 0], iterated[:, 0], atol=1e-5, rtol=1e-4)
    assert (rolled[:, 2] - iterated[:, 2]).abs().max() > 0.01


@every_kind
@both_forms
def test_one_step_of_a_rollout_is_the_teacher_forced_prediction(kind, attention):
    model, slots = build(attention, kind=kind), scene(frames=4)
    with torch.no_grad():
        forced = model(slots, text())[:, -1]
        rolled = model.rollout(slots, text(), 1).slots_BSKD[:, 0]
    torch.testing.assert_close(forced, rolled, atol=1e-5, rtol=1e-4)


@both_forms
@both_layouts
def test_text_padding_changes_nothing(attention, layout):
    model, slots, tokens = build(attention, layout), scene(layout), text()
    with torch.no_grad():
        together = model.rollout(slots, tokens, 3).slots_BSKD
        alone = model.rollout(slots[:1], text(TEXTS[:1]), 3).slots_BSKD
    torch.testing.assert_close(together[:1], alone, atol=1e-5, rtol=1e-4)
    assert (model.rollout(slots[:1], text(TEXTS[1:2]), 3).slots_BSKD - alone).abs().max() > 1e-3


@every_kind
def test_color_and_presence_are_carried_and_unused_slots_are_masked_and_stay(kind):
    model, slots = build(kind=kind), scene(absent=2)
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


@every_kind
@both_forms
@both_layouts
def test_gradients_flow_through_a_rollout(kind, attention, layout):
    model = build(attention, layout, kind)
    slots = scene(layout).requires_grad_()
    model.rollout(slots, text(), 4).slots_BSKD[:, -1].square().sum().backward()
    assert slots.grad[:, 0].abs().max() > 0  # through all steps and the past
    assert [name for name, p in model.named_parameters() if p.grad is None] == []
    if layout.explicit and kind == "textocvp":
        assert all(layer.color_gain_h.grad.abs().max() > 0 for layer in model.layers)


@every_kind
@both_forms
@pytest.mark.parametrize(
    "changes",
    [
        *({"layers": layers} for layers in (2, 4, 8)),
        *({"residual": residual} for residual in (True, False)),
        *({"age_encoding": encoding} for encoding in ("learned", "sinusoidal")),
        *({"feed_forwards": nets} for nets in (1, 2)),
        {"standardize": True},
    ],
    ids=lambda changes: "=".join(map(str, *changes.items())),
)
def test_every_variant_predicts_learns_and_agrees_with_its_cache(kind, attention, changes):
    model, slots = build(attention, IMPLICIT, kind, **changes), scene(IMPLICIT)
    if model.standardized:
        model.content_mean_C += 3.0
        model.content_std_C *= 2.0
    rolled = model.rollout(slots, text(), 4).slots_BSKD
    rolled.square().sum().backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []
    with torch.no_grad():
        plain = model.rollout(slots, text(), 4, use_cache=False).slots_BSKD
        torch.testing.assert_close(rolled, plain, atol=1e-4, rtol=1e-3)
        model.slot_out.weight.zero_()
        model.slot_out.bias.zero_()
        still_rolled = model.rollout(slots, text(), 4).slots_BSKD
        still = slots[:, -1:] if model.config.residual else torch.zeros(())
        assert torch.equal(still_rolled, still.expand_as(still_rolled))


def test_a_variant_has_the_parameters_that_it_says():
    def count(**changes) -> int:
        return sum(p.numel() for p in build(layout=IMPLICIT, **changes).parameters())

    feed_forward = 2 * 32 * 48 + 48 + 32 + 2 * 32
    attention = 4 * 32 * 32 + 2 * 32
    text_attention = 4 * 32 * 32 + 32 + 4 * 32
    assert count() - count(layers=2) == attention + text_attention + feed_forward
    assert count(feed_forwards=2) - count() == 3 * feed_forward
    assert count() - count(age_encoding="sinusoidal") == 8 * 32
    assert count(attention="window") - count() == 32
    assert count(residual=False) == count(standardize=True) == count()
    seq = count(kind="ocvp-seq", feed_forwards=2)
    assert seq - count(kind="ocvp-seq", feed_forwards=2, layers=2) == 2 * (attention + feed_forward)


def test_in_units_of_its_deviation_the_scale_of_the_slots_does_not_matter():
    model, slots = build(layout=IMPLICIT, standardize=True), scene(IMPLICIT)
    with torch.no_grad():
        before = model.rollout(slots, text(), 3).slots_BSKD
        model.content_mean_C += 3.0
        model.content_std_C *= 50.0
        after = model.rollout(slots * 50.0 + 3.0, text(), 3).slots_BSKD
    torch.testing.assert_close(after, before * 50.0 + 3.0, atol=1e-3, rtol=1e-3)


def test_ocvp_seq_uses_no_text_but_other_slots_and_their_past():
    model, slots = build(kind="ocvp-seq"), scene(frames=4)
    with torch.no_grad():
        before = model.rollout(slots, text(), 3).slots_BSKD
        assert torch.equal(before, model.rollout(slots, text(TEXTS[::-1]), 3).slots_BSKD)
        slots[:, 1, 3, : EXPLICIT.content] += 1.0
        moved = (model.rollout(slots, text(), 1).slots_BSKD - before[:, :1]).abs().amax(dim=(0, 1, 3))
    assert (moved[:5] > 1e-6).all() and moved[5:].max() == 0
    with pytest.raises(ValueError, match="no attention to its words"):
        model.rollout(slots, text(), 1, return_attention=True)


def test_a_slot_does_not_attend_to_frames_in_which_it_was_unused():
    model, slots = build(kind="ocvp-seq"), scene(absent=0)
    slots[:, :2, -1, -1] = 0
    with torch.no_grad():
        before = model.rollout(slots, text(), 2).slots_BSKD
        slots[:, :2, -1, :-1] += 1.0
        after = model.rollout(slots, text(), 2).slots_BSKD
    torch.testing.assert_close(before, after)


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
        build(layout=IMPLICIT, color_bias=True)(scene(IMPLICIT), text())
    with pytest.raises(TypeError, match="color_bias"):
        build(kind="ocvp-seq", color_bias=True)
    with pytest.raises(ValueError, match="known: textocvp, ocvp-seq"):
        build_predictor(PredictorConfig("crystal-ball"), EXPLICIT, 32)
    for kind in PREDICTORS:
        with pytest.raises(ValueError, match="heads"):
            build(kind=kind, heads=5)
