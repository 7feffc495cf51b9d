"""What every predictor is: slots of some frames in, slots of the next frame out, and rollouts of that.

Two forms (`PredictorConfig.attention`). `window` is the published one (TextOCVP, TMLR 2026, section 3.2): the last
frames attend to each other in both directions, codes tell the age of a frame, every step recomputes the window.
`causal` is ours: a frame attends to itself and its past, so one pass trains every frame of an episode, and a
rollout keeps keys and values and only computes the newest frame.

With `layout.explicit` the network reads a slot's content, colour, place, size and presence, and changes only
content, place and size; colour and presence are handed on as they are. Slots with presence < .5 are neither
heard nor changed. Either way slots are a set: reordering the slots of a scene reorders the prediction and
nothing else.

What the network does between reading and changing is the subclass's business.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from textocvp.config import PredictorConfig
from textocvp.layers import MASKED, KeyValueCache, sinusoids
from textocvp.slots import SlotLayout, SlotState
from textocvp.text.base import TextTokens

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


class Caches:
    """What a causal rollout has seen: keys and values of each layer, and which slots were absent in each frame."""

    def __init__(self, layers: int, capacity: int) -> None:
        self.layers = [KeyValueCache(capacity) for _ in range(layers)]
        self._absent_BMK: Tensor | None = None

    @property
    def frames(self) -> int:
        """How many frames were seen."""
        return 0 if self._absent_BMK is None else self._absent_BMK.shape[1]

    def append(self, absent_BTK: Tensor) -> Tensor:
        """Add T frames; returns what was absent in all M frames (B, M, K)."""
        if self._absent_BMK is not None:
            absent_BTK = torch.cat([self._absent_BMK, absent_BTK], dim=1)
        self._absent_BMK = absent_BTK
        return absent_BTK


@dataclass
class Memory:
    """What stays the same from step to step of a rollout; subclasses of the predictor may add to it."""

    caches: Caches | None


class SlotPredictor(nn.Module):
    """A predictor of slots. Subclasses write `_transform` and, where they need more, `_remember`.

    Args:
        config: sizes and form.
        layout: what the numbers of a slot mean.
        layers: what `_transform` consists of.
    """

    hears_text: ClassVar[bool]
    """Whether the text changes the prediction, and so whether there is attention to its words."""

    content_mean_C: Tensor
    content_std_C: Tensor

    def __init__(self, config: PredictorConfig, layout: SlotLayout, layers: Iterable[nn.Module]) -> None:
        super().__init__()
        self.config, self.layout = config, layout
        explicit = layout.explicit
        self.slot_in = nn.Linear(
            layout.content + 3 + 2 + 4 * FREQUENCIES + 2 + 1 if explicit else layout.dim, config.dim
        )
        self.layers = nn.ModuleList(layers)
        self.slot_out = nn.Linear(config.dim, layout.content + 4 if explicit else layout.dim)
        # The published parameter count has one age more than a window has frames.
        rows = config.window + (config.attention == "window")
        if config.age_encoding == "learned":
            self.ages = nn.Parameter(0.02 * torch.randn(rows, config.dim))
        else:
            self.register_buffer("ages", sinusoids(rows, config.dim), persistent=False)
        if self.standardized:
            # Content channels differ in size between parsers; training sets these from its data.
            self.register_buffer("content_mean_C", torch.zeros(layout.content))
            self.register_buffer("content_std_C", torch.ones(layout.content))
            with torch.no_grad():  # "nothing moves" is the first guess
                self.slot_out.weight.mul_(0.1)
                self.slot_out.bias.zero_()

    @property
    def standardized(self) -> bool:
        """Whether content is read and changed in units of its deviation over the training data."""
        return self.layout.explicit or self.config.standardize

    # ---- what subclasses write

    @abstractmethod
    def _transform(
        self,
        x_BTKC: Tensor,
        absent_BMK: Tensor,
        frame_bias: Tensor | None,
        memory: Memory,
        *,
        newest_only: bool,
    ) -> tuple[Tensor, Tensor | None]:
        """Let tokens and words talk to each other.

        Args:
            x_BTKC: one token a slot of each of T frames.
            absent_BMK: absent slots, which must not be heard; M > T where `memory.caches` holds older frames.
            frame_bias: logit terms (1 or B, T, M) that say which frames may hear which; None: each hears all.
            memory: what `_remember` returned.
            newest_only: nobody asks for the tokens of any frame but the newest, so they may be left out.

        Returns:
            tokens (B, T or fewer, K, C), and the newest frame's attention to the words (B, n, h, K, L), if any.
        """
        raise NotImplementedError

    def _remember(self, text: TextTokens, slots_BKD: Tensor, caches: Caches | None) -> Memory:
        """What a rollout asks of the text and of the slots that it starts from, computed once."""
        return Memory(caches)

    def _cached_tokens(self, slots: int) -> int:
        """How many tokens of a frame of so many slots go into a cache, for each sequence that attention sees."""
        return slots

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
        memory = self._remember(text, slots_BTKD[:, -1], None)
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
                past, if the shapes do not fit, or if the attention of a predictor that hears no text is asked for.
        """
        if steps < 1:
            raise ValueError(f"a rollout needs at least 1 step, got {steps}")
        if return_attention and not self.hears_text:
            raise ValueError("this predictor hears no text, so there is no attention to its words")
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
        frames, maps = list(seed_BTKD.unbind(1)), []
        caches = None
        if use_cache and self.config.attention == "causal":
            tokens = (len(frames) + steps - 1) * self._cached_tokens(seed_BTKD.shape[2])
            caches = Caches(len(self.layers), tokens)
        memory = self._remember(text, seed_BTKD[:, -1], caches)
        fresh = len(frames)  # frames that the caches have not seen
        for _ in range(steps):
            past = frames[-(self.config.window if caches is None else fresh) :]
            next_BTKD, map_BnhKL = self._predict(torch.stack(past, dim=1), memory, newest_only=True)
            frames.append(next_BTKD[:, -1])
            fresh = 1
            if return_attention:
                maps.append(map_BnhKL)
        slots_BSKD = torch.stack(frames[-steps:], dim=1)
        return Imagined(slots_BSKD, torch.stack(maps, dim=1) if return_attention else None)  # type: ignore[arg-type]

    def _predict(
        self,
        slots_BTKD: Tensor,
        memory: Memory,
        *,
        newest_only: bool,
        forgetful_B: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """The next slots after every frame (B, T, K, D), or with `newest_only` after the newest (B, 1, K, D).

        Also the text attention of the newest frame (B, n, h, K, L), if the predictor hears text.
        """
        frames, caches = slots_BTKD.shape[1], memory.caches
        start = 0 if caches is None else caches.frames
        absent_BMK = ~self._present(slots_BTKD)
        if caches is not None:
            absent_BMK = caches.append(absent_BMK)
        x_BTKC = self.slot_in(self._features(slots_BTKD)) + self._codes(start, frames)[:, None]
        frame_bias = self._frame_bias(start, frames, forgetful_B, slots_BTKD.device)
        x_BTKC, maps = self._transform(x_BTKC, absent_BMK, frame_bias, memory, newest_only=newest_only)
        if newest_only:
            slots_BTKD, x_BTKC = slots_BTKD[:, -1:], x_BTKC[:, -1:]
        return self._update(slots_BTKD, self.slot_out(x_BTKC)), maps

    # ---- their parts

    def _features(self, slots: Tensor) -> Tensor:
        """What the network reads of each slot (..., E)."""
        if not self.layout.explicit:
            return (slots - self.content_mean_C) / self.content_std_C if self.standardized else slots
        state = SlotState.split(slots, self.layout)
        content = (state.content - self.content_mean_C) / self.content_std_C
        rate_f = math.pi / 2 * 2.0 ** torch.arange(FREQUENCIES, device=slots.device)
        angle = (state.position[..., None] * rate_f).flatten(-2)
        fourier = [state.position, angle.sin(), angle.cos()]
        return torch.cat([content, state.color, *fourier, _log(state.scale) + 2, state.presence], dim=-1)

    def _update(self, slots: Tensor, out: Tensor) -> Tensor:
        """The next slots (..., D) from the newest ones and what the network says about them."""
        residual = self.config.residual
        if not self.layout.explicit:
            if not self.standardized:
                return slots + out if residual else out
            return (slots if residual else self.content_mean_C) + self.content_std_C * out
        state = SlotState.split(slots, self.layout)
        content, position, log_scale = out.split([self.layout.content, 2, 2], dim=-1)
        if residual:
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

    def _frame_bias(
        self, start: int, frames: int, forgetful_B: Tensor | None, device: torch.device
    ) -> Tensor | None:
        """Logit terms (1 or B, T, M) between frames: nobody hears the future (`causal`), the forgetful not the past."""
        causal = self.config.attention == "causal" and frames > 1
        if not causal and forgetful_B is None:
            return None
        ask_T = torch.arange(start, start + frames, device=device)
        asked_M = torch.arange(start + frames, device=device)
        bias = torch.zeros(1, frames, start + frames, device=device)
        if causal:
            bias = bias + MASKED * (asked_M > ask_T[:, None])
        if forgetful_B is not None:
            bias = bias + MASKED * forgetful_B[:, None, None] * (asked_M != ask_T[:, None])
        return bias

    def _codes(self, start: int, frames: int) -> Tensor:
        """The time code of each frame (T, C): its age (`window`) or its index (`causal`)."""
        if self.config.attention == "window":
            return self.ages[:frames].flip(0)
        return self.ages[start : start + frames]

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


def mask_bias(absent: Tensor) -> Tensor:
    """Logit terms that keep absent slots from being heard: 0 or `NEVER`, of the same shape."""
    return torch.zeros(absent.shape, device=absent.device).masked_fill(absent, MASKED)


def _log(scale: Tensor) -> Tensor:
    """Logarithm of a slot's scale, bounded for slots that cover nothing."""
    return scale.clamp(min=1e-3).log()
