"""What the numbers of a slot mean, and the moments of masks."""

from __future__ import annotations

import pytest
import torch

from textocvp.slots import PRESENCE_BACKGROUND, PRESENCE_THING, PRESENCE_UNUSED, SlotLayout, SlotState, moments

LAYOUT = SlotLayout(content=4)


def test_each_slot_is_unused_a_thing_or_the_background() -> None:
    slots = torch.randn(2, 3, LAYOUT.dim, generator=torch.Generator().manual_seed(0))
    slots[..., -1] = torch.tensor([PRESENCE_BACKGROUND, PRESENCE_THING, PRESENCE_UNUSED])
    state = SlotState.split(slots, LAYOUT)
    assert state.is_background[..., 0].tolist() == [[True, False, False]] * 2
    assert state.is_thing[..., 0].tolist() == [[False, True, False]] * 2
    assert state.is_unused[..., 0].tolist() == [[False, False, True]] * 2
    assert LAYOUT.used(slots).tolist() == [[True, True, False]] * 2
    assert torch.equal(state.join(), slots)


def test_without_explicit_channels_every_slot_is_used_and_nothing_can_be_split() -> None:
    layout = SlotLayout(content=12, explicit=False)
    assert layout.dim == 12 and layout.used(torch.zeros(2, 3, 12)).all()
    with pytest.raises(ValueError, match="no explicit colour"):
        SlotState.split(torch.zeros(2, 3, 12), layout)
    with pytest.raises(ValueError, match="13 wide, the layout says 12"):
        SlotState.split(torch.zeros(2, 3, 13), LAYOUT)


def test_moments_of_a_box() -> None:
    mask = torch.zeros(1, 1, 64, 64)
    mask[..., 8:24, 32:40] = 1
    position, scale = moments(mask)
    torch.testing.assert_close(position[0, 0], torch.tensor([36 / 32 - 1, 16 / 32 - 1]))
    torch.testing.assert_close(scale[0, 0] * 32, torch.tensor([(63 / 12) ** 0.5, (255 / 12) ** 0.5]))


def test_moments_are_as_precise_under_autocast() -> None:
    mask = torch.zeros(1, 1, 64, 64)
    mask[..., 52:58, 50:56] = 1
    with torch.autocast("cpu", torch.bfloat16):
        position, scale = moments(mask.bfloat16())
    torch.testing.assert_close((position, scale), moments(mask))
