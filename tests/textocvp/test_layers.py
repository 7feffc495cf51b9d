"""Attention, its cache and its masks."""

from __future__ import annotations

import pytest
import torch

from textocvp.layers import KeyValueCache, SelfAttention, mask_bias


def attention() -> SelfAttention:
    torch.manual_seed(0)
    return SelfAttention(dim=8, heads=2)


@pytest.mark.parametrize("gradients", [False, True])
def test_with_a_cache_later_tokens_attend_to_all_earlier_ones(gradients: bool) -> None:
    layer, x_BMC = attention(), torch.randn(2, 5, 8)
    with torch.set_grad_enabled(gradients):
        whole = layer(x_BMC, None)
        cache = KeyValueCache(5)
        layer(x_BMC[:, :3], None, cache=cache)
        torch.testing.assert_close(layer(x_BMC[:, 3:], None, cache=cache), whole[:, 3:])
        assert cache.length == 5
        with pytest.raises(ValueError, match="holds 5 tokens, 6 were given"):
            layer(x_BMC[:, :1], None, cache=cache)


def test_the_newest_tokens_alone_are_those_of_all() -> None:
    layer, x_BMC = attention(), torch.randn(2, 5, 8)
    torch.testing.assert_close(layer(x_BMC, None, newest=2), layer(x_BMC, None)[:, -2:])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])  # two implementations
def test_masked_tokens_change_nothing_and_a_row_without_tokens_is_a_number(dtype: torch.dtype) -> None:
    layer, x_BMC = attention().to(dtype), torch.randn(2, 5, 8).to(dtype)
    masked_M = torch.tensor([False, False, True, False, True])
    bias = mask_bias(masked_M.expand(5, 5)).to(dtype)
    before = layer(x_BMC, bias)
    x_BMC[:, masked_M] += 1
    torch.testing.assert_close(layer(x_BMC, bias)[:, ~masked_M], before[:, ~masked_M])
    assert layer(x_BMC, mask_bias(torch.ones(5, 5, dtype=torch.bool)).to(dtype)).isfinite().all()
