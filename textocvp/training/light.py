"""Other light on the same scene: what a parser that has learned to see must not be disturbed by."""

import io

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from textocvp.pictures.put_right import in_light


def relight(
    clip_THW3: NDArray[np.uint8], labels_THW: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A clip under other light, of other colours, seen by a worse camera, perhaps mirrored; labels go along.

    Brightness .65 to 1.35, a gradient of at most 35 %, gains and order of the colour channels, grain as of wood on
    the background (label 0) or on everything, blur, noise of at most sigma 13 of 255, and JPEG.
    """
    H, W = labels_THW.shape[1:]
    x = clip_THW3.astype(np.float32)
    if rng.random() < 0.5:
        x = x[..., rng.permutation(3)]
    light_HW3 = rng.uniform(0.65, 1.35) * np.ones((H, W, 1)) * rng.uniform(0.88, 1.12, 3)
    angle, strength = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.35) * (rng.random() < 0.6)
    across_H, across_W = np.sin(angle) * np.linspace(-1, 1, H), np.cos(angle) * np.linspace(-1, 1, W)
    light_HW3 *= 1 + strength * (across_H[:, None] + across_W)[..., None]
    x = x * light_HW3.astype(np.float32)
    if rng.random() < 0.35:
        grain_HW1 = _grain(H, W, rng)[..., None] * rng.uniform(0.02, 0.15)
        where = (labels_THW == 0)[..., None] if rng.random() < 0.6 else True
        x = x * (1 + np.where(where, grain_HW1, 0)).astype(np.float32)
    if rng.random() < 0.25:
        x = ndimage.uniform_filter(x, (0, 3, 3, 0))
    if rng.random() < 0.6:
        x = x + rng.uniform(0, 13) * rng.standard_normal(x.shape, np.float32)
    lit = x.round().clip(0, 255).astype(np.uint8)
    if rng.random() < 0.2:
        lit = np.stack([jpeg(picture, int(rng.integers(50, 95))) for picture in lit])
    if rng.random() < 0.5:
        lit, labels_THW = lit[:, :, ::-1], labels_THW[:, :, ::-1]
    return np.ascontiguousarray(lit), np.ascontiguousarray(labels_THW)


def spoil(picture_HW3: NDArray[np.uint8], rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A picture as a camera may lose it and `put_right` hands it to a restorer, and the picture that is to come back.

    Half of them were taken in .6 to 1.45 times the light, which was undone, three in ten have noise of sigma 3 to 12,
    two in three were JPEGs of quality 50 to 95. Three in ten have other hues, for things of colours never seen.
    """
    clean_HW3 = picture_HW3.astype(np.float32)
    if rng.random() < 0.3:
        share, order = np.float32(rng.random()), rng.permutation(3)
        clean_HW3 = (clean_HW3 * (1 - share) + clean_HW3[..., order] * share).round()
    light = rng.uniform(0.6, 1.45) if rng.random() < 0.5 else 1.0
    x = clean_HW3 * light
    if rng.random() < 0.3:
        x = x + rng.uniform(3, 12) * rng.standard_normal(x.shape)
    seen_HW3 = x.round().clip(0, 255).astype(np.uint8)
    if rng.random() < 0.65:
        seen_HW3 = jpeg(seen_HW3, int(rng.integers(50, 95)))
    return in_light(torch.from_numpy(seen_HW3).float(), 1 / light).numpy(), clean_HW3


def _grain(height: int, width: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Streaks along one axis, of mean 0 and deviation about 1."""
    few, many = int(rng.integers(2, 8)), int(rng.integers(20, 84))
    sizes = (few, many) if rng.random() < 0.5 else (many, few)
    coarse = rng.standard_normal(sizes)
    return ndimage.zoom(coarse, (height / sizes[0], width / sizes[1]), order=1, grid_mode=True, mode="nearest")


def jpeg(picture_HW3: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """A picture as JPEG brings it back, with halved colour planes as usual; `quality` is 1 to 95."""
    file = io.BytesIO()
    Image.fromarray(picture_HW3).save(file, "jpeg", quality=quality)
    return np.array(Image.open(file))
