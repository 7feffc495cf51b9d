"""Animations: frames and masks side by side, as GIF bytes."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

# Eleven hues in a fixed order, so that thing i has one colour in every panel and every frame.
PALETTE = np.array(
    [
        (230, 97, 86), (70, 137, 196), (96, 172, 88), (238, 190, 74), (158, 111, 184), (84, 186, 180),
        (240, 144, 62), (222, 130, 168), (150, 116, 92), (120, 144, 60), (94, 96, 178),
    ],
    dtype=np.uint8,
)  # fmt: skip
BACKGROUND = np.array((236, 239, 241), dtype=np.uint8)
ARM = np.array((84, 98, 110), dtype=np.uint8)
UNMATCHED = np.array((172, 184, 193), dtype=np.uint8)


def paint(labels_THW: np.ndarray, colors_N3: np.ndarray) -> np.ndarray:
    """Label maps (T,H,W) of ints 0..N-1 in their colours (N,3) uint8 -> (T,H,W,3) uint8."""
    return np.asarray(colors_N3, dtype=np.uint8)[labels_THW]


def segmentation_colors(objects: int) -> np.ndarray:
    """Colours of a simulator segmentation: 0 background, 1 arm, 2 + i object i -> (2 + objects, 3) uint8."""
    things = PALETTE[np.arange(objects) % len(PALETTE)]
    return np.concatenate([BACKGROUND[None], ARM[None], things])


def slot_colors(slot_labels_HW: np.ndarray, segmentation_HW: np.ndarray, slots: int, objects: int) -> np.ndarray:
    """Colours (slots, 3) that make each slot look like the thing it covers most of in the first frame.

    Only for pictures: a slot that covers nothing of the simulator's segmentation well stays grey.
    """
    colors = np.repeat(UNMATCHED[None], slots, axis=0)
    things = segmentation_colors(objects)
    for slot in range(slots):
        inside = slot_labels_HW == slot
        if inside.any():
            counts = np.bincount(segmentation_HW[inside].ravel(), minlength=len(things))
            best = int(counts.argmax())
            if counts[best] >= 0.5 * inside.sum():
                colors[slot] = things[best]
    return colors


def gif(
    grid: Sequence[Sequence[np.ndarray]], *, seconds_a_frame: float = 0.14, scale: int = 2, hold: int = 6, gap: int = 2
) -> bytes:
    """A grid of panels, rows of (T,H,W,3) uint8, as a GIF that loops.

    A panel that is shorter holds its last frame; the last frame of all is held `hold` times longer.

    Raises:
        ValueError: if there is no panel, the rows differ in length, or the panels differ in size.
    """
    panels = [panel for row in grid for panel in row]
    if not panels or len({len(row) for row in grid}) > 1:
        raise ValueError("a clip needs rows of equally many panels, at least one")
    if len(sizes := {panel.shape[1:3] for panel in panels}) > 1:
        raise ValueError(f"panels differ in size: {sorted(sizes)}")
    length = max(len(panel) for panel in panels)
    held = [[panel[np.minimum(np.arange(length), len(panel) - 1)] for panel in row] for row in grid]
    wide_THW3 = _join([_join(row, 2, gap) for row in held], 1, gap)
    # One palette for all frames, made from all of them: otherwise flat colours flicker.
    palette = Image.fromarray(np.concatenate(wide_THW3)).quantize(colors=255, method=Image.Quantize.MEDIANCUT)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in wide_THW3.repeat(scale, axis=1).repeat(scale, axis=2)
    ]
    shown, buffer = int(seconds_a_frame * 1000), io.BytesIO()
    durations = [shown] * (length - 1) + [shown * hold]
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=False)
    return buffer.getvalue()


def _join(panels: Sequence[np.ndarray], axis: int, gap: int) -> np.ndarray:
    """Panels side by side (axis 2) or one above the other (axis 1), with a grey line between."""
    shape = list(panels[0].shape)
    shape[axis] = gap
    line = np.full(shape, 128, dtype=np.uint8)
    parts = [part for panel in panels for part in (line, panel)][1:]
    return np.concatenate(parts, axis=axis)
