"""The published parser and renderer: the properties the method rests on, and the preset at its own sizes."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from tests.textocvp.conftest import PUBLISHED
from textocvp.model import TextOCVP
from textocvp.parsers import build_parser
from textocvp.parsers.savi import GaussianInitializer, SaviConfig, SaviParser, SlotAttention
from textocvp.presets import preset
from textocvp.renderers import build_renderer
from textocvp.slots import SlotLayout

CONFIG = PUBLISHED.parser
ORDER = torch.tensor([2, 0, 3, 1])


def parser(**changes: object) -> SaviParser:
    torch.manual_seed(0)
    built = build_parser(dataclasses.replace(CONFIG, **changes)).eval()  # type: ignore[arg-type]
    assert isinstance(built, SaviParser)
    return built


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def frames(clips: int = 2, length: int = 3) -> Tensor:
    return torch.rand(clips, length, 3, 32, 32, generator=generator(7)) * 2 - 1


def test_reordering_the_first_slots_reorders_everything_after_them() -> None:
    savi = parser()
    first_BKD = torch.randn(2, 4, 12, generator=generator())

    def parse(slots_BKD: Tensor) -> tuple[Tensor, Tensor]:
        savi.initializer.forward = lambda *_: slots_BKD  # type: ignore[method-assign,assignment]
        with torch.no_grad():
            found = savi(frames())
        return found.slots_BTKD, found.attention_BTKHW

    slots, attention = parse(first_BKD)
    slots_reordered, attention_reordered = parse(first_BKD[:, ORDER])
    torch.testing.assert_close(slots_reordered, slots[:, :, ORDER], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(attention_reordered, attention[:, :, ORDER], atol=1e-5, rtol=1e-4)


def test_attention_is_a_competition_between_slots_at_every_location() -> None:
    found = parser()(frames(), generator=generator())
    assert found.slots_BTKD.shape == (2, 3, 4, 12)
    assert found.attention_BTKHW.shape == (2, 3, 4, 16, 16)  # stride 2
    torch.testing.assert_close(found.attention_BTKHW.sum(dim=2), torch.ones(2, 3, 16, 16))


def test_a_slot_is_updated_with_the_weighted_mean_of_the_values_it_won() -> None:
    torch.manual_seed(0)
    attention = SlotAttention(6, hidden=8)
    seen: list[Tensor] = []
    attention.gru.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    slots, features = torch.randn(1, 3, 6), torch.randn(1, 10, 6)
    _, weights = attention(slots, features, iterations=1)
    values = attention.value(attention.norm_features(features))[0]
    for k in range(3):
        mean = (weights[0, k, :, None] * values).sum(0) / weights[0, k].sum()
        torch.testing.assert_close(seen[0][k], mean, atol=1e-5, rtol=1e-4)


def test_the_seed_decides_the_slots_and_their_number_is_free() -> None:
    savi, clip = parser(), frames()
    with torch.no_grad():
        a, b, c = (savi(clip, generator=generator(seed)).slots_BTKD for seed in (0, 0, 1))
        more = savi(clip, num_slots=9, generator=generator())
    assert torch.equal(a, b) and not torch.allclose(a, c, atol=1e-3)
    assert more.slots_BTKD.shape == (2, 3, 9, 12)


def test_the_initializer_draws_from_its_gaussian() -> None:
    initializer = GaussianInitializer(3)
    with torch.no_grad():
        initializer.mean.copy_(torch.tensor([1.0, -2, 0]))
        initializer.log_deviation.copy_(torch.tensor([0.5, 2, 1]).log())
    drawn = initializer(100, 200, generator()).detach().flatten(0, 1)
    torch.testing.assert_close(drawn.mean(0), torch.tensor([1.0, -2, 0]), atol=0.05, rtol=0)
    torch.testing.assert_close(drawn.std(0), torch.tensor([0.5, 2, 1]), atol=0.05, rtol=0)


def test_a_later_frame_changes_no_earlier_slot() -> None:
    savi, clip = parser(), frames(1)
    changed = clip.clone()
    changed[:, 2] = 1.0
    with torch.no_grad():
        a, b = savi(clip, generator=generator()).slots_BTKD, savi(changed, generator=generator()).slots_BTKD
    torch.testing.assert_close(a[:, :2], b[:, :2])
    assert (a[:, 2] - b[:, 2]).abs().max() > 1e-3


def test_clusters_can_start_the_slots() -> None:
    savi = parser(initializer="cluster")
    image = torch.full((1, 1, 3, 32, 32), -0.6)
    image[..., 4:12, 4:12] = torch.tensor([1.0, -0.5, -0.5])[:, None, None]
    found = savi(image)
    found.slots_BTKD.sum().backward()
    assert savi.initializer.empty.grad is not None and savi.initializer.empty.grad.abs().sum() > 0
    again = parser(initializer="cluster")(image)  # nothing is drawn at random
    torch.testing.assert_close(found.slots_BTKD, again.slots_BTKD)


def test_choices_that_do_not_fit_are_errors_that_say_why() -> None:
    with pytest.raises(ValueError, match=r"layout\.explicit"):
        parser(layout=SlotLayout(content=8, explicit=True))
    with pytest.raises(ValueError, match="transition_heads = 5"):
        parser(transition_heads=5)
    with pytest.raises(ValueError, match="at least 1 iteration"):
        parser(iterations_first=0)(frames())


def test_the_renderer_draws_a_set_of_slots() -> None:
    torch.manual_seed(0)
    renderer = build_renderer(PUBLISHED.renderer, CONFIG.layout, 32)
    slots = torch.randn(2, 4, 12)
    with torch.no_grad():
        drawn, reordered = renderer(slots), renderer(slots[:, ORDER])
        masks = renderer.masks(slots)
    assert drawn.frames_B3HW.shape == (2, 3, 32, 32) and drawn.draw_objects().shape == (2, 4, 3, 32, 32)
    torch.testing.assert_close(drawn.masks_BKHW.sum(1), torch.ones(2, 32, 32))
    composed = (drawn.masks_BKHW[:, :, None] * drawn.draw_objects()).sum(1)
    torch.testing.assert_close(drawn.frames_B3HW, composed)
    torch.testing.assert_close(reordered.frames_B3HW, drawn.frames_B3HW, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(reordered.masks_BKHW, drawn.masks_BKHW[:, ORDER], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(masks, drawn.masks_BKHW)


def test_the_published_preset_has_the_papers_sizes_and_learns() -> None:
    config = preset("savi-cater")
    torch.manual_seed(0)
    model = TextOCVP(config)
    assert config.parser == SaviConfig(
        num_slots=8,
        layout=SlotLayout(content=128, explicit=False),
        initializer="gaussian",
        iterations_first=3,
        transition_hidden=512,
    )
    assert isinstance(model.parser, SaviParser)
    shapes = [tuple(p.shape) for p in model.parser.encoder.convolutions.parameters() if p.ndim == 4]
    assert shapes == [(32, 3, 5, 5), (32, 32, 5, 5), (32, 32, 5, 5), (32, 32, 5, 5)]

    clip = torch.rand(1, 2, 3, 64, 64) * 2 - 1
    parameters = [*model.parser.parameters(), *model.renderer.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=1e-3)
    losses = []
    for _ in range(4):
        parsed = model.parser(clip, generator=generator())
        frames_N3HW = model.renderer(parsed.slots_BTKD.flatten(0, 1)).frames_B3HW
        loss = (frames_N3HW - clip.flatten(0, 1)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in parameters)
    assert losses[-1] < losses[0]
