"""Canonical pictures of slots."""

from __future__ import annotations

import torch

from textocvp.crop import crop, paste


def test_what_is_cropped_is_pasted_back_where_it_was() -> None:
    image = torch.zeros(1, 1, 1, 64, 64)
    image[..., 20:32, 36:46] = 1
    center = torch.tensor([[[(41 / 64) * 2 - 1, (26 / 64) * 2 - 1]]])
    scale = torch.tensor([[[10 / 64 / 3**0.5, 12 / 64 / 3**0.5]]])  # deviation of a uniform box: side / sqrt(12)
    back = paste(crop(image, center, scale, 24, 2.6), center, scale, 64, 64, 2.6)
    assert (back - image).abs().mean() < 0.01
    assert torch.equal((back > 0.5).float(), image)


def test_moving_the_slot_by_whole_pixels_moves_the_picture_by_as_much() -> None:
    torch.manual_seed(0)
    picture = torch.rand(1, 1, 1, 16, 16)
    scale = torch.full((1, 1, 2), 0.15)
    here = paste(picture, torch.tensor([[[-0.2, 0.1]]]), scale, 64, 64, 2.6)
    there = paste(picture, torch.tensor([[[-0.2 + 5 * 2 / 64, 0.1 - 3 * 2 / 64]]]), scale, 64, 64, 2.6)
    torch.testing.assert_close(there, here.roll((-3, 5), (-2, -1)), atol=1e-5, rtol=1e-5)


def test_a_crop_does_not_depend_on_where_the_thing_is_and_is_empty_outside_the_image() -> None:
    image = torch.zeros(1, 2, 1, 64, 64)
    image[0, 0, :, 10:22, 10:22] = 1
    image[0, 1, :, 30:42, 50:62] = 1
    center = torch.tensor([[[16 / 32 - 1, 16 / 32 - 1], [56 / 32 - 1, 36 / 32 - 1]]])
    scale = torch.full((1, 2, 2), 12 / 64 / 3**0.5)
    here, there = crop(image, center, scale, 16, 2.6)[0]
    torch.testing.assert_close(here, there)
    outside = crop(torch.ones(1, 1, 1, 64, 64), center[:, 1:], 3 * scale[:, 1:], 16, 2.6)[0, 0, 0]
    assert outside[8, 0] == 1 and outside[8, -1] == 0
