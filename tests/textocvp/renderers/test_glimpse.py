"""Reading and drawing in a slot's own coordinates."""

from __future__ import annotations

import pytest
import torch

from textocvp.config import with_settings
from textocvp.crop import crop, paste
from textocvp.model import TextOCVP
from textocvp.presets import preset
from textocvp.renderers.glimpse import GlimpseConfig, GlimpseRenderer
from textocvp.slots import PRESENCE_BACKGROUND, SlotLayout, SlotState

LAYOUT = SlotLayout(content=8)


def slots(generator: torch.Generator, batch: int = 2, things: int = 3, unused: int = 1) -> torch.Tensor:
    def uniform(*shape: int, low: float, high: float) -> torch.Tensor:
        return torch.rand(shape, generator=generator) * (high - low) + low

    K = 1 + things + unused
    presence = torch.ones(batch, K, 1)
    presence[:, 0] = PRESENCE_BACKGROUND
    presence[:, K - unused :] = 0
    return SlotState(
        content=torch.randn(batch, K, LAYOUT.content, generator=generator),
        color=uniform(batch, K, 3, low=-0.9, high=0.9),
        position=uniform(batch, K, 2, low=-0.6, high=0.6),
        scale=uniform(batch, K, 2, low=0.08, high=0.2),
        presence=presence,
    ).join()


def renderer() -> GlimpseRenderer:
    torch.manual_seed(0)
    return GlimpseRenderer(GlimpseConfig(hidden=32, crop_cells=16), LAYOUT, image_size=64)


def test_what_is_read_is_drawn_back_where_it_was() -> None:
    image = torch.zeros(1, 1, 1, 64, 64)
    image[..., 20:32, 36:46] = 1
    center = torch.tensor([[[(41 / 64) * 2 - 1, (26 / 64) * 2 - 1]]])
    scale = torch.tensor(
        [[[10 / 64 / 3**0.5, 12 / 64 / 3**0.5]]]
    )  # deviation of a uniform box: side / sqrt(12)
    back = paste(crop(image, center, scale, 24, 2.6), center, scale, 64, 64, 2.6)
    assert (back - image).abs().mean() < 0.01
    assert torch.equal((back > 0.5).float(), image)


def test_moving_the_slot_by_whole_pixels_moves_the_drawing_by_as_much() -> None:
    torch.manual_seed(0)
    picture = torch.rand(1, 1, 1, 16, 16)
    scale = torch.full((1, 1, 2), 0.15)
    here = paste(picture, torch.tensor([[[-0.2, 0.1]]]), scale, 64, 64, 2.6)
    there = paste(picture, torch.tensor([[[-0.2 + 5 * 2 / 64, 0.1 - 3 * 2 / 64]]]), scale, 64, 64, 2.6)
    torch.testing.assert_close(there, here.roll((-3, 5), (-2, -1)), atol=1e-5, rtol=1e-5)


def test_drawing_is_equivariant_to_the_order_of_the_slots() -> None:
    model, these = renderer(), slots(torch.Generator().manual_seed(1))
    order = torch.tensor([3, 0, 4, 2, 1])
    one, other = model(these), model(these[:, order])
    torch.testing.assert_close(other.frames_B3HW, one.frames_B3HW)
    torch.testing.assert_close(other.masks_BKHW, one.masks_BKHW[:, order])


def test_masks_share_out_every_pixel_and_unused_slots_get_none() -> None:
    model, these = renderer(), slots(torch.Generator().manual_seed(2))
    drawn = model(these)
    torch.testing.assert_close(drawn.masks_BKHW.sum(1), torch.ones(2, 64, 64))
    assert drawn.masks_BKHW[:, -1].max() < 1e-4
    torch.testing.assert_close(model.masks(these), drawn.masks_BKHW)


def test_recoloring_a_slot_recolors_its_drawing_and_moves_no_mask() -> None:
    model, these = renderer(), slots(torch.Generator().manual_seed(3))
    state = SlotState.split(these, LAYOUT)
    state.color = state.color[..., [2, 0, 1]]
    one, other = model(these), model(state.join())
    torch.testing.assert_close(other.frames_B3HW, one.frames_B3HW[:, [2, 0, 1]])
    assert torch.equal(other.masks_BKHW, one.masks_BKHW)


def test_gradients_reach_place_size_content_and_canvas() -> None:
    model, these = renderer(), slots(torch.Generator().manual_seed(4)).requires_grad_()
    model(these).frames_B3HW.square().mean().backward()
    assert these.grad is not None
    gradient = SlotState.split(these.grad, LAYOUT)
    for part in (gradient.content, gradient.position, gradient.scale, gradient.color):
        assert part[:, 1:4].abs().amin(dim=(0, 2)).gt(0).all()
    assert model.canvas.grad is not None and model.canvas.grad.abs().max() > 0


def test_slots_without_a_place_are_refused() -> None:
    config = with_settings(preset("savi-small"), ["renderer.kind=glimpse"])
    with pytest.raises(ValueError, match=r"'glimpse' needs parser\.layout\.explicit = true"):
        TextOCVP(config)
