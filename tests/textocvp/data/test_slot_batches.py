"""Batches of slots: recoloured consistently, and free of what no scene uses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, build
from tests.textocvp.slot_scenes import LAYOUT, scenes
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.data.episodes import EpisodeFile
from textocvp.data.slot_batches import SlotBatches, true_frames
from textocvp.presets import TABLETOP_COLORS, TABLETOP_WORDS
from textocvp.slots import SlotState
from textocvp.text import build_text_encoder
from textocvp.text.words import WordsConfig


def batches(text=None, **changes) -> SlotBatches:
    settings = dict(recolor=True, color_jitter=0.0, place_jitter=0.0) | changes
    return SlotBatches(scenes(), LAYOUT, build(PLACED).text if text is None else text, 6, **settings)


def test_recoloring_permutes_scene_and_words_alike():
    plain, recolored = batches(recolor=False), batches()
    a, b = plain.draw(np.random.default_rng(5), 12), recolored.draw(np.random.default_rng(5), 12)
    assert (a.episodes_B == b.episodes_B).all()
    before, after = SlotState.split(a.slots_BTKD, LAYOUT), SlotState.split(b.slots_BTKD, LAYOUT)
    assert len({tuple(order.tolist()) for order in b.channels_B3}) > 2
    for i, order in enumerate(b.channels_B3):
        torch.testing.assert_close(after.color[i], before.color[i][..., order])
        torch.testing.assert_close(b.words.colors_BL3[i], a.words.colors_BL3[i][..., order])
    assert torch.equal(after.content, before.content) and torch.equal(after.position, before.position)


def test_words_without_rgb_stop_all_recoloring() -> None:
    """Else "red" would be taught to mean whatever colour the red block was given."""
    words = TABLETOP_WORDS + TABLETOP_COLORS
    text = build_text_encoder(WordsConfig("transformer", dim=16, heads=2, hidden=16, vocabulary=words))
    a, b = (batches(text, recolor=recolor).draw(np.random.default_rng(5), 12) for recolor in (False, True))
    assert torch.equal(a.slots_BTKD, b.slots_BTKD)
    assert torch.equal(b.channels_B3, torch.arange(3).expand(12, 3))  # the frames of an image loss stay, too
    jittered = batches(text, color_jitter=0.1).draw(np.random.default_rng(5), 12)
    assert jittered.words.colors_BL3.abs().max() == 0


def test_a_seed_gives_the_batches_that_it_always_gave() -> None:
    """Figures of trained models belong to seeds: these sums are those of the code that trained them."""
    rng = np.random.default_rng(7)
    drawn = batches(color_jitter=0.1, place_jitter=0.1).draw(rng, 5)
    assert drawn.episodes_B.tolist() == [11, 7, 8, 10, 6]
    assert drawn.slots_BTKD.double().sum().item() == pytest.approx(152.02787272632122, abs=1e-9)
    assert drawn.words.colors_BL3.double().sum().item() == pytest.approx(1.7017757669091225, abs=1e-9)
    assert rng.random() == 0.34606143911247844


def test_a_batch_is_made_on_its_own_device_whatever_the_default_is() -> None:
    """On a GPU a tensor that was made without a device would be on the other one."""
    source = batches(color_jitter=0.1, place_jitter=0.1)
    plain = source.draw(np.random.default_rng(5), 4)
    moved = source.noisy(np.random.default_rng(6), plain.slots_BTKD)
    with torch.device("meta"):
        drawn = source.draw(np.random.default_rng(5), 4)
        assert torch.equal(source.noisy(np.random.default_rng(6), drawn.slots_BTKD), moved)
    assert torch.equal(drawn.slots_BTKD, plain.slots_BTKD)


def test_unused_slots_are_left_out_and_colors_stay_those_of_the_first_frame():
    drawn = batches(color_jitter=0.1).draw(np.random.default_rng(0), 4)
    state = SlotState.split(drawn.slots_BTKD, LAYOUT)
    assert drawn.slots_BTKD.shape[2] == 4
    assert (state.presence >= 0.5).all()
    assert torch.equal(state.color, state.color[:, :1].expand_as(state.color))


def test_place_noise_spares_the_canvas():
    source = batches(place_jitter=0.1)
    slots = source.draw(np.random.default_rng(0), 4).slots_BTKD
    moved = (source.noisy(np.random.default_rng(1), slots) - slots).abs().amax(dim=(0, 1))
    canvas = SlotState.split(slots, LAYOUT).presence[0, 0, :, 0] > 1.5
    assert moved[canvas].max() == 0 and moved[~canvas, 7:9].min() > 0
    assert moved[:, :7].max() == 0 and moved[:, 9:].max() == 0


def test_true_frames_are_recolored_like_the_slots(tmp_path: Path) -> None:
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", [6, 4])) as episodes:
        channels_B3 = torch.tensor([[2, 1, 0], [0, 1, 2]])
        frames = true_frames(episodes, np.array([1, 0]), np.array([[1, 9], [0, 5]]), channels_B3)
        clips = [torch.from_numpy(episodes.frames(i)).permute(0, 3, 1, 2) / 127.5 - 1 for i in (1, 0)]
    torch.testing.assert_close(frames[0, 0], clips[0][1].flip(0))
    torch.testing.assert_close(frames[0, 1], clips[0][3].flip(0))  # a short episode stays in its last frame
    torch.testing.assert_close(frames[1, 1], clips[1][5])
