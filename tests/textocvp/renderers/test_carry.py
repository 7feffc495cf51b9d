"""Drawing with the first frame in mind: what is copied, what is filled, what is decoded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.textocvp.conftest import PLACED, VOTES, build
from textocvp.config import with_settings
from textocvp.model import TextOCVP
from textocvp.renderers.base import Seen
from textocvp.renderers.carry import CarryConfig, CarryRenderer, filled
from textocvp.rollout import Rollout
from textocvp.slots import PRESENCE_BACKGROUND, ROBOT_SLOT, SlotLayout, SlotState, moments
from textocvp.world_model import WorldModel

LAYOUT = SlotLayout(content=8)
SMALL, LARGE = 32, 64
FLOOR, TABLE = 0.5, -0.5
BLOCK, BOWL, UNUSED = 2, 3, 4
CARRY = replace(VOTES, name="tiny-carry", renderer=CarryConfig(hidden=16, crop_cells=8, robot_cells=24))
TEXT = "put the red block in the blue bowl"


def renderer(robot: bool = False) -> CarryRenderer:
    """With random weights; the robot is invisible unless it is asked for."""
    torch.manual_seed(0)
    made = CarryRenderer(CarryConfig(hidden=16, crop_cells=8, robot_cells=24), LAYOUT, SMALL)
    if not robot:
        torch.nn.init.zeros_(made.robot[-1].weight)
        torch.nn.init.constant_(made.robot[-1].bias, -30.0)
    return made


def first_frame(size: int) -> tuple[Tensor, Tensor]:
    """A frame (1, 3, H, W) of floor, table, robot, a patterned block and a bowl, and its labels (1, H, W)."""
    s = size // SMALL
    labels = torch.zeros(1, size, size, dtype=torch.long)
    labels[:, : 12 * s, 14 * s : 18 * s] = ROBOT_SLOT  # reaches over the edge of the table
    labels[:, 20 * s : 24 * s, 4 * s : 8 * s] = BLOCK
    labels[:, 18 * s : 26 * s, 20 * s : 28 * s] = BOWL
    frame = torch.full((1, 3, size, size), FLOOR)
    frame[..., 8 * s :, :] = TABLE
    noise = torch.rand(frame.shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return torch.where(labels[:, None] > 0, noise, frame), labels


def look(model: CarryRenderer, size: int = LARGE) -> tuple[Tensor, Tensor, Seen, SlotState]:
    """The first frame (3, H, W), its labels (H, W), what the renderer keeps of it, and its slots (1, K)."""
    frame, labels = first_frame(size)
    small = first_frame(SMALL)[1]
    attention = F.one_hot(small, 5).permute(0, 3, 1, 2).float()
    position, scale = moments(attention)
    presence = torch.ones(1, 5, 1)
    presence[:, 0], presence[:, UNUSED] = PRESENCE_BACKGROUND, 0
    content = torch.randn(1, 5, LAYOUT.content, generator=torch.Generator().manual_seed(1))
    state = SlotState(content, torch.zeros(1, 5, 3), position, scale, presence)
    (seen,) = model.remember(frame, attention, state.join())
    return frame[0], labels[0], seen, state


def moved(state: SlotState, slot: int, right: float, down: float, size: int = LARGE) -> Tensor:
    """The slots with one of them elsewhere, by so many pixels."""
    position = state.position.clone()
    position[:, slot] += torch.tensor([right, down]) * 2 / size
    return replace(state, position=position).join()


@pytest.mark.parametrize("size", [SMALL, LARGE, 3 * SMALL])
def test_what_stands_still_keeps_its_pixels(size: int) -> None:
    model = renderer()
    frame, labels, seen, state = look(model, size)
    drawn = model(state.join(), seen)
    still = labels != ROBOT_SLOT
    border = F.max_pool2d((~still).float()[None], 2 * seen_border(size) + 1, 1, seen_border(size))[0] > 0
    assert torch.equal(drawn.frames_B3HW[0][:, ~border], frame[:, ~border])
    for slot in (BLOCK, BOWL):
        wrong = (drawn.masks_BKHW[0, slot] > 0.5) != (labels == slot)
        assert wrong.sum() <= (4 if size > LARGE else 0)  # the corners of enlarged masks are rounded


def seen_border(size: int) -> int:
    return 2 * size // SMALL


@pytest.mark.parametrize(("right", "down"), [(10, -7), (10.3, -6.8), (-4, 30), (-14, 0)])
def test_a_thing_takes_its_pixels_along_by_whole_pixels(right: float, down: float) -> None:
    model = renderer()
    frame, labels, seen, state = look(model)
    drawn = model(moved(state, BLOCK, right, down), seen)
    y, x = (labels == BLOCK).nonzero(as_tuple=True)
    to_y, to_x = y + round(down), x + round(right)
    inside = (to_y >= 0) & (to_y < LARGE) & (to_x >= 0) & (to_x < LARGE)
    assert torch.equal(drawn.frames_B3HW[0][:, to_y[inside], to_x[inside]], frame[:, y[inside], x[inside]])
    assert torch.equal(drawn.masks_BKHW[0, BLOCK].nonzero(), torch.stack([to_y, to_x], 1)[inside])
    # Where it stood there is the table, also under the pixels around it.
    left = torch.zeros_like(labels, dtype=torch.bool)
    left[38:50, 6:18] = True
    left[to_y[inside], to_x[inside]] = False
    assert torch.equal(drawn.frames_B3HW[0][:, left], torch.full((3, int(left.sum())), TABLE))


def test_what_hardly_moved_stands_still() -> None:
    """A thing that is half hidden has another centre of mass, though it stands where it stood."""
    model = renderer()
    frame, labels, seen, state = look(model)
    drawn = model(moved(state, BOWL, 2, -2), seen)
    assert torch.equal(drawn.frames_B3HW[0][:, labels == BOWL], frame[:, labels == BOWL])


def test_behind_the_robot_the_edge_of_the_table_goes_on() -> None:
    model = renderer()
    _, labels, seen, state = look(model)
    drawn = model(state.join(), seen)
    for y, tone in ((6, FLOOR), (15, FLOOR), (16, TABLE), (23, TABLE)):
        assert (drawn.frames_B3HW[0, :, y, 24:40] == tone).all()
    assert (drawn.masks_BKHW[0, 0][labels == ROBOT_SLOT] > 0.999).all()


def test_a_moved_thing_is_drawn_over_one_that_stands() -> None:
    model = renderer()
    frame, labels, seen, state = look(model)
    for slot, other, right in ((BLOCK, BOWL, 38), (BOWL, BLOCK, -38)):
        drawn = model(moved(state, slot, right, 0), seen)
        y, x = (labels == slot).nonzero(as_tuple=True)
        inside = x + right >= 0
        y, x = y[inside], x[inside]
        assert torch.equal(drawn.frames_B3HW[0][:, y, x + right], frame[:, y, x])
        assert drawn.masks_BKHW[0, other][y, x + right].max() == 0


def test_what_a_thing_hid_is_drawn_from_its_slot() -> None:
    """A block in a bowl is carried away: the hole it leaves is bowl, in the bowl's colour."""
    model = renderer()
    torch.nn.init.zeros_(model.decoder[-1].weight)
    torch.nn.init.constant_(model.decoder[-1].bias, 4.0)  # every picture is full and bright
    frame, labels, seen, state = look(model)
    inside = torch.zeros_like(labels, dtype=torch.bool)
    inside[42:46, 46:50] = True
    seen = replace(seen, labels_HW=torch.where(inside, BLOCK, torch.where(labels == BLOCK, 0, labels)))
    state.color[:, BOWL] = torch.tensor([-0.9, -0.8, -0.9])
    drawn = model(moved(state, BLOCK, -30, 0), replace(seen, slots_KD=state.join()[0]))
    assert (drawn.masks_BKHW[0, BOWL][inside] == 1).all()
    wanted = (state.color[0, BOWL] + 1) * 5 - 1
    torch.testing.assert_close(drawn.frames_B3HW[0][:, inside], wanted[:, None].expand(3, 16))
    still = model(state.join(), replace(seen, slots_KD=state.join()[0]))
    assert torch.equal(still.frames_B3HW[0][:, inside], frame[:, inside])


