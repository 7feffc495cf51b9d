"""What a rollout promises: lazy, cached, in pixels, and readable files."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import Tensor

from textocvp.pictures import slot_palette
from textocvp.renderers.base import Rendered, Renderer
from textocvp.rollout import CHUNK, Rollout
from textocvp.slots import SlotLayout, SlotState

H = W = 32
PLACED, UNPLACED = SlotLayout(content=4), SlotLayout(content=6, explicit=False)
COLORS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class BoxRenderer(Renderer):
    """Slot 0 is black background; every other slot is a box whose left, top, right and bottom the slot
    holds."""

    def __init__(self) -> None:
        super().__init__()
        self.pictures = 0
        self.largest = 0

    def masks(self, slots_BKD: Tensor) -> Tensor:
        self.pictures += len(slots_BKD)
        self.largest = max(self.largest, len(slots_BKD))
        left, top, right, bottom = slots_BKD[..., :4, None, None].unbind(2)
        y, x = torch.arange(H)[:, None] + 0.5, torch.arange(W) + 0.5
        masks = ((x > left) & (x < right) & (y > top) & (y < bottom)).float()
        masks[:, 0] = 1 - masks[:, 1:].sum(1)
        return masks

    def forward(self, slots_BKD: Tensor) -> Rendered:
        masks = self.masks(slots_BKD)
        objects = (COLORS * 2.2 - 1.1)[None, :, :, None, None].expand(len(masks), -1, -1, H, W)  # overshoots
        return Rendered((masks[:, :, None] * objects).sum(1), masks, lambda: objects)


def boxes(B: int = 2, T: int = 4) -> Rollout:
    """Slot 1 moves right by 2 pixels a frame, and down by 8 from one sequence to the next; slot 2 stands
    still."""
    slots = torch.zeros(B, T, 3, 6)
    for b in range(B):
        for t in range(T):
            slots[b, t, 1, :4] = torch.tensor([2.0 + 2 * t, 3 + 8 * b, 8 + 2 * t, 7 + 8 * b])
            slots[b, t, 2, :4] = torch.tensor([20, 24, 30, 30])
    texts = tuple(f"put block {b} in the bowl" for b in range(B))
    return Rollout(slots, texts, (H, W), UNPLACED, BoxRenderer())


def renderer_of(rollout: Rollout) -> BoxRenderer:
    assert isinstance(rollout.renderer, BoxRenderer)
    return rollout.renderer


def test_nothing_is_decoded_before_somebody_looks_and_nothing_twice() -> None:
    rollout = boxes()
    _ = repr(rollout), len(rollout), rollout.select(0), rollout.last
    assert renderer_of(rollout).pictures == 0
    assert rollout.decode_masks([1, -1]).shape == (2, 2, 3, H, W)
    assert renderer_of(rollout).pictures == 4
    assert rollout.masks.shape == (2, 4, 3, H, W)
    assert renderer_of(rollout).pictures == 8
    assert rollout.masks is not None and rollout.frames.shape == (2, 4, 3, H, W)
    assert renderer_of(rollout).pictures == 16  # colours had not been drawn
    _ = rollout.frames, rollout.masks, rollout.positions, rollout.colors
    assert renderer_of(rollout).pictures == 16


def test_chosen_frames_are_the_same_as_those_of_all() -> None:
    some, everything = boxes().decode_masks([3, 0, 3]), boxes().masks
    assert torch.equal(some, everything[:, [3, 0, 3]])
    assert torch.equal(boxes().decode_masks(slice(1, None, 2)), everything[:, 1::2])
    assert torch.equal(boxes().decode_frames([2]), boxes().frames[:, [2]])
    for wrong in ([4], [-5]):
        with pytest.raises(IndexError):
            boxes().decode_masks(wrong)
    with pytest.raises(IndexError, match=r"frames 0\.\.3"):
        boxes().decode_masks([])


def test_objects_are_drawn_alone_and_add_up_to_the_frame() -> None:
    rollout = boxes()
    objects_BtK3HW = rollout.decode_objects([3, 1])
    assert objects_BtK3HW.shape == (2, 2, 3, 3, H, W)
    assert renderer_of(rollout).pictures == 4  # nothing but what was asked for
    for k, color in enumerate(COLORS):
        assert torch.equal(objects_BtK3HW[0, 0, k], color[:, None, None].expand(3, H, W))
    masks_BtKHW = rollout.decode_masks([3, 1])
    summed = (objects_BtK3HW * masks_BtKHW[:, :, :, None]).sum(2)
    torch.testing.assert_close(summed, rollout.decode_frames([3, 1]))
    with pytest.raises(IndexError, match=r"frames 0\.\.3"):
        rollout.decode_objects([])


def test_long_rollouts_are_decoded_in_chunks() -> None:
    rollout = boxes(B=3, T=CHUNK)
    _ = rollout.masks
    assert renderer_of(rollout).pictures == 3 * CHUNK and renderer_of(rollout).largest == CHUNK


def test_tensors_carry_no_gradient_and_frames_stay_in_range() -> None:
    rollout = boxes()
    weight = torch.nn.Parameter(torch.ones(()))
    original = rollout.renderer.masks
    rollout.renderer.masks = lambda slots: original(slots) * weight  # type: ignore[method-assign]
    assert not rollout.frames.requires_grad and not rollout.masks.requires_grad
    assert rollout.frames.min() == 0 and rollout.frames.max() == 1


def test_places_and_colours_are_measured_on_masks_where_slots_do_not_say() -> None:
    rollout = boxes()
    positions = rollout.positions
    torch.testing.assert_close(positions[0, :, 1], torch.tensor([[5.0, 5], [7, 5], [9, 5], [11, 5]]))
    torch.testing.assert_close(positions[1, 0, 1], torch.tensor([5.0, 13]))
    torch.testing.assert_close(rollout.colors[1, 2], COLORS)
    torch.testing.assert_close(rollout.presence, torch.ones(2, 4, 3))


def test_a_faint_tail_of_a_mask_does_not_pull_its_centre() -> None:
    rollout = boxes()
    original = rollout.renderer.masks
    rollout.renderer.masks = lambda slots: original(slots) * 0.91 + 0.03  # type: ignore[method-assign]
    torch.testing.assert_close(rollout.positions[0, 0, 1], torch.tensor([5.0, 5.0]))


def test_places_and_colours_are_read_off_slots_that_say() -> None:
    state = SlotState(
        content=torch.zeros(1, 1, 3, 4),
        color=torch.tensor([-1.0, 0, 1]).expand(1, 1, 3, 3),
        position=torch.tensor([[-1.0, -1], [0, 0], [1 / W - 1, 1 - 1 / H]])[None, None],
        scale=torch.full((1, 1, 3, 2), 0.25),
        presence=torch.tensor([2.0, 1, 0])[None, None, :, None],
    )
    rollout = Rollout(state.join(), ("go",), (H, W), PLACED, BoxRenderer())
    # The centre of the top-left pixel is (0.5, 0.5), so the bottom-left one's is (0.5, H - 0.5).
    torch.testing.assert_close(rollout.positions[0, 0], torch.tensor([[0.0, 0], [W / 2, H / 2], [0.5, H - 0.5]]))
    torch.testing.assert_close(rollout.colors[0, 0, 0], torch.tensor([0.0, 0.5, 1.0]))
    assert rollout.presence.tolist() == [[[1, 1, 0]]]
    assert renderer_of(rollout).pictures == 0


@pytest.mark.parametrize(
    ("index", "kept"),
    [
        (1, [1]),
        (-1, [2]),
        (slice(0, 2), [0, 1]),
        ([2, 0], [2, 0]),
        (np.int64(1), [1]),
        (np.array([2, 1]), [2, 1]),
        (torch.tensor(2), [2]),
        (torch.tensor([0, 2]), [0, 2]),
    ],
)
def test_select_keeps_what_was_decoded(index: Any, kept: list[int]) -> None:
    rollout = boxes(B=3)
    masks = rollout.masks
    part = rollout.select(index)
    assert part.texts == tuple(rollout.texts[i] for i in kept)
    assert torch.equal(part.masks, masks[kept]) and torch.equal(part.slots, rollout.slots[kept])
    assert renderer_of(rollout).pictures == 12


def test_select_of_what_is_not_there_is_an_error() -> None:
    with pytest.raises(IndexError):
        boxes().select(2)


def test_last_is_where_it_ended() -> None:
    rollout = boxes()
    _ = rollout.frames
    last = rollout.last
    assert last.slots.shape == (2, 1, 3, 6) and torch.equal(last.masks[:, 0], rollout.masks[:, -1])
    assert renderer_of(rollout).pictures == 8


def test_it_cannot_be_changed_and_says_what_it_is() -> None:
    rollout = boxes()
    with pytest.raises(dataclasses.FrozenInstanceError):
        rollout.texts = ()  # type: ignore[misc]
    rollout.decode_masks([0])
    assert repr(rollout) == (
        "Rollout(B=2 sequences, T=4 frames, K=3 slots of 6, 32x32 pixels, "
        "imagined from 'put block 0 in the bowl', 'put block 1 in the bowl'; "
        "masks decoded at 1, frames at 0 of 4 times)"
    )
    assert "parsed from frames" in repr(dataclasses.replace(rollout, texts=()))


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_film_plays_every_frame_large_enough_to_see(tmp_path: Path, suffix: str) -> None:
    path = boxes().save(tmp_path / "new" / f"film.{suffix}")
    film = np.stack(list(iio.imiter(path)))
    assert len(film) == 4 and film.shape[-1] == 3
    assert film.shape[1] >= 256 and film.shape[2] >= 256
    red = film[0].astype(int)[: film.shape[1] // 2, : film.shape[2] // 2]
    box = (red[..., 0] > 180) & (red[..., 1] < 70)
    scale = 128 // H
    y, x = np.nonzero(box)
    assert abs(x.mean() - 5 * scale) < 3 and abs(y.mean() - 5 * scale) < 3


def test_a_single_sequence_lies_on_its_side(tmp_path: Path) -> None:
    film = list(iio.imiter(boxes(B=1).save(tmp_path / "a.gif", beside=np.full((1, H, W, 3), 200, np.uint8))))
    assert film[0].shape[1] == 3 * (256 + 4) and film[0].shape[0] < 350
    assert (film[3][100, 100] == 200).all()
    red = film[3].astype(int)[:256, 260:516]
    box = (red[..., 0] > 180) & (red[..., 1] < 70)
    assert abs(np.nonzero(box)[1].mean() - 11 * 8) < 5  # moved by 2 pixels a frame


def test_gif_frames_last_as_long_as_asked(tmp_path: Path) -> None:
    path = boxes().save(tmp_path / "film.gif", fps=5)
    assert iio.immeta(path)["duration"] == pytest.approx(200)


def test_a_strip_shows_moments_side_by_side_and_real_frames_above(tmp_path: Path) -> None:
    rollout = boxes(B=1)
    plain = iio.imread(rollout.save(tmp_path / "plain.png"))
    real = np.full((2, H, W, 3), 200, np.uint8)
    real[1] = 90
    beside = iio.imread(rollout.save(tmp_path / "beside.png", beside=real))
    assert beside.shape[0] == plain.shape[0] + 4 * H + 4 and beside.shape[1] == plain.shape[1] == 4 * (4 * W + 4)
    tops = [beside[10, t * (4 * W + 4) + 10, 0] for t in range(4)]
    assert tops == [200, 90, 90, 90]  # the last real frame stays


def test_slots_keep_their_colour_whatever_their_number() -> None:
    assert np.array_equal(slot_palette(12)[:5], slot_palette(5))
    palette = slot_palette(12)
    distances = np.abs(palette[:, None] - palette[None]).sum(-1) + 9 * np.eye(12)
    assert distances.min() > 0.15


def test_files_it_cannot_write_are_refused_before_anything_is_drawn(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.gif, \.mp4, \.png"):
        boxes().save(tmp_path / "film.webm")
    with pytest.raises(ValueError, match=r"\(T', 32, 32, 3\)"):
        boxes().save(tmp_path / "film.gif", beside=np.zeros((4, 16, 16, 3), np.uint8))
    assert not list(tmp_path.iterdir())
