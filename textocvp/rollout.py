"""What the world model imagined, or parsed: slots, and whatever can be read off them, decoded only when
asked for.

Decoding costs several times more than predicting. A planner that scores thirty instructions needs masks at a
few frames and colours at none, so nothing is drawn before somebody looks at it, and nothing is drawn twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from textocvp.drawing import save_film
from textocvp.layers import pixel_grid
from textocvp.renderers.base import Renderer
from textocvp.slots import SlotLayout, SlotState

#: How many pictures the renderer draws at once: large enough to keep two cores busy, small enough for the
#: cache.
CHUNK = 64


@dataclass
class _Decoded:
    """What has been drawn so far, by frame number: masks (B, K, H, W) and frames (B, 3, H, W) in 0..1."""

    masks: dict[int, Tensor] = field(default_factory=dict)
    frames: dict[int, Tensor] = field(default_factory=dict)


@dataclass(frozen=True, repr=False, eq=False)
class Rollout:
    """A batch of B sequences of T frames with K slots each. Frame 0 is what was observed; the others are
    imagined.

    All tensors are float32 without gradient, on the model's device. Slots keep their number through time:
    slot 3 of frame 20 is the thing that was slot 3 in frame 0.

    Attributes:
        slots: (B, T, K, D).
        texts: the B instructions; empty if the rollout comes from `WorldModel.parse`.
        image_size: (H, W) in pixels.
        layout: what the D numbers of a slot mean.
        renderer: draws the slots.
        attention: (B, T - 1, layers, heads, K, words) weights from slots to words, if they were asked for.
    """

    slots: Tensor
    texts: tuple[str, ...]
    image_size: tuple[int, int]
    layout: SlotLayout
    renderer: Renderer
    attention: Tensor | None = None
    _decoded: _Decoded = field(default_factory=_Decoded)

    def __repr__(self) -> str:
        B, T, K, D = self.slots.shape
        said = ", ".join(repr(text) for text in self.texts[:2]) + (", ..." if len(self.texts) > 2 else "")
        what = f"imagined from {said}" if self.texts else "parsed from frames"
        H, W = self.image_size
        drawn = (
            f"masks decoded at {len(self._decoded.masks)}, frames at {len(self._decoded.frames)} of {T} times"
        )
        return f"Rollout(B={B} sequences, T={T} frames, K={K} slots of {D}, {H}x{W} pixels, {what}; {drawn})"

    def __len__(self) -> int:
        """B, the number of sequences."""
        return self.slots.shape[0]

    # ---------------------------------------------------------------- what the slots look like

    def decode_masks(self, frames: slice | Sequence[int]) -> Tensor:
        """Masks (B, t, K, H, W) of only these frames; they sum to 1 over the slots.

        Raises:
            IndexError: if there is no such frame.
        """
        return self._decode(frames, self._decoded.masks, self._draw_masks)

    def decode_frames(self, frames: slice | Sequence[int]) -> Tensor:
        """Pictures (B, t, 3, H, W) of only these frames, RGB 0..1.

        Raises:
            IndexError: if there is no such frame.
        """
        return self._decode(frames, self._decoded.frames, self._draw_frames)

    def decode_objects(self, frames: slice | Sequence[int]) -> Tensor:
        """Every slot drawn alone (B, t, K, 3, H, W), RGB 0..1, at only these times.

        A picture fills the whole frame, also where its slot has no share of the pixels: multiply by the masks to see
        an object cut out. The sum over the slots of picture times mask is the frame (but for a renderer that
        overshoots 0..1). These are K times as large as frames and so are not kept.

        Raises:
            IndexError: if there is no such frame.
        """
        times = self._times(frames)
        B, _, K, D = self.slots.shape
        with torch.no_grad():
            drawn = [
                (self.renderer(chunk).object_frames_BK3HW.float() * 0.5 + 0.5).clamp(0, 1)
                for chunk in self.slots[:, times].reshape(-1, K, D).split(max(1, CHUNK // K))
            ]
        return torch.cat(drawn).unflatten(0, (B, len(times)))

    @property
    def masks(self) -> Tensor:
        """(B, T, K, H, W) each slot's share of each pixel; sums to 1 over the slots."""
        return self.decode_masks(slice(None))

    @property
    def frames(self) -> Tensor:
        """(B, T, 3, H, W) RGB 0..1."""
        return self.decode_frames(slice(None))

    def _decode(
        self, frames: slice | Sequence[int], drawn: dict[int, Tensor], draw: Callable[[list[int]], None]
    ) -> Tensor:
        wanted = self._times(frames)
        missing = [t for t in dict.fromkeys(wanted) if t not in drawn]
        if missing:
            draw(missing)
        return torch.stack([drawn[t] for t in wanted], dim=1)

    def _times(self, frames: slice | Sequence[int]) -> list[int]:
        """Frame numbers 0..T-1 of a slice or of numbers that may count from the end."""
        T = self.slots.shape[1]
        wanted = list(range(T)[frames]) if isinstance(frames, slice) else [range(T)[int(t)] for t in frames]
        if not wanted:
            raise IndexError(f"no frame asked for; this rollout has frames 0..{T - 1}")
        return wanted

    def _draw_masks(self, times: list[int]) -> None:
        B, _, K, D = self.slots.shape
        slots_NKD = self.slots[:, times].reshape(-1, K, D)
        with torch.no_grad():
            masks_NKHW = torch.cat([self.renderer.masks(chunk).float() for chunk in slots_NKD.split(CHUNK)])
        masks_BtKHW = masks_NKHW.view(B, len(times), *masks_NKHW.shape[1:])
        self._decoded.masks.update({t: masks_BtKHW[:, i] for i, t in enumerate(times)})

    def _draw_frames(self, times: list[int]) -> None:
        B, _, K, D = self.slots.shape
        slots_NKD = self.slots[:, times].reshape(-1, K, D)
        with torch.no_grad():
            drawn = [self.renderer(chunk) for chunk in slots_NKD.split(CHUNK)]
        # Clamped because a renderer is free to overshoot by a little; 0..1 is this class's promise.
        frames_N3HW = torch.cat([(d.frames_B3HW.float() * 0.5 + 0.5).clamp(0, 1) for d in drawn])
        frames_Bt3HW = frames_N3HW.view(B, len(times), *frames_N3HW.shape[1:])
        masks_NKHW = torch.cat([d.masks_BKHW.float() for d in drawn])
        masks_BtKHW = masks_NKHW.view(B, len(times), *masks_NKHW.shape[1:])
        for i, t in enumerate(times):
            self._decoded.frames[t] = frames_Bt3HW[:, i]
            self._decoded.masks.setdefault(t, masks_BtKHW[:, i])

    # ---------------------------------------------------------------- where and what the slots are

    @property
    def positions(self) -> Tensor:
        """(B, T, K, 2) centres (x right, y down) in pixels; the centre of the top-left pixel is (0.5, 0.5).

        Read off the slots where they carry a position; else the centre of mass of the decoded masks.
        """
        if self.layout.explicit:
            return (self._state.position + 1) / 2 * self._pixels_per_side
        return self._moments()[0]

    @property
    def extents(self) -> Tensor:
        """(B, T, K, 2) standard deviation of the slot's pixels along x and y, in pixels."""
        if self.layout.explicit:
            return self._state.scale / 2 * self._pixels_per_side
        return self._moments()[1]

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
        """Masks as weights that sum to 1 over the pixels. Only pixels that the slot wins count, if it wins
        any: a soft mask has a faint tail over the whole picture, which would draw every centre towards the
        middle."""
        masks = self.masks
        won = torch.zeros_like(masks).scatter_(2, masks.argmax(dim=2, keepdim=True), 1.0) * masks
        some = won.flatten(3).sum(dim=-1)[..., None, None] > 0
        weights = torch.where(some, won, masks)
        return weights / weights.flatten(3).sum(dim=-1)[..., None, None].clamp_min(1e-8)

    def _moments(self) -> tuple[Tensor, Tensor]:
        H, W = self.image_size
        grid_HW2 = (pixel_grid(H, W, device=self.slots.device) + 1) / 2 * self._pixels_per_side
        shares = self._shares()
        mean = torch.einsum("btkhw,hwc->btkc", shares, grid_HW2)
        square = torch.einsum("btkhw,hwc->btkc", shares, grid_HW2**2)
        return mean, (square - mean**2).clamp_min(0).sqrt()

    # ---------------------------------------------------------------- parts of it, and files

    def select(self, index: int | slice | Sequence[int]) -> Rollout:
        """The rollout of some of the sequences; what has been decoded stays decoded.

        Raises:
            IndexError: if there is no such sequence.
        """
        B = len(self)
        if isinstance(index, slice):
            keep = list(range(B)[index])
        elif isinstance(index, Sequence) or np.ndim(index):
            keep = [range(B)[int(i)] for i in index]  # type: ignore[union-attr]
        else:
            keep = [range(B)[int(index)]]
        return replace(
            self,
            slots=self.slots[keep],
            texts=tuple(self.texts[i] for i in keep) if self.texts else (),
            attention=None if self.attention is None else self.attention[keep],
            _decoded=_Decoded(
                {t: masks[keep] for t, masks in self._decoded.masks.items()},
                {t: frames[keep] for t, frames in self._decoded.frames.items()},
            ),
        )

    @property
    def last(self) -> Rollout:
        """The rollout of only the last frame: where a next instruction would start from."""
        end = self.slots.shape[1] - 1
        return replace(
            self,
            slots=self.slots[:, -1:],
            attention=None,
            _decoded=_Decoded(
                {0: self._decoded.masks[end]} if end in self._decoded.masks else {},
                {0: self._decoded.frames[end]} if end in self._decoded.frames else {},
            ),
        )

    def save(self, path: str | Path, *, beside: np.ndarray | None = None, fps: int = 6) -> Path:
        """Draw the rollout into a file: each imagined frame above its masks, one stable colour a slot; in the film
        of a single sequence, beside its masks.

        Args:
            path: the suffix decides: `.gif` and `.mp4` play through time, `.png` is a strip from left to
                right.
            beside: real frames (T', H, W, 3) uint8 or (B, T', H, W, 3) to show above the imagined ones; if
                they end earlier than the rollout, the last one stays.
            fps: frames a second, for `.gif` and `.mp4`.

        Returns:
            the path it wrote.

        Raises:
            ValueError: if the suffix is another one, or `beside` has another shape.
        """
        return save_film(
            Path(path),
            self.frames.cpu().numpy(),
            self.masks.cpu().numpy(),
            self.texts,
            beside=beside,
            fps=fps,
        )