def test_a_thing_that_the_first_frame_did_not_show_is_drawn_from_its_slot() -> None:
    model = renderer()
    torch.nn.init.zeros_(model.decoder[-1].weight)
    torch.nn.init.constant_(model.decoder[-1].bias, 4.0)
    _, _, seen, state = look(model)
    later = replace(state, presence=state.presence.clone(), scale=state.scale.clone())
    later.presence[:, UNUSED], later.scale[:, UNUSED] = 1, 0.1
    later.position[:, UNUSED] = torch.tensor([0.0, 0.0])
    assert model(later.join(), seen).masks_BKHW[0, UNUSED, 32, 32] == 1
    assert model(state.join(), seen).masks_BKHW[0, UNUSED].max() == 0


def test_masks_share_out_every_pixel_and_make_up_the_frame() -> None:
    model = renderer(robot=True)
    _, _, seen, state = look(model)
    slots = torch.cat([state.join(), moved(state, BLOCK, 20, 3), moved(state, ROBOT_SLOT, 9, 12)])
    for drawn, size in ((model(slots), SMALL), (model(slots, seen), LARGE)):
        masks, objects = drawn.masks_BKHW, drawn.draw_objects()
        assert masks.shape == (3, 5, size, size) and objects.shape == (3, 5, 3, size, size)
        torch.testing.assert_close(masks.sum(1), torch.ones(3, size, size))
        assert masks[:, UNUSED].max() < 1e-4
        torch.testing.assert_close((masks[:, :, None] * objects).sum(1), drawn.frames_B3HW)
    torch.testing.assert_close(model.masks(slots), model(slots).masks_BKHW)


def test_frames_are_drawn_alike_alone_and_together() -> None:
    model = renderer(robot=True)
    _, _, seen, state = look(model)
    slots = torch.cat([moved(state, BLOCK, 3 * t, t) for t in range(5)])
    together = model(slots, seen)
    for t in range(5):
        alone = model(slots[t : t + 1], seen)
        torch.testing.assert_close(alone.frames_B3HW[0], together.frames_B3HW[t])
        torch.testing.assert_close(alone.masks_BKHW[0], together.masks_BKHW[t])


