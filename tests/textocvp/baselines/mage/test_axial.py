"""The axial transformer: what may influence what, the cache, and the bonus for codes that were seen."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.textocvp.baselines.mage.conftest import TEXTS, TINY
from textocvp.baselines.mage import Mage


def codes(batch: int, frames: int) -> Tensor:
    return torch.randint(12, (batch, frames, 8, 8), generator=torch.Generator().manual_seed(1))


def test_a_later_frame_changes_no_earlier_prediction(model: Mage) -> None:
    seen, text = codes(2, 4), model.text(TEXTS)
    before = model.axial(seen, text, torch.ones(2))
    changed = seen.clone()
    changed[:, 2:] = (changed[:, 2:] + 1) % 12
    after = model.axial(changed, text, torch.ones(2))
    torch.testing.assert_close(after[:, :2], before[:, :2])
    assert (after[:, 2:] - before[:, 2:]).abs().max() > 1e-2


def test_the_text_reaches_every_prediction(model: Mage) -> None:
    seen = codes(1, 3).expand(2, -1, -1, -1)
    scores = model.axial(seen, model.text(TEXTS), torch.ones(2))
    assert ((scores[0] - scores[1]).abs().flatten(1).amax(dim=1) > 1e-3).all()


def test_padding_of_a_longer_neighbour_changes_nothing(model: Mage) -> None:
    seen = codes(2, 2)
    longer = [TEXTS[0], TEXTS[1] + " and then put the red block in the blue bowl"]
    alone = model.axial(seen[:1], model.text(TEXTS[:1]), torch.ones(1))
    together = model.axial(seen, model.text(longer), torch.ones(2))
    torch.testing.assert_close(together[:1], alone, atol=1e-4, rtol=1e-4)


def test_imagining_with_the_cache_and_without_is_the_same(model: Mage) -> None:
    seen, text = codes(2, 1), model.text(TEXTS)
    cached = model.axial.imagine(seen, text, 5)
    plain = seen
    for _ in range(5):  # all frames so far are read again for each new one
        scores = model.axial(plain, text, torch.ones(2))[:, -1]
        plain = torch.cat([plain, model.axial.frames(scores.argmax(-1))[:, None]], dim=1)
    assert torch.equal(cached, plain[:, 1:])
    assert len(cached.unique()) > 1
    with pytest.raises(ValueError, match="at most 6 in all"):
        model.axial.imagine(seen, text, 6)


def test_copying_only_adds_to_codes_that_were_seen() -> None:
    torch.manual_seed(0)
    assert Mage(TINY).axial.keep is None
    model = Mage(replace(TINY, axial=replace(TINY.axial, copy=True))).eval()
    seen = torch.tensor([2, 7])[None, :, None, None].expand(1, 2, 8, 8)  # code 2 everywhere, then code 7
    text = model.text(["put the red block in the blue bowl"])
    assert model.axial.keep is not None
    with torch.no_grad():
        model.axial.keep.weight.zero_()
        model.axial.keep.bias.zero_()
        before = model.axial(seen, text, torch.ones(1))
        model.axial.keep.bias.copy_(torch.tensor([3.0, 5.0]))  # as it is now, as it was first
        added = model.axial(seen, text, torch.ones(1)) - before
    expected = torch.zeros_like(added)
    expected[:, 0, ..., 2] = 3 + 5
    expected[:, 1, ..., 7], expected[:, 1, ..., 2] = 3, 5
    torch.testing.assert_close(added, expected, atol=1e-5, rtol=0)
