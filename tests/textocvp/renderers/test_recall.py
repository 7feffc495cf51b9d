"""Drawing with the first frame's corrections in mind."""

from __future__ import annotations

from dataclasses import replace

import torch

from tests.textocvp.conftest import VOTES, build
from textocvp.renderers.base import Seen
from textocvp.renderers.recall import BORDER, RecallConfig, RecallRenderer
from textocvp.slots import PRESENCE_BACKGROUND, SlotLayout, SlotState
from textocvp.world_model import WorldModel

LAYOUT, SIZE = SlotLayout(content=8), 32
RECALL = replace(VOTES, name="tiny-recall", renderer=RecallConfig(hidden=16, crop_cells=8))


def renderer() -> RecallRenderer:
    torch.manual_seed(0)
    made = RecallRenderer(RecallConfig(hidden=16, crop_cells=8), LAYOUT, SIZE).eval()
    with torch.no_grad():  # things are there, and alike whatever they hold
        made.decoder[-1].weight.zero_()
        made.decoder[-1].bias[:64], made.decoder[-1].bias[64:] = 8.0, 0.0
    return made


def slots(places: list[tuple[float, float]]) -> torch.Tensor:
    """(1, K, D): the background and a thing at each place (x, y) in -1..1."""
    K = 1 + len(places)
    state = SlotState(
        torch.zeros(1, K, 8),
        torch.zeros(1, K, 3),
        torch.zeros(1, K, 2),
        torch.full((1, K, 2), 0.1),
        torch.ones(1, K, 1),
    )
    state.position[0, 1:] = torch.tensor(places)
    state.presence[:, 0] = PRESENCE_BACKGROUND
    return state.join()


def seen(model: RecallRenderer, first: torch.Tensor) -> Seen:
    frame = torch.rand(3, SIZE, SIZE, generator=torch.Generator().manual_seed(1)) * 2 - 1
    (kept,) = model.remember(frame[None], model(first).masks_BKHW, first)
    return kept


@torch.no_grad()
def test_what_stands_still_is_exact_and_what_moves_takes_its_pixels_along() -> None:
    model, first = renderer(), slots([(-0.5, 0.0), (0.5, 0.5)])
    kept = seen(model, first)
    again = model(first, kept)
    torch.testing.assert_close(again.frames_B3HW[0], kept.frame_3HW)
    moved = model(slots([(-0.5 + 8 / 16, 0.0), (0.5, 0.5)]), kept)  # eight pixels to the right
    own = again.masks_BKHW[0, 1] > 0.9
    there = own.roll(8, 1)
    assert own.sum() > 8
    torch.testing.assert_close(moved.frames_B3HW[0][:, there], kept.frame_3HW[:, own], atol=1e-4, rtol=1e-4)
    other = again.masks_BKHW[0, 2] > 0.5
    torch.testing.assert_close(moved.frames_B3HW[0][:, other], kept.frame_3HW[:, other])
    # Where it stood there is the plain canvas, and far from it the floor of the first frame.
    plain = model(slots([(-0.5 + 8 / 16, 0.0), (0.5, 0.5)])).frames_B3HW[0]
    torch.testing.assert_close(moved.frames_B3HW[0][:, own], plain[:, own])
    far = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    far[: 16 - 5 - BORDER - 3] = True
    torch.testing.assert_close(moved.frames_B3HW[0][:, far], kept.frame_3HW[:, far])


@torch.no_grad()
def test_less_is_kept_of_what_looks_otherwise() -> None:
    model, first = renderer(), slots([(0.0, 0.0)])
    with torch.no_grad():
        model.decoder[0].weight[:] = 0
        model.decoder[0].weight[:8] = torch.eye(8)
        model.decoder[2].weight[:] = torch.eye(16)
        for layer in (0, 2):
            model.decoder[layer].bias.zero_()
        model.decoder[-1].weight[64:, 0] = 1.0  # content channel 0 is the shading
    kept = seen(model, first)
    own = model(first).masks_BKHW[0, 1] > 0.9

    def correction(content: float) -> float:
        turned = first.clone()
        turned[0, 1, 0] = content
        return float((model(turned, kept).frames_B3HW - model(turned).frames_B3HW)[0][:, own].abs().mean())

    assert correction(0.0) > correction(0.05) > correction(0.5)
    assert correction(0.5) < 0.01 * correction(0.0)


@torch.no_grad()
def test_masks_share_every_pixel_and_the_one_in_front_wins() -> None:
    model = renderer()
    both = slots([(0.0, 0.0), (0.1, 0.0)])
    masks = model(both).masks_BKHW
    torch.testing.assert_close(masks.sum(1), torch.ones(1, SIZE, SIZE))
    torch.testing.assert_close(model.masks(both), masks)
    for left_in_front in (True, False):
        with torch.no_grad():
            model.front[0].weight.zero_()
            model.front[0].weight[0, LAYOUT.content] = -1.0 if left_in_front else 1.0  # of the place x
            model.front[0].bias.fill_(1.0)
            model.front[-1].weight.zero_()
            model.front[-1].weight[0, 0] = 100.0
        shared = model(both).masks_BKHW[0, 1:, SIZE // 2, SIZE // 2]
        assert bool(shared[0] > shared[1]) is left_in_front


def test_order_is_learned() -> None:
    model = renderer().train()
    model(slots([(0.0, 0.0), (0.1, 0.0)])).masks_BKHW[:, 1].sum().backward()
    assert model.front[-1].weight.grad.abs().sum() > 0


def test_a_world_model_remembers_at_its_own_size() -> None:
    model = WorldModel(build(RECALL))
    first = torch.randint(0, 256, (64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)).numpy()
    rollout = model.rollout(first, ["put the red block in the blue bowl"], horizon=2)
    assert rollout.image_size == (32, 32)
    assert rollout.frames.shape == (1, 3, 3, 32, 32)