def test_gradients_reach_the_robot_the_canvas_and_the_slots() -> None:
    model = renderer(robot=True)
    _, _, _, state = look(model)
    slots = state.join().requires_grad_()
    model(slots).frames_B3HW.square().mean().backward()
    assert slots.grad is not None
    gradient = SlotState.split(slots.grad, LAYOUT)
    for part in (gradient.content, gradient.position, gradient.scale, gradient.color):
        assert part[0, 1:4].abs().amax(-1).gt(0).all()
    for parameters in (model.canvas, *model.robot.parameters(), *model.decoder.parameters()):
        assert parameters.grad is not None and parameters.grad.abs().max() > 0


def test_gaps_are_filled_from_both_sides_or_from_above_and_below() -> None:
    frame = torch.arange(5.0).expand(3, 4, 5).clone()
    known = torch.ones(4, 5, dtype=torch.bool)
    known[1, 1:3], known[2, 3:], known[3] = False, False, False
    broken = torch.where(known, frame, 99.0)
    result = filled(broken, known)
    torch.testing.assert_close(result[:, 1], frame[:, 1])  # between 0 and 3: a straight line
    torch.testing.assert_close(result[:, 2], torch.tensor([0.0, 1, 2, 2, 2]).expand(3, 5))
    torch.testing.assert_close(result[:, 3], result[:, 2])
    assert torch.equal(filled(broken, torch.zeros_like(known)), broken)


@pytest.fixture
def world_model() -> WorldModel:
    return WorldModel(build(CARRY))


@pytest.fixture
def picture(scene: np.ndarray) -> np.ndarray:
    return scene.repeat(2, 0).repeat(2, 1)  # twice as large


def test_a_rollout_is_of_the_size_of_its_frames(world_model, scene, picture) -> None:
    for image in (scene, picture, scene.repeat(3, 0).repeat(3, 1)):
        size = len(image)
        rollout = world_model.rollout(image, [TEXT, "put the blue block in the red bowl"], horizon=3)
        assert rollout.image_size == (size, size) and rollout.frames.shape == (2, 4, 3, size, size)
        assert rollout.masks.shape[-2:] == (size, size)
    large, small = (world_model.rollout(x, TEXT, horizon=3) for x in (picture, scene))
    torch.testing.assert_close(large.slots, small.slots)
    torch.testing.assert_close(large.positions, 2 * small.positions)


def test_other_renderers_draw_at_their_own_size(scene: np.ndarray, picture: np.ndarray) -> None:
    world_model = WorldModel(build(PLACED))
    large, small = (world_model.rollout(x, TEXT, horizon=3) for x in (picture, scene))
    assert large.image_size == (32, 32) and large.seen is None
    assert torch.equal(large.slots, small.slots) and torch.equal(large.frames, small.frames)
    with pytest.raises(ValueError, match="made by another model"):  # of twice the size, and without a first frame
        world_model.rollout(replace(small, image_size=(64, 64)), TEXT, horizon=1)


def test_a_rollout_that_goes_on_keeps_its_first_frame(world_model, scene, picture) -> None:
    start = world_model.rollout(picture, TEXT, horizon=4)
    for so_far in (start, start.last, world_model.rollout(start, TEXT, horizon=2)):
        further = world_model.rollout(so_far, [TEXT, TEXT], horizon=2)
        assert further.image_size == (64, 64)
        assert further.seen[0] is start.seen[0] and further.seen[1] is start.seen[0]
        torch.testing.assert_close(further.frames[0, 0], so_far.frames[0, -1])
    with pytest.raises(ValueError, match="made by another model"):
        other = replace(start, image_size=(48, 48))
        world_model.rollout(other, TEXT, horizon=2)


def test_sequences_keep_their_own_first_frames(world_model, picture) -> None:
    pictures = np.stack([picture, picture[:, ::-1], 255 - picture])
    rollout = world_model.rollout(pictures, TEXT, horizon=2)
    for b in range(3):
        alone = world_model.rollout(pictures[b], TEXT, horizon=2)
        assert torch.equal(rollout.seen[b].frame_3HW, alone.seen[0].frame_3HW)
        part = rollout.select([b])
        assert isinstance(part, Rollout) and part.seen == (rollout.seen[b],)
        torch.testing.assert_close(part.frames, alone.frames)
        torch.testing.assert_close(rollout.decode_masks([2])[b], alone.decode_masks([2])[0])
    parsed = world_model.parse(pictures[:, None].repeat(3, 1))
    assert torch.equal(parsed.seen[2].frame_3HW, rollout.seen[2].frame_3HW)


def test_only_a_parser_that_knows_the_robot_will_do() -> None:
    with pytest.raises(ValueError, match=r"'carry' needs .* parser\.kind=votes"):
        TextOCVP(with_settings(PLACED, ["renderer.kind=carry"]))
    with pytest.raises(ValueError, match="robot_cells must be 12, 24"):
        CarryConfig(robot_cells=30)
