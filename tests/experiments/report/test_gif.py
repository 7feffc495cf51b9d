import io

import numpy as np
import pytest
from PIL import Image

from experiments.report.gif import BACKGROUND, PALETTE, UNMATCHED, gif, slot_colors


def test_a_clip_plays_at_the_length_of_its_longest_panel() -> None:
    short = np.zeros((2, 8, 8, 3), np.uint8)
    long = np.stack([np.full((8, 8, 3), 40 * t, np.uint8) for t in range(6)])
    film = Image.open(io.BytesIO(gif([[short, long]], scale=2, gap=2)))
    assert film.size == (2 * (8 + 2 + 8), 2 * 8)
    assert film.n_frames == 6
    film.seek(5)
    assert film.convert("RGB").getpixel((30, 4)) == (200, 200, 200)


def test_a_clip_needs_panels_that_fit() -> None:
    with pytest.raises(ValueError, match="at least one"):
        gif([[]])
    with pytest.raises(ValueError, match="differ in size"):
        gif([[np.zeros((2, 8, 8, 3), np.uint8), np.zeros((2, 9, 8, 3), np.uint8)]])


def test_slots_take_the_colour_of_what_they_cover() -> None:
    segmentation = np.zeros((8, 8), int)
    segmentation[:4, :4] = 2
    segmentation[4:, 4:] = 3
    slots = np.where(segmentation == 2, 5, np.where(segmentation == 3, 1, 0))
    slots[0, 7] = 4  # a slot in the background
    colors = slot_colors(slots, segmentation, slots=7, objects=2)
    assert (colors[5] == PALETTE[0]).all() and (colors[1] == PALETTE[1]).all()
    assert (colors[0] == BACKGROUND).all()
    assert (colors[6] == UNMATCHED).all()  # covers nothing
