"""The patch renderer: its pixels land where they belong, its masks compete, its prior is a Gaussian."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from tests.textocvp.conftest import PUBLISHED
from textocvp.config import ModelConfig, with_settings
from textocvp.layers import pixel_grid
from textocvp.model import TextOCVP
from textocvp.presets import preset
from textocvp.renderers.patches import (
    MIN_SCALE,
    PatchConfig,
    PatchDecoder,
    PatchRenderer,
    gaussian_prior,
    position_code,
)
from textocvp.slots import SlotLayout, moments
from textocvp.training.losses import read_place_loss, thing_weights
from textocvp.training.parser import ParserStage

LAYOUT = SlotLayout(content=6, explicit=False)


def renderer(**changes: object) -> PatchRenderer:
    torch.manual_seed(0)
    config = PatchConfig(patches=4, layers=3, hidden=8)
    return PatchRenderer(dataclasses.replace(config, **changes), LAYOUT, 16)  # type: ignore[arg-type]


@pytest.mark.parametrize("mask_prior", [False, True])
def test_it_draws_a_set_of_slots(mask_prior: bool) -> None:
    patches, slots, order = renderer(mask_prior=mask_prior), torch.randn(2, 3, 6), torch.tensor([2, 0, 1])
    with torch.no_grad():
        drawn, reordered = patches(slots), patches(slots[:, order])
        masks = patches.masks(slots)
    assert drawn.frames_B3HW.shape == (2, 3, 16, 16) and drawn.draw_objects().shape == (2, 3, 3, 16, 16)
    torch.testing.assert_close(drawn.masks_BKHW.sum(1), torch.ones(2, 16, 16))
    composed = (drawn.masks_BKHW[:, :, None] * drawn.draw_objects()).sum(1)
    torch.testing.assert_close(drawn.frames_B3HW, composed)
    torch.testing.assert_close(reordered.frames_B3HW, drawn.frames_B3HW)
    torch.testing.assert_close(reordered.masks_BKHW, drawn.masks_BKHW[:, order])
    torch.testing.assert_close(reordered.draw_objects(), drawn.draw_objects()[:, order])
    torch.testing.assert_close(masks, drawn.masks_BKHW)


def test_every_patch_lies_where_its_code_says() -> None:
    patches = renderer()

    def places(_slots: Tensor) -> Tensor:
        # Each patch is filled with its own coordinates, and with the numbers of its pixels from left to right.
        out = torch.zeros(1, 1, 16, 4, 4, 4)
        out[0, 0, :, :2] = position_code(4)[:, :2, None, None]
        out[0, 0, :, 2] = torch.arange(4.0)
        return out.flatten(3)

    patches.decoder.forward = places  # type: ignore[method-assign,assignment]
    frame_3HW = patches(torch.zeros(1, 1, 6)).frames_B3HW[0]
    coarse = pixel_grid(4, 4).repeat_interleave(4, 0).repeat_interleave(4, 1)
    torch.testing.assert_close(frame_3HW[:2].permute(1, 2, 0), coarse)
    torch.testing.assert_close(frame_3HW[2], torch.arange(4.0).repeat(4).expand(16, 16))


def test_the_decoder_is_an_mlp_over_a_slot_beside_a_place() -> None:
    torch.manual_seed(0)
    decoder = PatchDecoder(6, cells=3, layers=3, hidden=8, out_dim=5)
    slots = torch.randn(2, 4, 6)
    codes = position_code(3)
    beside = torch.cat([slots[:, :, None].expand(-1, -1, 9, -1), codes.expand(2, 4, -1, -1)], dim=-1)
    weight = torch.cat([decoder.slot.weight, decoder.place.weight], dim=1)
    expected = decoder.rest(torch.nn.functional.linear(beside, weight, decoder.slot.bias))
    torch.testing.assert_close(decoder(slots), expected)
    linear = [module for module in decoder.rest.modules() if isinstance(module, torch.nn.Linear)]
    assert len(linear) + 1 == 3  # the two halves of the first layer are one layer
    with pytest.raises(ValueError, match=r"renderer\.layers"):
        PatchConfig(layers=1)


def test_the_prior_is_the_slots_gaussian() -> None:
    position, scale = torch.tensor([[[-0.5, 0.25], [0.0, 0.0]]]), torch.tensor([[[0.1, 0.3], [0.5, 0.5]]])
    prior = gaussian_prior(position, scale, 8, 16)
    normal = torch.distributions.Normal(position[:, :, None, None], scale[:, :, None, None])
    expected = normal.log_prob(pixel_grid(8, 16)).sum(-1)
    difference = prior - expected
    torch.testing.assert_close(difference, difference[:1, :1, :1, :1].expand_as(difference))


def test_the_place_is_read_off_the_slot_and_moves_the_mask() -> None:
    patches = renderer(mask_prior=True)
    assert renderer().places(torch.zeros(1, 2, 6)) is None
    assert patches.place is not None
    with torch.no_grad():
        for parameter in patches.decoder.parameters():
            parameter.zero_()
        patches.place.read.weight.zero_()
        patches.place.read.weight[0, 0] = patches.place.read.weight[1, 1] = 1.0
        slots = torch.zeros(1, 2, 6)
        slots[0, 0, :2], slots[0, 1, :2] = torch.tensor([-0.8, -0.8]), torch.tensor([0.8, 0.8])
        masks = patches.masks(slots)[0]
    position, scale = patches.places(slots)  # type: ignore[misc]
    torch.testing.assert_close(position[0, 0], torch.tensor([-0.8, -0.8]).tanh())
    assert (scale > MIN_SCALE).all()
    assert masks[0, 2, 2] > 0.95 and masks[1, 13, 13] > 0.95
    torch.testing.assert_close(masks[0], masks[1].flip(0, 1))


def test_read_places_are_held_to_the_attention_and_leave_it_alone() -> None:
    attention = torch.rand(2, 3, 8, 8).softmax(1).requires_grad_()
    position, scale = moments(attention.detach())
    assert read_place_loss(position, scale, attention) == 0
    moved = (position + 0.1).requires_grad_()
    loss = read_place_loss(moved, 2 * scale, attention)
    torch.testing.assert_close(loss, torch.tensor(0.01 + math.log(2) ** 2))
    loss.backward()
    assert attention.grad is None and moved.grad is not None


def small(*settings: str) -> ModelConfig:
    config = dataclasses.replace(PUBLISHED, renderer=PatchConfig(patches=8, hidden=16))
    return with_settings(config, ["parser.image_size=32", "parser.iterations_first=2", *settings])


@pytest.mark.parametrize("initializer", ["cluster", "gaussian"])
@pytest.mark.parametrize("prior", ["true", "false"])
def test_stage_one_reaches_every_parameter(initializer: str, prior: str) -> None:
    torch.manual_seed(0)
    model = TextOCVP(small(f"parser.initializer={initializer}", f"renderer.mask_prior={prior}"))
    frames = torch.full((2, 2, 3, 32, 32), -0.6)
    frames[:, :, 0, 4:12, 4:12] = 0.8
    frames[:, :, 2, 18:26, 10:16] = 0.8
    loss = ParserStage(model)(frames, thing_weights(frames.flatten(0, 1), 4.0))
    assert (loss.place > 0) == (prior == "true") and loss.mask == 0
    loss.total().backward()
    for name, parameter in [*model.parser.named_parameters(), *model.renderer.named_parameters()]:
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_clusters_are_the_first_attention() -> None:
    torch.manual_seed(0)
    model = TextOCVP(small("parser.initializer=cluster", "parser.iterations_first=3"))
    frames = torch.full((1, 1, 3, 32, 32), -0.6)
    frames[..., 0, 4:12, 4:12] = 0.8
    with torch.no_grad():
        attention = model.parser(frames).attention_BTKHW[0, 0]
        masks = model.parser.initializer.clusters(frames[:, 0], 4).masks[0]  # type: ignore[union-attr,operator]
    torch.testing.assert_close(attention, torch.nn.functional.avg_pool2d(masks, 2))  # stride 2
    assert attention[1, 2:6, 2:6].min() == 1


def test_the_preset_has_its_sizes_and_refuses_patches_that_do_not_fit() -> None:
    config = preset("savi-small")
    model = TextOCVP(config)
    assert (config.parser.num_slots, config.parser.layout.dim, config.parser.image_size) == (12, 64, 64)
    assert config.parser.initializer == "cluster" and config.renderer.mask_prior
    assert sum(p.numel() for p in model.parser.parameters()) == 182_016
    assert sum(p.numel() for p in model.renderer.parameters()) == 18_052
    small = preset("tabletop-small")
    assert config.text == small.text
    assert dataclasses.replace(config.predictor, color_bias=True) == small.predictor
    with pytest.raises(ValueError, match=r"renderer\.patches: 5 patches do not divide 64"):
        TextOCVP(with_settings(config, ["renderer.patches=5"]))
