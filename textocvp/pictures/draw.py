"""Pictures of rollouts: frames and masks, enlarged, with one stable colour for each slot."""

import colorsys
import io
import textwrap
from collections.abc import Sequence
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from textocvp.files import replacing

SUFFIXES = (".gif", ".mp4", ".png")
READABLE = 256  # pixels a side to which a picture in a film is enlarged; one in a strip to half of it
STRIP_MOMENTS = 12  # the most that a strip shows
FILM_COLUMNS = 6  # the most sequences side by side in a film
GAP = 4  # pixels between pictures
PAPER, INK = (250, 250, 250), (30, 30, 30)


def slot_palette(num_slots: int) -> np.ndarray:
    """(num_slots, 3) RGB 0..1: slot k has the same colour in every picture, whatever the number of slots."""
    # Steps of the golden ratio around the hue circle keep neighbours apart for any number of slots.
    hues = (0.02 + 0.618034 * np.arange(num_slots)) % 1.0
    values = np.where(np.arange(num_slots) % 2 == 0, 0.95, 0.7)
    palette = np.array([colorsys.hsv_to_rgb(h, 0.75, v) for h, v in zip(hues, values, strict=True)])
    palette[0] = 0.22  # slot 0 is the background in the shipped model: dark grey lets the objects stand out
    return palette


def color_masks(masks: np.ndarray) -> np.ndarray:
    """Masks (..., K, H, W) as pictures (..., H, W, 3) uint8: the slots' colours, mixed by the masks."""
    mixed = np.einsum("...khw,kc->...hwc", masks, slot_palette(masks.shape[-3]))
    return (mixed.clip(0, 1) * 255).round().astype(np.uint8)


def enlarge(picture: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, 3) to (H * factor, W * factor, 3) without smoothing: a pixel stays a square."""
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def save_film(
    path: Path,
    frames: np.ndarray,
    masks: np.ndarray,
    texts: Sequence[str],
    *,
    beside: np.ndarray | None = None,
    fps: int = 6,
) -> Path:
    """Write sequences as a film or a strip; see `Rollout.save`. Missing folders are made.

    Args:
        frames: (B, T, 3, H, W) RGB 0..1.
        masks: (B, T, K, H, W).
        texts: B captions, or none.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"cannot write {path.name!r}: the name must end in {', '.join(SUFFIXES)}")
    B, T, _, H, W = frames.shape
    imagined = (frames.transpose(0, 1, 3, 4, 2) * 255).round().astype(np.uint8)
    rows = [imagined, color_masks(masks)]
    if beside is not None:
        rows.insert(0, _real_frames(beside, B, T, H, W))
    stacked = np.stack(rows, axis=2)  # (B, T, rows, H, W, 3)
    captions = list(texts) if texts else [""] * B
    path.parent.mkdir(parents=True, exist_ok=True)

    with replacing(path) as new:
        if suffix == ".png":
            Image.fromarray(_strip(stacked, captions)).save(new)
            return path
        film = [_screen(stacked[:, t], captions) for t in range(T)]
        if suffix == ".gif":
            # Into memory: on a full disk the library would try again, and fail, while it is cleaned up.
            packed = io.BytesIO()
            imageio.mimsave(packed, film, format="GIF", duration=1000 / fps, loop=0)  # type: ignore[arg-type]
            new.write_bytes(packed.getvalue())
        else:
            # The video codec halves the colour planes, so both sides must be even.
            even = [np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), mode="edge") for f in film]
            imageio.mimsave(new, even, format="FFMPEG", fps=fps, macro_block_size=1)  # type: ignore[arg-type]
    return path


def _real_frames(beside: np.ndarray, B: int, T: int, H: int, W: int) -> np.ndarray:
    given = np.asarray(beside)
    real = np.broadcast_to(given, (B, *given.shape)) if given.ndim == 4 else given
    if real.ndim != 5 or real.shape[0] != B or real.shape[2:] != (H, W, 3) or real.dtype != np.uint8:
        allowed = f"(T', {H}, {W}, 3) or ({B}, T', {H}, {W}, 3)"
        raise ValueError(f"beside must be uint8 frames {allowed}, not {given.dtype} {given.shape}")
    return real[:, np.minimum(np.arange(T), real.shape[1] - 1)]


def _screen(pictures: np.ndarray, captions: Sequence[str]) -> np.ndarray:
    """One moment (B, rows, H, W, 3) of a film. A single sequence lies on its side; of several, each is a column."""
    if len(captions) == 1:
        factor = max(1, READABLE // pictures.shape[2])
        # Without a text nothing was imagined: the frames are true ones, redrawn from their slots.
        names = ("real", "imagined" if captions[0] else "redrawn", "slots")[-pictures.shape[1] :]
        panels = [captioned(_framed(enlarge(p, factor)), n) for p, n in zip(pictures[0], names, strict=True)]
        return captioned(_beside(panels), captions[0])
    columns = [_column(rows, caption) for rows, caption in zip(pictures, captions, strict=True)]
    lines = [columns[i : i + FILM_COLUMNS] for i in range(0, len(columns), FILM_COLUMNS)]
    return _stack([_beside(line) for line in lines])


def _strip(pictures: np.ndarray, captions: Sequence[str]) -> np.ndarray:
    """Moments (B, T, rows, H, W, 3) from left to right, sequences under each other."""
    T = pictures.shape[1]
    moments = np.unique(np.linspace(0, T - 1, min(T, STRIP_MOMENTS)).round().astype(int))
    bands = [
        captioned(_beside([_column(sequence[t], f"t = {t}") for t in moments]), caption)
        for sequence, caption in zip(pictures, captions, strict=True)
    ]
    return _stack(bands)


def _column(rows: np.ndarray, caption: str) -> np.ndarray:
    """Pictures (rows, H, W, 3) under each other, at half the size of a film of one sequence."""
    factor = max(1, READABLE // 2 // rows.shape[1])
    return captioned(np.concatenate([_framed(enlarge(p, factor)) for p in rows], axis=0), caption)


def _framed(picture: np.ndarray) -> np.ndarray:
    return np.pad(picture, ((0, GAP), (0, GAP), (0, 0)), constant_values=PAPER[0])


def _beside(pictures: Sequence[np.ndarray]) -> np.ndarray:
    height = max(p.shape[0] for p in pictures)
    return np.concatenate([_fill(p, height, p.shape[1]) for p in pictures], axis=1)


def _stack(pictures: Sequence[np.ndarray]) -> np.ndarray:
    width = max(p.shape[1] for p in pictures)
    return np.concatenate([_fill(p, p.shape[0], width) for p in pictures], axis=0)


def _fill(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    missing = ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0))
    return np.pad(picture, missing, constant_values=PAPER[0])


def captioned(picture: np.ndarray, text: str) -> np.ndarray:
    """The picture with its text, if it has one, on a band of paper below."""
    if not text:
        return picture
    font = ImageFont.load_default()
    left, top, right, bottom = font.getbbox("x" * 40)
    letters = max(1, int(picture.shape[1] / ((right - left) / 40)) - 1)
    lines = textwrap.wrap(text, letters)
    line_height = int(bottom - top) + 6
    band = Image.new("RGB", (picture.shape[1], line_height * len(lines) + 4), PAPER)
    pen = ImageDraw.Draw(band)
    for number, line in enumerate(lines):
        pen.text((2, 1 + number * line_height), line, fill=INK, font=font)
    return np.concatenate([picture, np.asarray(band)], axis=0)
