"""More things than the model was trained with: the number of slots can be raised when it is used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import NON_OC, PLACED, PUBLISHED, VOTES, build
from textocvp import WorldModel
from textocvp.config import ModelConfig, with_settings

TEXT = "put the red block in the blue bowl"
COLORS = [(255, 87, 89), (78, 121, 167), (89, 169, 79), (237, 201, 72)]
CLUSTERS = replace(PUBLISHED, name="tiny-clusters", parser=replace(PUBLISHED.parser, initializer="cluster"))


def squares(side: int) -> np.ndarray:
    """(32, 32, 3) uint8: side * side squares on a dark table, no two neighbours of one colour; 4 are of 4 sizes."""
    image = np.full((32, 32, 3), 47, np.uint8)
    step = 32 // side
    for i in range(side):
        for j in range(side):
            size = 5 + 2 * i + j if side == 2 else 4
            y, x = i * step + 1, j * step + 1
            image[y : y + size, x : x + size] = COLORS[(i + 2 * j) % 4]
    return image


def test_placed_slots_find_as_many_things_as_there_are_slots() -> None:
    world_model = WorldModel(build(PLACED))
    few, many = squares(2), squares(4)
    found = [int((world_model.parse(many[None], num_slots=k).presence > 0.5).sum()) for k in (None, 9, 17, 20)]
    assert found == [5, 9, 17, 17]  # the canvas is one of them
    trained, raised = (world_model.rollout(few, TEXT, horizon=4, num_slots=k) for k in (None, 12))
    assert raised.slots.shape == (1, 5, 12, 16)
    assert (raised.presence[0, :, 5:] < 0.5).all()
    torch.testing.assert_close(raised.slots[:, :, :5], trained.slots, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(raised.frames, trained.frames, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("config", [PLACED, PUBLISHED, CLUSTERS, VOTES], ids=lambda config: config.name)
@pytest.mark.parametrize("kind", ["textocvp", "ocvp-seq"])
def test_every_slot_model_takes_more_slots_and_fewer(config: ModelConfig, kind: str) -> None:
    world_model = WorldModel(build(with_settings(config, [f"predictor.kind={kind}"])))
    for slots in (3, 9):
        rollout = world_model.rollout(squares(3), TEXT, horizon=3, seed=1, num_slots=slots)
        assert rollout.slots.shape[2] == slots and rollout.slots.isfinite().all()
        torch.testing.assert_close(rollout.masks.sum(2), torch.ones(1, 4, 32, 32))
        again = world_model.rollout(squares(3), TEXT, horizon=3, seed=1, num_slots=slots)
        assert torch.equal(again.slots, rollout.slots)
        parsed = world_model.parse(squares(3)[None], seed=1, num_slots=slots)
        assert torch.equal(parsed.slots[:, 0], rollout.slots[:, 0])
    frames = world_model.imagine(squares(3), TEXT, horizon=3, seed=1, num_slots=9)
    torch.testing.assert_close(frames, rollout.frames)


def test_numbers_that_make_no_sense_are_refused() -> None:
    world_model = WorldModel(build(PLACED))
    for wrong in (0, -1, 2.5, "many"):
        with pytest.raises(ValueError, match="num_slots must be a whole number of at least 1"):
            world_model.parse(squares(2)[None], num_slots=wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="a background and one region"):
        world_model.rollout(squares(2), TEXT, horizon=1, num_slots=1)
    first = world_model.rollout(squares(2), TEXT, horizon=1)
    with pytest.raises(ValueError, match="goes on with its own 5 slots"):
        world_model.rollout(first, TEXT, horizon=1, num_slots=9)


def test_a_model_of_whole_frames_says_that_it_has_one_slot() -> None:
    world_model = WorldModel(build(NON_OC))
    assert world_model.rollout(squares(2), TEXT, horizon=1, num_slots=1).slots.shape[2] == 1
    with pytest.raises(ValueError, match=r"sees a frame as one slot; it cannot use 9"):
        world_model.rollout(squares(2), TEXT, horizon=1, num_slots=9)
