"""The VQ-VAE: gradients through the codes, and a codebook that is put to use."""

from __future__ import annotations

import pytest
import torch

from textocvp.baselines.mage import Mage
from textocvp.baselines.mage.vqvae import Codebook, perplexity


def test_the_gradient_passes_straight_through_the_codes(model: Mage) -> None:
    frames = torch.rand(2, 3, 32, 32) * 2 - 1
    drawn, _ = model.vqvae(frames)
    (drawn - frames).square().mean().backward()
    first = next(model.vqvae.parameters())
    assert first.grad is not None and first.grad.abs().max() > 0
    # What was chosen is a row of the codebook, whatever the gradient pretends.
    chosen = model.vqvae.encode(frames)
    torch.testing.assert_close(model.vqvae.decode(chosen), drawn.detach(), atol=1e-5, rtol=1e-5)


def test_unused_codes_move_to_where_features_are_and_used_ones_stay() -> None:
    torch.manual_seed(0)
    codebook = Codebook(4, 2)
    before = codebook.codes_KC.detach().clone()
    features = torch.tensor([[5.0, 5.0], [6.0, 6.0], [-7.0, 2.0]])
    unused = torch.tensor([False, True, False, True])
    assert codebook.restart(unused, features, torch.Generator().manual_seed(0)) == 2
    assert torch.equal(codebook.codes_KC[~unused], before[~unused])
    assert all((features == code).all(dim=1).any() for code in codebook.codes_KC[unused])
    assert codebook.restart(torch.zeros(4, dtype=torch.bool), features, torch.Generator()) == 0


def test_perplexity_counts_codes_that_are_used_equally() -> None:
    assert perplexity(torch.tensor([3, 3, 0, 3, 3])) == pytest.approx(4)
    assert perplexity(torch.tensor([0, 9, 0])) == pytest.approx(1)
