"""The shipped parser on painted clips: what it must do whatever its weights are."""

from __future__ import annotations

import pytest
import torch

from textocvp.parsers import build_parser
from textocvp.parsers.placed import PlacedConfig, PlacedParser
from textocvp.slots import SlotLayout, SlotState

CONFIG = PlacedConfig(num_slots=6, layout=SlotLayout(content=16), hidden=32)
RED, BLUE, DARK = (255, 87, 89), (78, 121, 167), (47, 47, 47)


def clip(frames: int = 5, step: int = 4) -> torch.Tensor:
    """(1, T, 3, 64, 64): a red box that moves right by `step` pixels a frame and passes below a blue one."""
    video = torch.tensor(DARK, dtype=torch.float32)[:, None, None].expand(frames, 3, 64, 64).clone()
    for t in range(frames):
        video[t, :, 12:20, 10 + step * t : 18 + step * t] = torch.tensor(RED, dtype=torch.float32)[:, None, None]
        video[t, :, 30:46, 20:40] = torch.tensor(BLUE, dtype=torch.float32)[:, None, None]
    return video[None] / 127.5 - 1


def parser() -> PlacedParser:
    torch.manual_seed(0)
    built = build_parser(CONFIG).eval()
    assert isinstance(built, PlacedParser)
    return built


def test_a_slot_keeps_its_thing_and_knows_where_it_is() -> None:
    with torch.no_grad():
        parsed = parser()(clip())
    state = SlotState.split(parsed.slots_BTKD, CONFIG.layout)
    columns = (state.position[0, :, 2, 0] + 1) * 32  # slot 1 is the larger, blue box
    torch.testing.assert_close(columns, torch.tensor([14.0, 18, 22, 26, 30]), atol=0.2, rtol=0)
    torch.testing.assert_close(
        (state.position[0, :, 1] + 1) * 32, torch.tensor([[30.0, 38]]).expand(5, 2), atol=0.2, rtol=0
    )
    torch.testing.assert_close(state.scale[0, 0, 2] * 32, torch.full((2,), 8 / 12**0.5), atol=0.1, rtol=0)
    torch.testing.assert_close(
        (state.color[0, 0, 2] + 1) * 127.5, torch.tensor(RED, dtype=torch.float32), atol=1, rtol=0
    )
    assert state.presence[0, 0, :, 0].tolist() == [2, 1, 1, 0, 0, 0]


def test_a_hidden_thing_keeps_its_slot() -> None:
    video = clip()
    hidden = video.clone()
    hidden[:, 2:4, :, 10:22] = video[:, 2:4, :, :1, :1]  # the red box vanishes for two frames
    with torch.no_grad():
        parsed = parser()(hidden)
    state = SlotState.split(parsed.slots_BTKD, CONFIG.layout)
    assert torch.equal(state.position[0, 1, 2], state.position[0, 2, 2])
    torch.testing.assert_close((state.position[0, 4, 2, 0] + 1) * 32, torch.tensor(30.0), atol=0.2, rtol=0)


def test_content_does_not_change_when_color_channels_are_permuted() -> None:
    order = [2, 0, 1]
    model = parser()
    with torch.no_grad():
        plain = SlotState.split(model(clip()).slots_BTKD, CONFIG.layout)
        permuted = SlotState.split(model(clip()[:, :, order]).slots_BTKD, CONFIG.layout)
    torch.testing.assert_close(permuted.content, plain.content, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(permuted.position, plain.position, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(permuted.color, plain.color[..., order], atol=1e-5, rtol=1e-5)


def test_gradients_reach_every_learned_part() -> None:
    model = parser()
    parsed = model(clip())
    assert parsed.expected_BTKD is not None
    (parsed.slots_BTKD.square().sum() + parsed.expected_BTKD.square().sum()).backward()
    untouched = [name for name, p in model.named_parameters() if p.grad is None]
    assert not untouched


def test_slot_number_can_be_raised_at_test_time() -> None:
    with torch.no_grad():
        few, many = (parser()(clip(), num_slots=k).slots_BTKD for k in (4, 9))
    assert many.shape[2] == 9
    torch.testing.assert_close(many[:, :, :4], few, atol=1e-5, rtol=1e-5)


def test_configurations_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'placed' needs parser\.layout\.explicit = true"):
        PlacedConfig(layout=SlotLayout(content=8, explicit=False))
    with pytest.raises(ValueError, match=r"transition_heads = 3 does not divide the transition's width 128"):
        PlacedConfig(transition_heads=3)
