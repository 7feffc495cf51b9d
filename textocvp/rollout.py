"""What the world model imagined or parsed: slots, and all that can be read off them.

Decoding costs several times more than predicting, and a planner needs masks at a few frames only. So nothing is drawn
before it is asked for, and nothing is drawn twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from textocvp.layers import pixel_grid
from textocvp.pictures import save_film
from textocvp.renderers.base import Rendered, Renderer, Seen
from textocvp.slots import SlotLayout, SlotState

CHUNK = 64  # pictures that the renderer draws at once: enough to keep two cores busy, and few enough for their cache
CHUNK_SEEN = 8  # where it draws with first frames in mind, which may be large


Draw = Callable[[Tensor, Seen | None], tuple[Tensor, ...]]  # of slots (N, K, D), and what they go on from


@dataclass
class _Decoded:
    """What has been drawn so far, by frame number: masks (B, K, H, W) and frames (B, 3, H, W) in 0..1."""

    masks: dict[int, Tensor] = field(default_factory=dict)
    frames: dict[int, Tensor] = field(default_factory=dict)


@dataclass(frozen=True, repr=False, eq=False)
class Rollout:
    """B sequences of T frames with K slots each. Frame 0 is observed, the others are imagined.

    All tensors are float32 without gradient, on the model's device. Slots keep their number through time: slot 3 of
    frame 20 is the thing that was slot 3 in frame 0.
    """

    slots: Tensor  # (B, T, K, D)
    texts: tuple[str, ...]  # the B instructions; empty if the rollout comes from `WorldModel.parse`
    image_size: tuple[int, int]  # (H, W) in pixels
    layout: SlotLayout  # what the D numbers of a slot mean
    renderer: Renderer  # draws the slots
    attention: Tensor | None = None  # (B, T - 1, layers, heads, K, words) from slots to words, if it was asked for
    # What the renderer keeps of each sequence's first frame, which may be that of an earlier rollout.
    seen: tuple[Seen, ...] | None = None
    _decoded: _Decoded = field(default_factory=_Decoded)

    def __repr__(self) -> str:
        B, T, K, D = self.slots.shape
        texts = ", ".join(map(repr, self.texts[:2])) + (", ..." if len(self.texts) > 2 else "")
        what = f"imagined from {texts}" if self.texts else "parsed from frames"
        H, W = self.image_size
        masks, frames = len(self._decoded.masks), len(self._decoded.frames)
        drawn = f"masks decoded at {masks}, frames at {frames} of {T} times"
        return f"Rollout(B={B} sequences, T={T} frames, K={K} slots of {D}, {H}x{W} pixels, {what}; {drawn})"

    def __len__(self) -> int:
        """B, the number of sequences."""
        return self.slots.shape[0]

    # ---- what the slots look like

    def decode_masks(self, frames: slice | Sequence[int]) -> Tensor:
        """Masks (B, t, K, H, W) of only these frames; an IndexError if there is no such frame."""

        def draw(slots_NKD: Tensor, seen: Seen | None) -> tuple[Tensor, ...]:
            if seen is None:
                return (self.renderer.masks(slots_NKD).float(),)
            return (self._rendered(slots_NKD, seen).masks_BKHW.float(),)

        return self._kept(frames, draw, self._decoded.masks)

    def decode_frames(self, frames: slice | Sequence[int]) -> Tensor:
        """Pictures (B, t, 3, H, W), RGB 0..1, of only these frames; an IndexError if there is no such frame."""

        def draw(slots_NKD: Tensor, seen: Seen | None) -> tuple[Tensor, ...]:
            rendered = self._rendered(slots_NKD, seen)
            return _to_rgb(rendered.frames_B3HW), rendered.masks_BKHW.float()

        return self._kept(frames, draw, self._decoded.frames, self._decoded.masks)

    def decode_objects(self, frames: slice | Sequence[int]) -> Tensor:
        """Every slot drawn alone (B, t, K, 3, H, W), RGB 0..1, at only these frames. These pictures are not kept.

        A picture fills the whole frame; multiply it by its mask to cut the object out. Summed over the slots that
        gives the frame, unless the renderer overshoots 0..1.

        Raises:
            IndexError: if there is no such frame.
        """

        def draw(slots_NKD: Tensor, seen: Seen | None) -> tuple[Tensor, ...]:
            return (_to_rgb(self._rendered(slots_NKD, seen).draw_objects()),)

        return self._draw(self._times(frames), draw, at_once=max(1, CHUNK // self.slots.shape[2]))[0]

    @property
    def masks(self) -> Tensor:
        """(B, T, K, H, W) each slot's share of each pixel; they sum to 1 over the slots."""
        return self.decode_masks(slice(None))

    @property
    def frames(self) -> Tensor:
        """(B, T, 3, H, W) RGB 0..1."""
        return self.decode_frames(slice(None))

    def _times(self, frames: slice | Sequence[int]) -> list[int]:
        T = self.slots.shape[1]
        times = _numbers(T, frames)
        if not times:
            raise IndexError(f"no frame asked for; this rollout has frames 0..{T - 1}")
        return times

    def _kept(self, frames: slice | Sequence[int], draw: Draw, *kept: dict[int, Tensor]) -> Tensor:
        """What `kept[0]` has of these frames; what it lacks is drawn first, and all that `draw` gives is kept."""
        times = self._times(frames)
        new = [t for t in dict.fromkeys(times) if t not in kept[0]]
        if new:
            for kind, drawn in zip(kept, self._draw(new, draw), strict=True):
                for t, one in zip(new, drawn.unbind(1), strict=True):
                    kind.setdefault(t, one)
        return torch.stack([kept[0][t] for t in times], dim=1)

    def _rendered(self, slots_NKD: Tensor, seen: Seen | None) -> Rendered:
        return self.renderer(slots_NKD) if seen is None else self.renderer(slots_NKD, seen)

    @torch.no_grad()
    def _draw(self, times: list[int], draw: Draw, at_once: int = CHUNK) -> list[Tensor]:
        """What `draw` makes of these frames' slots (N, K, D): its results, each (B, t, ...)."""
        B, _, K, D = self.slots.shape
        parts: list[tuple[Tensor, Seen | None]]
        if self.seen is None:
            parts = [(part, None) for part in self.slots[:, times].reshape(-1, K, D).split(at_once)]
        else:
            pairs = zip(self.slots[:, times], self.seen, strict=True)
            at_once = min(at_once, CHUNK_SEEN)
            parts = [(part, seen) for slots_tKD, seen in pairs for part in slots_tKD.split(at_once)]
        drawn = [draw(*part) for part in parts]
        return [torch.cat(part).unflatten(0, (B, len(times))) for part in zip(*drawn, strict=True)]

    # ---- where and what the slots are

    @property
    def positions(self) -> Tensor:
        """(B, T, K, 2) centres (x right, y down) in pixels; the centre of the top-left pixel is (0.5, 0.5).

        Read off the slots where they carry a position; else the centre of mass of the decoded masks.
        """
        if self.layout.explicit:
            return (self._state.position + 1) / 2 * self._pixels_per_side
        H, W = self.image_size
        grid_HW2 = (pixel_grid(H, W, device=self.slots.device) + 1) / 2 * self._pixels_per_side
        return torch.einsum("btkhw,hwc->btkc", self._shares(), grid_HW2)

    @property
    def colors(self) -> Tensor:
        """(B, T, K, 3) mean RGB of the slot's pixels, 0..1."""
        if self.layout.explicit:
            return (self._state.color * 0.5 + 0.5).clamp(0, 1)
        share = self._shares().flatten(3)
        return torch.einsum("btkp,btcp->btkc", share, self.frames.flatten(3))

    @property
    def presence(self) -> Tensor:
        """(B, T, K) 1 for a slot that holds something, 0 for an unused one.

        Read off the slots where they carry it; else the slot's largest share of any pixel.
        """
        if self.layout.explicit:
            return self._state.presence[..., 0].clamp(0, 1)
        return self.masks.flatten(3).amax(dim=-1)

    @property
    def _state(self) -> SlotState:
        return SlotState.split(self.slots, self.layout)

    @property
    def _pixels_per_side(self) -> Tensor:
        H, W = self.image_size
        return self.slots.new_tensor([W, H])

    def _shares(self) -> Tensor:
        """Masks as weights that sum to 1 over the pixels."""
        # A soft mask has a faint tail over the whole picture, which would draw its centre towards the middle.
        # So only pixels that the slot wins count, if it wins any.
        masks = self.masks
        won = torch.zeros_like(masks).scatter_(2, masks.argmax(dim=2, keepdim=True), 1.0) * masks
        any_won = won.flatten(3).sum(dim=-1)[..., None, None] > 0
        weights = torch.where(any_won, won, masks)
        return weights / weights.flatten(3).sum(dim=-1)[..., None, None].clamp_min(1e-8)

    # ---- parts of it, and files

    def select(self, index: int | slice | Sequence[int]) -> Rollout:
        """The rollout of some of the sequences; what has been decoded stays decoded.

        Raises:
            IndexError: if there is no such sequence.
        """
        keep = _numbers(len(self), index if isinstance(index, slice | Sequence) or np.ndim(index) else [index])
        decoded = self._decoded
        kept = ({t: drawn[keep] for t, drawn in kind.items()} for kind in (decoded.masks, decoded.frames))
        return replace(
            self,
            slots=self.slots[keep],
            texts=tuple(self.texts[i] for i in keep) if self.texts else (),
            attention=None if self.attention is None else self.attention[keep],
            seen=None if self.seen is None else tuple(self.seen[i] for i in keep),
            _decoded=_Decoded(*kept),
        )

    @property
    def first(self) -> Rollout:
        """The rollout of only the first frame, from which it was imagined."""
        return self._only(0)

    @property
    def last(self) -> Rollout:
        """The rollout of only the last frame: where a next instruction would start from."""
        return self._only(self.slots.shape[1] - 1)

    def _only(self, frame: int) -> Rollout:
        decoded = self._decoded
        kept = ({0: kind[frame]} if frame in kind else {} for kind in (decoded.masks, decoded.frames))
        return replace(self, slots=self.slots[:, frame : frame + 1], attention=None, _decoded=_Decoded(*kept))

    def moved(self, positions_BK2: Tensor, texts: Sequence[str]) -> Rollout:
        """Rollouts of two frames: the last one of this (B = 1), and its slots at other places (B, K, 2), in pixels.

        Raises:
            ValueError: if slots carry no place that could be changed.
        """
        slots_BKD = self.slots[:, -1].expand(len(positions_BK2), -1, -1)
        state = SlotState.split(slots_BKD, self.layout)
        ends_BKD = replace(state, position=2 * positions_BK2 / self._pixels_per_side - 1).join()
        return replace(
            self,
            slots=torch.stack([slots_BKD, ends_BKD], dim=1),
            texts=tuple(texts),
            attention=None,
            seen=None if self.seen is None else self.seen * len(positions_BK2),
            _decoded=_Decoded(),
        )

    def save(self, path: str | Path, *, beside: np.ndarray | None = None, fps: int = 6) -> Path:
        """Draw frames and masks, in one stable colour for each slot, into a file; returns its path.

        Args:
            path: `.gif` and `.mp4` play through time, `.png` is a strip from left to right.
            beside: real frames (T', H, W, 3) or (B, T', H, W, 3) uint8, shown before the imagined ones. If they end
                earlier than the rollout, the last one stays.
            fps: frames per second of `.gif` and `.mp4`.

        Raises:
            ValueError: if the suffix is another one, or `beside` has another shape.
        """
        frames, masks = self.frames.cpu().numpy(), self.masks.cpu().numpy()
        return save_film(Path(path), frames, masks, self.texts, beside=beside, fps=fps)


def _numbers(count: int, index: Any) -> list[int]:
    """The numbers 0..count-1 of a slice, or of numbers that may count from the end."""
    return list(range(count)[index]) if isinstance(index, slice) else [range(count)[int(i)] for i in index]


def _to_rgb(pictures: Tensor) -> Tensor:
    """From -1..1 to 0..1, clamped because a renderer may overshoot."""
    return (pictures.float() * 0.5 + 0.5).clamp(0, 1)
