"""Image decoders: their published sizes, and that every feature reaches the picture near its own place."""

from __future__ import annotations

import pytest
import torch

from textocvp.renderers.image_decoders import NonLocalBlock, build_image_decoder


@pytest.mark.parametrize(("kind", "parameters"), [("cnn", 13_276_419), ("vqgan", 24_645_443)])
def test_sizes_are_about_the_papers(kind: str, parameters: int) -> None:
    with torch.device("meta"):
        decoder = build_image_decoder(kind, 768, 1024, 24, 336)  # type: ignore[arg-type]
        frames = decoder(torch.empty(1, 768, 24, 24))
    assert sum(p.numel() for p in decoder.parameters()) == parameters
    assert frames.shape == (1, 3, 336, 336)


@pytest.mark.parametrize("kind", ["cnn", "vqgan"])
def test_a_feature_is_drawn_where_it_is(kind: str) -> None:
    torch.manual_seed(0)
    decoder = build_image_decoder(kind, 5, 32, 4, 56)  # type: ignore[arg-type]
    features = torch.randn(2, 5, 4, 4)
    frames = decoder(features)
    assert frames.shape == (2, 3, 56, 56)  # 64 pixels, resized
    frames.sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in decoder.parameters())

    with torch.no_grad():
        for parameter in decoder.parameters():
            if parameter.ndim == 4:  # every convolution a blur
                parameter.fill_(1 / parameter[0].numel())
        for module in decoder.modules():
            if isinstance(module, torch.nn.Conv2d) and module.bias is not None:
                module.bias.zero_()
        features = features.abs()
        changed = features.clone()
        changed[0, :, 1, 2] += 1
        difference = (decoder(changed) - decoder(features)).abs().mean(1)
    assert difference[1].max() == 0
    cells = torch.nn.functional.avg_pool2d(difference[:1], 14)[0]
    assert cells.argmax() == 4 + 2


def test_the_non_local_block_lets_every_location_see_all_others() -> None:
    torch.manual_seed(0)
    block = NonLocalBlock(8)
    x = torch.randn(1, 8, 3, 3, requires_grad=True)
    out = block(x)
    out[0, :, 0, 0].sum().backward()
    assert x.grad is not None and (x.grad.abs().sum(1) > 0).all()
    order = torch.randperm(9)
    shuffled = block(x.flatten(2)[:, :, order].unflatten(2, (3, 3)))
    torch.testing.assert_close(shuffled.flatten(2), out.flatten(2)[:, :, order], atol=1e-5, rtol=1e-4)


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(ValueError, match=r"image_channels must be a multiple of 32, not 48"):
        build_image_decoder("cnn", 8, 48, 4, 16)
