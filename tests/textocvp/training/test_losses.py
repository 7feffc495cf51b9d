"""Losses mean what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.textocvp.slot_scenes import LAYOUT, true_slots
from textocvp.renderers.base import Rendered
from textocvp.slots import SlotState
from textocvp.training.losses import image_loss, mask_loss, moving_weights, slot_loss, thing_weights


def test_weights_single_out_what_is_not_the_canvas():
    target = torch.full((1, 3, 8, 8), -0.6)
    target[:, 0, 2:4, 2:4] = 0.8
    weights = thing_weights(target, 4.0)
    assert weights.unique().tolist() == [1, 5] and (weights == 5).sum() == 4
    drawn = Rendered(target + 0.1 * (weights == 5), torch.ones(1, 1, 8, 8), lambda: target)
    expected = 5 * 4 * 0.01 / (5 * 4 + 60)
    torch.testing.assert_close(image_loss(drawn, target, weights), torch.tensor(expected))


def test_mask_loss_is_the_log_share_of_the_winner():
    masks = torch.tensor([0.25, 0.75])[None, :, None, None].expand(1, 2, 4, 4).clone().requires_grad_()
    attention = torch.tensor([0.4, 0.6])[None, :, None, None].expand(1, 2, 4, 4).clone().requires_grad_()
    loss = mask_loss(Rendered(masks, masks, lambda: masks), attention, torch.ones(1, 1, 4, 4))
    torch.testing.assert_close(loss, -torch.tensor(0.75).log())
    loss.backward()
    assert masks.grad is not None and attention.grad is None


def test_moving_slots_weigh_more_and_unused_ones_nothing():
    slots = true_slots(8)  # 6 frames, then still
    step = moving_weights(slots, LAYOUT, 20.0, ever=False)
    assert step[0, :, 1].tolist() == [20.0] * 5 + [1.0] * 2
    assert (step[:, :, 2] == 1).all() and (step[:, :, -1] == 0).all()
    ever = moving_weights(slots, LAYOUT, 20.0, ever=True)
    assert ever[0, :, 1].tolist() == [20.0] * 7


def test_loss_counts_each_field_in_its_own_unit():
    slots = true_slots(6)[:, :1]
    std, weight = torch.tensor([1.0, 2.0, 1.0, 1.0]), torch.zeros(12, 1, 5)
    weight[:, :, 1] = 1 / 12
    assert sum(vars(slot_loss(slots, slots, weight, LAYOUT, std)).values()) == 0
    state = SlotState.split(slots, LAYOUT)
    shifted = replace(state, position=state.position + torch.tensor([0.3, 0.0]))
    assert slot_loss(shifted.join(), slots, weight, LAYOUT, std).position.item() == pytest.approx(9.5, abs=0.01)
    wider = replace(state, scale=state.scale * np.exp([0.1, 0.0], dtype=np.float32))
    assert slot_loss(wider.join(), slots, weight, LAYOUT, std).scale.item() == pytest.approx(1.0, abs=0.01)
    other = replace(state, content=state.content + torch.tensor([0.0, 2.0, 0.0, 0.0]))
    assert slot_loss(other.join(), slots, weight, LAYOUT, std).content.item() == pytest.approx(0.25, abs=0.01)
