"""What every predictor shares: its options, the rollout, and how slots become tokens and tokens become slots.

A predictor has one of two forms (`PredictorConfig.attention`):

- `window`, as published (TextOCVP, TMLR 2026, section 3.2). The last frames attend to each other in both directions,
  a code tells the age of each, and every step computes the whole window again.
- `causal`, ours. A frame attends to itself and to earlier frames, and a code tells its number. So one pass trains all
  frames of an episode, and a rollout keeps keys and values and computes only the newest frame. With `direct` it reads
  the last given frame again instead of the imagined ones.

With `layout.explicit` the network changes a slot's content, position and scale; unused slots and the background stay as
they are. Unused slots are masked. Slots are a set: their order changes only the order of the prediction.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from textocvp.layers import FeedForward, KeyValueCache, sinusoids
from textocvp.slots import SlotLayout, SlotState

if TYPE_CHECKING:
    from textocvp.text.base import TextTokens

FREQUENCIES = 5  # of the position code: wavelengths 2, 1, 1/2, 1/4 and 1/8 of the picture's side
STEP = 0.1  # what an output of 1 means in position or log-scale: about what the arm does in a frame


@dataclass(frozen=True)
class PredictorConfig:
    """The options of every predictor. Sizes are the published ones."""

    kind: str  # a name in `textocvp.predictors.PREDICTORS`
    dim: int = 512  # width of a token
    layers: int = 8
    heads: int = 8  # of a layer
    hidden: int = 1024  # width within each feed-forward net
    attention: Literal["window", "causal"] = "window"  # see the module
    window: int = 10  # the longest past in frames; for `causal` also the longest rollout
    age_encoding: Literal["learned", "sinusoidal"] = "learned"  # of time codes, one per frame for all its slots
    residual: bool = True  # predict the change of the slots instead of the slots
    # Read the given frames for every new frame, not what was imagined between: direct instead of iterated forecasting,
    # so that errors do not add up. For `causal`.
    direct: bool = False
    feed_forwards: Literal[1, 2] = 2  # nets in a layer: 2 as in the authors' code, 1 as in the paper's text
    # Read and change content in units of its deviation over the training slots. The published model does not; explicit
    # slots always do.
    standardize: bool = False

    def __post_init__(self) -> None:
        if self.direct and not self.causal:
            raise ValueError("predictor.direct needs predictor.attention=causal")

    @property
    def causal(self) -> bool:
        """Whether a frame attends to no later frame."""
        return self.attention == "causal"

    @property
    def time_codes(self) -> int:
        """Number of time codes. The published parameter count has one age more than a window has frames."""
        return self.window if self.causal else self.window + 1


@dataclass
class Imagined:
    """A rollout in slot space."""

    slots_BSKD: Tensor  # the S new frames
    attention_BSnhKL: Tensor | None = None  # to the text, of n layers and h heads; sums to 1 over the words L


@dataclass
class RolloutState:
    """What a predictor keeps from step to step of a rollout."""

    text: Any  # what `_text_context` returned, computed once
    caches: list[KeyValueCache | None]  # one for each layer; None: every step computes keys and values again
    unused_BMK: Tensor  # which slots are unused in the M frames that the newest one may attend to
    cached: int = 0  # how many of the M frames are in the caches


class SlotPredictor(nn.Module):
    """From the slots of some frames and a text to the slots of the next.

    Subclasses set `Config` and `uses_text`, and write `_layer`, `_transform` and, if they use text, `_text_context`.
    """

    Config: ClassVar[type[PredictorConfig]]
    uses_text: ClassVar[bool]  # whether the text changes the prediction, and so whether there is attention to it

    content_mean_C: Tensor
    content_std_C: Tensor

    def __init__(self, config: PredictorConfig, layout: SlotLayout, text_dim: int) -> None:
        super().__init__()
        self.config, self.layout = config, layout
        read = layout.content + 3 + 2 + 4 * FREQUENCIES + 2 + 1 if layout.explicit else layout.dim
        self.slot_in = nn.Linear(read, config.dim)
        self.layers = nn.ModuleList(self._layer(text_dim) for _ in range(config.layers))
        self.slot_out = nn.Linear(config.dim, layout.content + 4 if layout.explicit else layout.dim)
        if config.age_encoding == "learned":
            self.ages = nn.Parameter(0.02 * torch.randn(config.time_codes, config.dim))
        else:
            self.register_buffer("ages", sinusoids(config.time_codes, config.dim), persistent=False)
        if self.standardized:
            # Content channels differ in size between parsers; training sets these from its data.
            self.register_buffer("content_mean_C", torch.zeros(layout.content))
            self.register_buffer("content_std_C", torch.ones(layout.content))
            with torch.no_grad():  # "nothing moves" is the first guess
                self.slot_out.weight.mul_(0.1)
                self.slot_out.bias.zero_()

    @property
    def learns_words(self) -> bool:
        """Whether `words_loss` has anything to learn."""
        return False

    @property
    def standardized(self) -> bool:
        """Whether content is read and changed in units of its deviation over the training data."""
        return self.layout.explicit or self.config.standardize

    @abstractmethod
    def _layer(self, text_dim: int) -> nn.Module:
        """A new layer."""

    @abstractmethod
    def _transform(self, x_BTKC: Tensor, state: RolloutState, newest_only: bool) -> tuple[Tensor, Tensor | None]:
        """Apply the layers to one token for each slot of T frames, the last ones of `state.unused_BMK`.

        Returns:
            Tokens (B, T, K, C), or with `newest_only` (B, 1, K, C), and the newest frame's attention to the words
            (B, n, h, K, L), if any.
        """

    def _text_context(self, text: TextTokens, slots_BTKD: Tensor, acting_BK: Tensor | None = None) -> Any:
        """What `_transform` needs of the text and of the slots that a rollout starts from."""
        return None

    def words_loss(self, text: TextTokens, slots_BKD: Tensor, acting_BK: Tensor, known_BK: Tensor) -> Tensor:
        """What there is to learn of words beside the prediction, a scalar; 0 by default.

        Args:
            acting_BK, known_BK: which slots act, and of which that is known.
        """
        return slots_BKD.new_zeros(())

    def _tokens_per_frame(self, slots: int) -> int:
        """How many tokens of a frame with so many slots enter a cache."""
        return slots

    def forward(self, slots_BTKD: Tensor, text: TextTokens, acting_BK: Tensor | None = None) -> Tensor:
        """Teacher forced: `out[:, t]` is the prediction for frame t + 1; `acting_BK` says which slots act, if known.

        In the `window` form every frame sees all T frames, so only `out[:, -1]` is a prediction.

        Raises:
            ValueError: if T is more than `config.window`, or the shapes do not fit.
        """
        self._check(slots_BTKD, text, past=slots_BTKD.shape[1])
        state = self._start(slots_BTKD, text, acting_BK=acting_BK)
        return self._predict(slots_BTKD, state, newest_only=False)[0]

    def rollout(
        self,
        seed_BTKD: Tensor,
        text: TextTokens,
        steps: int,
        *,
        use_cache: bool = True,
        return_attention: bool = False,
        acting_BK: Tensor | None = None,
    ) -> Imagined:
        """Predict `steps` (S) frames after T seed frames, feeding predictions back. Differentiable.

        Args:
            use_cache: keep keys and values (`causal` form only); changes the speed and not the result.
            acting_BK: which slots act, if that is known, as in training.

        Raises:
            ValueError: if S < 1, if the `causal` form would need a past of more than `config.window` frames, if the
                shapes do not fit, or if there is no attention to return.
        """
        if steps < 1:
            raise ValueError(f"a rollout needs at least 1 step, got {steps}")
        if return_attention and not self.uses_text:
            raise ValueError("this predictor uses no text, so there is no attention to its words")
        longest = seed_BTKD.shape[1] + steps - 1
        self._check(seed_BTKD, text, past=longest if self.config.causal else 1)

        # Slots that no scene uses are carried outside the network: same result, less to compute.
        used_K = self.layout.used(seed_BTKD).flatten(0, 1).any(dim=0)
        used_k = (used_K | ~used_K.any()).nonzero().squeeze(-1)
        seed_BTkD = seed_BTKD[:, :, used_k]
        acting_Bk = None if acting_BK is None else acting_BK[:, used_k]
        state = self._start(seed_BTkD, text, longest if use_cache and self.config.causal else 0, acting_Bk)
        read = list(seed_BTkD.unbind(1))  # (B, k, D) each; first the T of the seed, in the end T + S
        imagined, maps = [], []
        for _ in range(steps):
            past_BTkD = torch.stack(read[state.cached :][-self.config.window :], dim=1)
            next_B1kD, map_BnhkL = self._predict(past_BTkD, state, newest_only=True)
            imagined.append(next_B1kD[:, 0])
            read.append(read[-1] if self.config.direct else imagined[-1])
            maps.append(map_BnhkL)

        slots_BSkD = torch.stack(imagined, dim=1).to(seed_BTKD.dtype)
        slots_BSKD = seed_BTKD[:, -1:].repeat(1, steps, 1, 1).index_copy(2, used_k, slots_BSkD)
        if not return_attention:
            return Imagined(slots_BSKD)
        maps_BSnhkL = torch.stack(maps, dim=1)  # type: ignore[arg-type]
        none_BSnhKL = maps_BSnhkL.new_zeros(*maps_BSnhkL.shape[:4], len(used_K), maps_BSnhkL.shape[-1])
        return Imagined(slots_BSKD, none_BSnhKL.index_copy(4, used_k, maps_BSnhkL))

    def _start(
        self, seed_BTKD: Tensor, text: TextTokens, cached_frames: int = 0, acting_BK: Tensor | None = None
    ) -> RolloutState:
        """The state before the first step, with caches for so many frames, or without any."""
        tokens = cached_frames * self._tokens_per_frame(seed_BTKD.shape[2])
        caches = [KeyValueCache(tokens) if tokens else None for _ in self.layers]
        context = self._text_context(text, seed_BTKD, acting_BK)
        return RolloutState(context, caches, self.layout.used(seed_BTKD[:, :0]))

    def _predict(self, slots_BTKD: Tensor, state: RolloutState, newest_only: bool) -> tuple[Tensor, Tensor | None]:
        """The slots after every frame (B, T, K, D), or only after the newest (B, 1, K, D), and its attention."""
        start, T = state.cached, slots_BTKD.shape[1]
        unused_BTK = ~self.layout.used(slots_BTKD)
        state.unused_BMK = torch.cat([state.unused_BMK[:, :start], unused_BTK], dim=1)
        if any(state.caches):
            state.cached = start + T
        # A code tells the number of a frame (`causal`) or its age (`window`).
        codes_TC = self.ages[start : start + T] if self.config.causal else self.ages[:T].flip(0)
        x_BTKC = self.slot_in(self._features(slots_BTKD)) + codes_TC[:, None]
        x_BTKC, map_BnhKL = self._transform(x_BTKC, state, newest_only)
        if newest_only:
            slots_BTKD, x_BTKC = slots_BTKD[:, -1:], x_BTKC[:, -1:]
        return self._update(slots_BTKD, self.slot_out(x_BTKC)), map_BnhKL

    def _masked(self, unused_BMK: Tensor, frames: int) -> Tensor:
        """(B, T, M, K) bool: what the last T frames may not attend to, unused slots and, if `causal`, later frames."""
        masked_BTMK = unused_BMK[:, None].expand(-1, frames, -1, -1)
        if not self.config.causal:
            return masked_BTMK
        number_M = torch.arange(unused_BMK.shape[1], device=unused_BMK.device)
        return masked_BTMK | (number_M > number_M[-frames:, None])[..., None]

    def _features(self, slots: Tensor) -> Tensor:
        """What the network reads of each slot."""
        if not self.layout.explicit:
            return (slots - self.content_mean_C) / self.content_std_C if self.standardized else slots
        state = SlotState.split(slots, self.layout)
        content = (state.content - self.content_mean_C) / self.content_std_C
        rate_f = math.pi / 2 * 2.0 ** torch.arange(FREQUENCIES, device=slots.device)
        angle = (state.position[..., None] * rate_f).flatten(-2)
        position = [state.position, angle.sin(), angle.cos()]
        return torch.cat([content, state.color, *position, _log(state.scale) + 2, state.presence], dim=-1)

    def _update(self, slots: Tensor, out: Tensor) -> Tensor:
        """The next slots (..., D) from the newest ones and the network's output."""
        residual = self.config.residual
        if not self.standardized:
            return slots + out if residual else out
        if not self.layout.explicit:
            return (slots if residual else self.content_mean_C) + self.content_std_C * out
        state = SlotState.split(slots, self.layout)
        content, position, log_scale = out.split([self.layout.content, 2, 2], dim=-1)
        content = (state.content if residual else self.content_mean_C) + self.content_std_C * content
        if residual:
            position = state.position + STEP * position
            log_scale = _log(state.scale) + STEP * log_scale
        moved = SlotState(content, state.color, position, log_scale.exp(), state.presence).join()
        return torch.where(state.is_thing, moved, slots)

    def _check(self, slots_BTKD: Tensor, text: TextTokens, past: int) -> None:
        if slots_BTKD.ndim != 4 or slots_BTKD.shape[-1] != self.layout.dim:
            raise ValueError(f"slots must be (B, T, K, {self.layout.dim}), got {tuple(slots_BTKD.shape)}")
        if len(text) != len(slots_BTKD):
            raise ValueError(f"{len(slots_BTKD)} scenes and {len(text)} texts: give one text for each scene")
        if not 1 <= past <= self.config.window:
            window = f"1 to {self.config.window} frames (`window`)"
            raise ValueError(f"this predictor was built for a past of {window}, this needs {past}")


def feed_forward(config: PredictorConfig) -> nn.Sequential:
    """A feed-forward net after a norm."""
    return nn.Sequential(nn.LayerNorm(config.dim, eps=1e-6), FeedForward(config.dim, config.hidden))


def _log(scale: Tensor) -> Tensor:
    """Logarithm of a slot's scale, bounded for slots that cover nothing."""
    return scale.clamp(min=1e-3).log()
