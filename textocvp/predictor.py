"""From the slots of some frames and a text to the slots of the next: the language-conditioned transformer.

Two forms (`PredictorConfig.attention`). `window` is the published one (TextOCVP, TMLR 2026, section 3.2):
slots of the last frames attend to each other in both directions, codes tell the age of a frame, every step
recomputes the window. `causal` is ours: a frame attends to itself and its past, so one pass trains every
frame of an episode, and a rollout keeps keys and values and only computes the newest frame.

With `layout.explicit` the network reads a slot's content, colour, place, size and presence, and changes only
content, place and size; colour and presence are handed on as they are. Slots with presence < .5 are neither
heard nor changed. Either way slots are a set: reordering the slots of a scene reorders the prediction and
nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from textocvp.attention import NEVER, KeyValueCache
from textocvp.config import PredictorConfig
from textocvp.predictor_layer import PredictorLayer, color_match
from textocvp.slots import SlotLayout, SlotState
from textocvp.text import TextTokens, sinusoids

FREQUENCIES = 5  # of the position code: wavelengths 2, 1, 1/2, 1/4 and 1/8 of the picture's side
STEP = 0.1  # what an output of 1 means in position or log-scale: about what the arm does in a frame


@dataclass
class Imagined:
    """A rollout in slot space.

    Attributes:
        slots_BSKD: the S new frames.
        attention_BSnhKL: text-to-slot attention of each new frame, n layers, h heads; sums to 1 over the
            words L.
    """

    slots_BSKD: Tensor
    attention_BSnhKL: Tensor | None = None


@dataclass
class _TextMemory:
    """What a rollout asks of the text, computed once: keys and values of each layer, and logit terms."""

    keys_values: list[tuple[Tensor, Tensor]]
    mask_bias_B11L: Tensor
    match_BKL: Tensor | None


class Predictor(nn.Module):
    """The predictor of one `PredictorConfig`.

    Args:
        config: sizes and form.
        layout: what the numbers of a slot mean.
        text_dim: width of the text tokens.

    Raises:
        ValueError: if `color_bias` is asked for without explicit slot colours.
    """

    content_mean_C: Tensor
    content_std_C: Tensor

    def __init__(self, config: PredictorConfig, layout: SlotLayout, text_dim: int) -> None:
        super().__init__()
        if config.color_bias and not layout.explicit:
            raise ValueError("color_bias needs slots with explicit colour (layout.explicit)")
        self.config, self.layout = config, layout
        explicit = layout.explicit
        self.slot_in = nn.Linear(
            layout.content + 3 + 2 + 4 * FREQUENCIES + 2 + 1 if explicit else layout.dim, config.dim
        )
        self.layers = nn.ModuleList(PredictorLayer(config, text_dim) for _ in range(config.layers))
        self.slot_out = nn.Linear(config.dim, layout.content + 4 if explicit else layout.dim)
        # The published parameter count has one age more than a window has frames.
        rows = config.window + (config.attention == "window")
        if config.age_encoding == "learned":
            self.ages = nn.Parameter(0.02 * torch.randn(rows, config.dim))
        else:
            self.register_buffer("ages", sinusoids(rows, config.dim), persistent=False)
        if explicit:
            # Content channels differ in size between parsers; training sets these from its data.
            self.register_buffer("content_mean_C", torch.zeros(layout.content))
            self.register_buffer("content_std_C", torch.ones(layout.content))
            with torch.no_grad():  # "nothing moves" is the first guess
                self.slot_out.weight.mul_(0.1)
                self.slot_out.bias.zero_()

    # ---- rollouts and teacher forcing

    def forward(self, slots_BTKD: Tensor, text: TextTokens, forgetful_B: Tensor | None = None) -> Tensor:
        """Teacher forced: `out[:, t]` is the prediction for frame t + 1.

        In the `window` form every frame sees all T frames, so only `out[:, -1]` is a prediction.

        Args:
            forgetful_B: sequences in which every frame sees only itself, a handicap for training: the true past gives
                away where the arm is heading, and without it only the text can tell.

        Raises:
            ValueError: if T is more than `config.window`, or the shapes do not fit.
        """
        self._check(slots_BTKD, text, frames=slots_BTKD.shape[1])
        memory = self._remember(text, slots_BTKD[:, -1])
        slots_BTKD, _ = self._predict(slots_BTKD, memory, newest_only=False, forgetful_B=forgetful_B)
        return slots_BTKD

    def rollout(
        self,
        seed_BTKD: Tensor,
        text: TextTokens,
        steps: int,
        *,
        use_cache: bool = True,
        return_attention: bool = False,
    ) -> Imagined:
        """Autoregressive: predict `steps` frames after the T seed frames, feeding predictions back.

        Differentiable. `use_cache` matters to the `causal` form only and changes its speed, not its result.

        Raises:
            ValueError: if `steps` < 1, if the `causal` form would need more than `config.window` frames of
                past, or if the shapes do not fit.
        """
        if steps < 1:
            raise ValueError(f"a rollout needs at least 1 step, got {steps}")
        causal = self.config.attention == "causal"
        self._check(seed_BTKD, text, frames=seed_BTKD.shape[1] + steps - 1 if causal else 1)
        # Slots that no scene of the batch uses are carried outside the network: same result, less to compute.
        used = self._present(seed_BTKD).flatten(0, 1).any(dim=0).nonzero().squeeze(-1)
        if self.layout.explicit and 0 < len(used) < seed_BTKD.shape[2]:
            imagined = self._rollout(seed_BTKD[:, :, used], text, steps, use_cache, return_attention)
            slots_BSKD = seed_BTKD[:, -1:].repeat(1, steps, 1, 1).index_copy(2, used, imagined.slots_BSKD)
            attention = imagined.attention_BSnhKL
            if attention is not None:
                whole = attention.new_zeros(*attention.shape[:4], seed_BTKD.shape[2], attention.shape[-1])
                attention = whole.index_copy(4, used, attention)
            return Imagined(slots_BSKD, attention)
        return self._rollout(seed_BTKD, text, steps, use_cache, return_attention)

    def _rollout(
        self, seed_BTKD: Tensor, text: TextTokens, steps: int, use_cache: bool, return_attention: bool
    ) -> Imagined:
        memory = self._remember(text, seed_BTKD[:, -1])
        frames, maps = list(seed_BTKD.unbind(1)), []
        caches = None
        if use_cache and self.config.attention == "causal":
            tokens = (len(frames) + steps - 1) * seed_BTKD.shape[2]
            caches = _Caches([KeyValueCache(tokens) for _ in self.layers])
        fresh = len(frames)  # frames that the caches have not seen
        for _ in range(steps):
            past = frames[-(self.config.window if caches is None else fresh) :]
            next_BTKD, map_BnhKL = self._predict(
                torch.stack(past, dim=1), memory, newest_only=True, caches=caches
            )
            frames.append(next_BTKD[:, -1])
            fresh = 1
            if return_attention:
                maps.append(map_BnhKL)
        slots_BSKD = torch.stack(frames[-steps:], dim=1)
        return Imagined(slots_BSKD, torch.stack(maps, dim=1) if return_attention else None)

    def _predict(
        self,
        slots_BTKD: Tensor,
        memory: _TextMemory,
        *,
        newest_only: bool,
        caches: _Caches | None = None,
        forgetful_B: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The next slots after every frame (B, T, K, D), or with `newest_only` after the newest (B, 1, K, D).

        Also the text attention of the newest frame (B, n, h, K, L).
        """
        frames, slots = slots_BTKD.shape[1:3]
        start = 0 if caches is None else caches.frames
        x_BTKC = self.slot_in(self._features(slots_BTKD)) + self._codes(start, frames)[:, None]
        x_BNC = x_BTKC.flatten(1, 2)
        bias = self._self_bias(slots_BTKD, caches)
        if forgetful_B is not None:
            frame_N = torch.arange(frames, device=x_BNC.device).repeat_interleave(slots)
            bias = bias + NEVER * forgetful_B[:, None, None, None] * (frame_N[:, None] != frame_N)
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
                cache=None if caches is None else caches.layers[index],
            )
            maps.append(map_BhNL[:, :, -slots:])
        out_BTKE = self.slot_out(x_BNC).unflatten(1, (frames, slots))
        if newest_only:
            slots_BTKD, out_BTKE = slots_BTKD[:, -1:], out_BTKE[:, -1:]
        return self._update(slots_BTKD, out_BTKE), torch.stack(maps, dim=1)

    # ---- their parts

    def _features(self, slots: Tensor) -> Tensor:
        """What the network reads of each slot (..., E)."""
        if not self.layout.explicit:
            return slots
        state = SlotState.split(slots, self.layout)
        content = (state.content - self.content_mean_C) / self.content_std_C
        rate_f = math.pi / 2 * 2.0 ** torch.arange(FREQUENCIES, device=slots.device)
        angle = (state.position[..., None] * rate_f).flatten(-2)
        fourier = [state.position, angle.sin(), angle.cos()]
        return torch.cat([content, state.color, *fourier, _log(state.scale) + 2, state.presence], dim=-1)

    def _update(self, slots: Tensor, out: Tensor) -> Tensor:
        """The next slots (..., D) from the newest ones and what the network says about them."""
        if not self.layout.explicit:
            return slots + out if self.config.residual else out
        state = SlotState.split(slots, self.layout)
        content, position, log_scale = out.split([self.layout.content, 2, 2], dim=-1)
        if self.config.residual:
            content = state.content + self.content_std_C * content
            position = state.position + STEP * position
            log_scale = _log(state.scale) + STEP * log_scale
        else:
            content = self.content_mean_C + self.content_std_C * content
        moved = SlotState(content, state.color, position, log_scale.exp(), state.presence).join()
        # Unused slots and the canvas (presence 2) stay as they are.
        return torch.where(state.is_thing, moved, slots)

    def _present(self, slots: Tensor) -> Tensor:
        """Which slots hold something (..., K), bool."""
        if not self.layout.explicit:
            return torch.ones(slots.shape[:-1], dtype=torch.bool, device=slots.device)
        return slots[..., -1] >= 0.5

    def _self_bias(self, slots_BTKD: Tensor, caches: _Caches | None) -> Tensor:
        """Logit terms of the self-attention: absent slots are not heard, nor is the future (`causal`)."""
        frames, slots = slots_BTKD.shape[1:3]
        absent_BM = ~self._present(slots_BTKD).flatten(1)
        start = 0
        if caches is not None:
            start, absent_BM = caches.frames, caches.append(absent_BM, frames)
        bias_BM = torch.zeros(absent_BM.shape, device=slots_BTKD.device).masked_fill(absent_BM, NEVER)
        bias = bias_BM[:, None, None]
        if self.config.attention == "causal" and frames > 1:
            ask_N = torch.arange(start, start + frames, device=slots_BTKD.device).repeat_interleave(slots)
            asked_M = torch.arange(start + frames, device=slots_BTKD.device).repeat_interleave(slots)
            bias = bias + NEVER * (asked_M[None, :] > ask_N[:, None])
        return bias

    def _codes(self, start: int, frames: int) -> Tensor:
        """The time code of each frame (T, C): its age (`window`) or its index (`causal`)."""
        if self.config.attention == "window":
            return self.ages[:frames].flip(0)
        return self.ages[start : start + frames]

    def _remember(self, text: TextTokens, slots_BKD: Tensor) -> _TextMemory:
        keys_values = [layer.remember(text.embeddings_BLC) for layer in self.layers]  # type: ignore[operator]
        bias_BL = torch.zeros(text.mask_BL.shape, device=slots_BKD.device).masked_fill(~text.mask_BL, NEVER)
        match_BKL = None
        if self.config.color_bias:
            color_BKD = SlotState.split(slots_BKD, self.layout).color
            match_BKL = color_match(color_BKD, self._present(slots_BKD), text)
        return _TextMemory(keys_values, bias_BL[:, None, None], match_BKL)

    def _check(self, slots_BTKD: Tensor, text: TextTokens, frames: int) -> None:
        if slots_BTKD.ndim != 4 or slots_BTKD.shape[-1] != self.layout.dim:
            raise ValueError(f"slots must be (B, T, K, {self.layout.dim}), got {tuple(slots_BTKD.shape)}")
        if len(text) != slots_BTKD.shape[0]:
            raise ValueError(
                f"{slots_BTKD.shape[0]} scenes and {len(text)} texts: give one text for each scene"
            )
        if not 1 <= frames <= self.config.window:
            raise ValueError(
                f"this predictor was built for a past of 1 to {self.config.window} frames (`window`), "
                f"this needs {frames}"
            )


@dataclass
class _Caches:
    """What a causal rollout has seen: keys and values of each layer, and which of those tokens are absent
    slots."""

    layers: list[KeyValueCache]
    absent_BM: Tensor | None = None
    frames: int = 0

    def append(self, absent_BN: Tensor, frames: int) -> Tensor:
        self.absent_BM = (
            absent_BN if self.absent_BM is None else torch.cat([self.absent_BM, absent_BN], dim=1)
        )
        self.frames += frames
        return self.absent_BM


def _log(scale: Tensor) -> Tensor:
    """Logarithm of a slot's scale, bounded for slots that cover nothing."""
    return scale.clamp(min=1e-3).log()
