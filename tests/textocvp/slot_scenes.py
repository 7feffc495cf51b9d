"""Slots of scenes in which one slot moves: what a parser would find, without a parser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from textocvp.data.cache import FrameCache
from textocvp.data.episodes import Episodes
from textocvp.data.slot_batches import padded
from textocvp.slots import SlotLayout, SlotState

LAYOUT = SlotLayout(content=4)
EPISODES, FRAMES, SLOTS = 12, 6, 5


class _Sentences(Episodes):
    """Episodes of which only the sentences are asked."""

    def __init__(self, path: Path = Path(), first: int | None = None) -> None:
        texts = ("put the red block in the blue bowl", "put the green block in the gray bowl")
        self.path, self.image_size = path, 1
        self.instructions, self.lengths = texts * (EPISODES // 2), np.full(EPISODES, FRAMES)

    @classmethod
    def detect(cls, path: Path) -> bool:
        return False

    def frames(self, index: int) -> np.ndarray:
        return np.zeros((FRAMES, 1, 1, 3), np.uint8)


def scenes() -> FrameCache:
    """Slots of scenes in which slot 1 moves right; slot 0 is the canvas, the last one is unused."""
    rng = np.random.default_rng(0)
    shape = (EPISODES, FRAMES, SLOTS)

    def still(low: float, high: float, width: int) -> torch.Tensor:
        values = rng.uniform(low, high, size=(EPISODES, 1, SLOTS, width)).astype(np.float32)
        return torch.from_numpy(values).repeat(1, FRAMES, 1, 1)

    content = torch.from_numpy(rng.normal(size=(*shape, 4)).astype(np.float32))
    color, position = still(-1, 1, 3), still(-0.5, 0.5, 2)
    state = SlotState(content, color, position, torch.full((*shape, 2), 0.1), torch.ones(*shape, 1))
    state.position[:, :, 1, 0] += torch.arange(FRAMES) * 0.05
    state.presence[:, :, 0] = 2
    state.presence[:, :, -1] = 0
    cache = FrameCache(Path("nowhere"), _Sentences(), "")
    cache.values = state.join().flatten(0, 1).half().numpy()  # in memory only
    return cache


def true_slots(frames: int) -> torch.Tensor:
    """The scenes (E, T, K, D), float32, their last frame repeated."""
    return padded(scenes(), frames).float()
