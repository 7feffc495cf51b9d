"""Batches of whole episodes in slot space, and the recolouring that teaches what colour words mean.

Recolouring puts the colour channels of a scene's slots and of its sentence's lexicon colours into one random order.
A parser whose content ignores hue (`textocvp.parsers.placed`) would have found just these slots in the recoloured
video. So a few caption colours become many, and what they share is "the slot whose colour is the word's". Where words
carry no RGB (every text encoder but `lexicon`) nothing is recoloured: "red" would stay "red" while it turns blue.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from textocvp.data.cache import FrameCache
from textocvp.data.episodes import Episodes
from textocvp.parsers.base import to_frames
from textocvp.slots import SlotLayout, SlotState
from textocvp.text.base import TextEncoder, WordBatch


@dataclass
class SlotBatch:
    """Episodes of one length."""

    slots_BTKD: Tensor  # true slots, float32; slots that no episode of the batch uses are left out
    words: WordBatch  # the sentences, looked up
    episodes_B: np.ndarray  # numbers of the episodes
    channels_B3: Tensor  # the order in which their colour channels are


class SlotBatches:
    """Draws training batches from a slot cache held in memory.

    Args:
        cache: the slots of the training episodes.
        layout: what their numbers mean.
        text: looks the sentences up; its weights are not used.
        frames: T. Shorter episodes stay in their last frame, in which nothing moves; longer ones are cut.
        every: only every so-manyth frame is taken.
        recolor: permute the colour channels, where slots have explicit colour and the words of `text` have RGB.
        color_jitter: standard deviation of a shift of each slot's and each word's colour, in -1..1.
        place_jitter: standard deviation of the noise of `noisy`, in -1..1.
        device: where batches are made; the episodes themselves stay in the main memory.
    """

    def __init__(
        self,
        cache: FrameCache,
        layout: SlotLayout,
        text: TextEncoder,
        frames: int,
        every: int = 1,
        *,
        recolor: bool = True,
        color_jitter: float = 0.03,
        place_jitter: float = 0.01,
        device: torch.device | str = "cpu",
    ) -> None:
        self.layout, self.recolor = layout, recolor and layout.explicit and text.config.words_have_rgb
        self.color_jitter, self.place_jitter, self.device = color_jitter, place_jitter, device
        self._slots_ETKD = padded(cache, frames, every)
        self._words = text.lookup(cache.instructions).to("cpu")

    def __len__(self) -> int:
        return len(self._slots_ETKD)

    @cached_property
    def content_std_C(self) -> Tensor:
        """(C,) as `content_statistics`."""
        return self.content_statistics()[1]

    def content_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (C,) of the content of used slots, over at most 1000 episodes."""
        chosen = self._slots_ETKD[:: max(1, len(self) // 1000)].float().flatten(0, 2)
        if self.layout.explicit:
            chosen = chosen[chosen[:, -1] >= 0.5][:, : self.layout.content]
        # A channel that never changes carries nothing: no tiny deviation may blow its noise up.
        std = chosen.std(dim=0)
        return chosen.mean(dim=0), std.clamp(min=max(1e-3, 0.05 * float(std.median())))

    def draw(self, rng: np.random.Generator, size: int) -> SlotBatch:
        """Episodes picked at random, recoloured."""
        episodes_B = rng.integers(len(self), size=size)
        index = torch.from_numpy(episodes_B)
        slots_BTKD = self._slots_ETKD[index].to(self.device).float()
        words = self._words.select(index).to(self.device)
        channels_B3 = torch.arange(3, device=self.device).expand(size, 3)
        if not self.layout.explicit:
            return SlotBatch(slots_BTKD, words, episodes_B, channels_B3)
        # The used slots of every episode first, cut to the most that any episode of the batch has.
        used_BK = slots_BTKD[..., -1].amax(dim=1) >= 0.5
        order_BK = used_BK.to(torch.int8).argsort(dim=1, descending=True, stable=True)
        order_BK = order_BK[:, : int(used_BK.sum(dim=1).max())]
        slots_BTKD = slots_BTKD.take_along_dim(order_BK[:, None, :, None], dim=2)
        state = SlotState.split(slots_BTKD, self.layout)
        if self.recolor:
            order_B3 = rng.permuted(np.tile(np.arange(3), (size, 1)), axis=1)
            channels_B3 = torch.from_numpy(order_B3).to(self.device)
            words = words.permute_channels(channels_B3)
        # Colour and presence are carried through a rollout: what they are in the first frame they are in all.
        color = state.color[:, :1].take_along_dim(channels_B3[:, None, None], dim=-1)
        rng.random((2, size, 3))  # unused; without it a seed would give other runs than it always did
        color = (color + self._noise(rng, color.shape, self.color_jitter)).expand_as(state.color)
        presence = state.presence[:, :1].expand_as(state.presence)
        slots_BTKD = replace(state, color=color, presence=presence).join()
        colors_BL3 = words.colors_BL3 + self._noise(rng, words.colors_BL3.shape, self.color_jitter)
        words = replace(words, colors_BL3=colors_BL3 * words.names_color_BL[..., None])
        return SlotBatch(slots_BTKD, words, episodes_B, channels_B3)

    def noisy(self, rng: np.random.Generator, slots_BTKD: Tensor) -> Tensor:
        """The same slots, each a little off its place."""
        # A teacher-forced predictor that has only seen exact places cannot come back from its own small errors.
        if not self.layout.explicit or self.place_jitter == 0:
            return slots_BTKD
        state = SlotState.split(slots_BTKD, self.layout)
        noise = self._noise(rng, state.position.shape, self.place_jitter)
        return replace(state, position=state.position + noise * state.is_thing).join()

    def _noise(self, rng: np.random.Generator, shape: tuple[int, ...], deviation: float) -> Tensor:
        return torch.from_numpy(rng.standard_normal(tuple(shape), dtype=np.float32)).to(self.device) * deviation


def padded(slots: FrameCache, frames: int, every: int = 1) -> Tensor:
    """All episodes at one length (E, T, K, D), as stored: every `every`-th frame, then the last again, or cut."""
    return torch.from_numpy(slots.at(np.arange(len(slots)), every * np.arange(frames)))


def true_frames(episodes: Episodes, episodes_B: np.ndarray, times_BS: np.ndarray, channels_B3: Tensor) -> Tensor:
    """Frames (B, S, 3, H, W), -1..1, of these times of these episodes, with their colour channels in these orders."""
    clips = [episodes.frames(index) for index in episodes_B]
    chosen = [clip[np.minimum(times, len(clip) - 1)] for clip, times in zip(clips, times_BS, strict=True)]
    frames_BS3HW = to_frames(np.stack(chosen))
    return frames_BS3HW.take_along_dim(channels_B3.cpu()[:, None, :, None, None], dim=2)
