"""From the slots of some frames and a text to the slots of the next: the language-conditioned transformer.

The published predictor (TextOCVP, TMLR 2026, section 3.2), and `build_predictor`, the one place that picks a kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from textocvp.config import PredictorConfig
from textocvp.ocvp_seq import OcvpSeq
from textocvp.predictor_base import Caches, Imagined, Memory, SlotPredictor, silence
from textocvp.predictor_layer import PredictorLayer, color_match
from textocvp.slots import SlotLayout, SlotState
from textocvp.text import TextTokens

__all__ = ["Imagined", "Predictor", "build_predictor"]


@dataclass
class _TextMemory(Memory):
    """Keys and values of the words for each layer, and logit terms."""

    keys_values: list[tuple[Tensor, Tensor]]
    mask_bias_B11L: Tensor
    match_BKL: Tensor | None


class Predictor(SlotPredictor):
    """All slots of all frames attend to each other and to the words, layer by layer.

    Args:
        config: sizes and form.
        layout: what the numbers of a slot mean.
        text_dim: width of the text tokens.

    Raises:
        ValueError: if `color_bias` is asked for without explicit slot colours.
    """

    hears_text = True

    def __init__(self, config: PredictorConfig, layout: SlotLayout, text_dim: int) -> None:
        if config.color_bias and not layout.explicit:
            raise ValueError("color_bias needs slots with explicit colour (layout.explicit)")
        super().__init__(config, layout, (PredictorLayer(config, text_dim) for _ in range(config.layers)))

    def _remember(self, text: TextTokens, slots_BKD: Tensor, caches: Caches | None) -> _TextMemory:
        keys_values = [layer.remember(text.embeddings_BLC) for layer in self.layers]  # type: ignore[operator]
        match_BKL = None
        if self.config.color_bias:
            color_BKD = SlotState.split(slots_BKD, self.layout).color
            match_BKL = color_match(color_BKD, self._present(slots_BKD), text)
        return _TextMemory(caches, keys_values, silence(~text.mask_BL)[:, None, None], match_BKL)

    def _transform(
        self,
        x_BTKC: Tensor,
        absent_BMK: Tensor,
        frame_bias: Tensor | None,
        memory: Memory,
        *,
        newest_only: bool,
    ) -> tuple[Tensor, Tensor]:
        assert isinstance(memory, _TextMemory)
        frames, slots = x_BTKC.shape[1:3]
        x_BNC = x_BTKC.flatten(1, 2)
        bias = silence(absent_BMK.flatten(1))[:, None, None]
        if frame_bias is not None:
            bias = bias + frame_bias.repeat_interleave(slots, 1).repeat_interleave(slots, 2)[:, None]
        maps = []
        for index, layer in enumerate(self.layers):
            cut = newest_only and frames > 1 and index == len(self.layers) - 1
            if cut:  # nobody asks the last layer for older frames
                bias, frames = bias[..., -slots:, :], 1
            match_BNL = None if memory.match_BKL is None else memory.match_BKL.repeat(1, frames, 1)
            x_BNC, map_BhNL = layer(
                x_BNC,
                bias,
                memory.keys_values[index],
                memory.mask_bias_B11L,
                match_BNL,
                newest=slots if cut else None,
                cache=None if memory.caches is None else memory.caches.layers[index],
            )
            maps.append(map_BhNL[:, :, -slots:])
        return x_BNC.unflatten(1, (frames, slots)), torch.stack(maps, dim=1)


def build_predictor(config: PredictorConfig, layout: SlotLayout, text_dim: int) -> SlotPredictor:
    """The predictor that `config.kind` names.

    Args:
        config: its kind and sizes.
        layout: what the numbers of one slot mean.
        text_dim: width of the text tokens.

    Raises:
        ValueError: if there is no such kind, or it does not fit the layout.
    """
    if config.kind == "textocvp":
        return Predictor(config, layout, text_dim)
    if config.kind == "ocvp-seq":
        return OcvpSeq(config, layout)
    raise ValueError(f"unknown predictor.kind {config.kind!r}; known: textocvp, ocvp-seq")
