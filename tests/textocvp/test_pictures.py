"""Picture files of all kinds become the same picture, and what was done to them is said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from textocvp.pictures import read_picture

SIZE = (32, 32)
ORIENTATION = 0x0112


def saved(path: Path, picture: Image.Image, **options: object) -> Path:
    picture.save(path, **options)
    return path


def turned(scene: np.ndarray, path: Path) -> Path:
    """As a phone does: the sensor's picture, and a tag that says it is to be turned by 90 degrees."""
    exif = Image.Exif()
    exif[ORIENTATION] = 6  # to be turned clockwise
    return saved(path, Image.fromarray(np.rot90(scene).copy()), exif=exif)


def transparent(scene: np.ndarray, path: Path) -> Path:
    alpha = np.full((*scene.shape[:2], 1), 255, np.uint8)
    alpha[:2] = 0
    return saved(path, Image.fromarray(np.concatenate([scene, alpha], -1)))


def sixteen(scene: np.ndarray, path: Path) -> Path:
    return saved(path, Image.fromarray(scene[..., 0].astype(np.uint16) * 257))


def film(scene: np.ndarray, path: Path) -> Path:
    first = Image.fromarray(scene)
    return saved(path, first, save_all=True, append_images=[first.rotate(90)], lossless=True)


def gray_of(scene: np.ndarray) -> np.ndarray:
    return np.repeat(scene[..., :1], 3, axis=-1)


def with_white_rows(scene: np.ndarray) -> np.ndarray:
    white = scene.copy()
    white[:2] = 255
    return white


CASES: list[tuple[str, Callable[[np.ndarray, Path], Path], Callable[[np.ndarray], np.ndarray], list[str]]] = [
    ("plain.png", lambda s, p: saved(p, Image.fromarray(s)), lambda s: s, []),
    ("turned.png", turned, lambda s: s, ["turned it"]),
    ("transparent.png", transparent, with_white_rows, ["put white behind"]),
    ("opaque.png", lambda s, p: saved(p, Image.fromarray(s).convert("RGBA")), lambda s: s, []),
    ("sixteen.png", sixteen, gray_of, ["8 bits a channel", "took its gray"]),
    ("unit.tiff", lambda s, p: saved(p, Image.fromarray(s[..., 0] / np.float32(255))), gray_of, ["8 bits", "gray"]),
    ("gray.png", lambda s, p: saved(p, Image.fromarray(s[..., 0])), gray_of, ["took its gray"]),
    ("film.webp", film, lambda s: s, ["the first of its 2 frames"]),
]


@pytest.mark.parametrize(("name", "write", "expected", "done"), CASES, ids=[case[0] for case in CASES])
def test_what_can_be_put_right_is_put_right_and_said(scene, tmp_path, name, write, expected, done) -> None:
    picture, said = read_picture(write(scene, tmp_path / name), SIZE)
    assert picture.dtype == np.uint8 and np.array_equal(picture, expected(scene))
    assert len(said) == len(done) and all(part in one for part, one in zip(done, said, strict=True))


def test_another_shape_gets_a_border_or_loses_its_edges(scene: np.ndarray, tmp_path: Path) -> None:
    wide = np.full((64, 128, 3), 47, np.uint8)
    wide[:, 32:96] = scene.repeat(2, axis=0).repeat(2, axis=1)
    path = saved(tmp_path / "wide.png", Image.fromarray(wide))
    with pytest.raises(ValueError, match=r"128x64 pixels and the model was trained on 32x32: .*--resize .*--crop"):
        read_picture(path, SIZE)
    cropped, said = read_picture(path, SIZE, crop=True)
    assert np.array_equal(cropped, scene) and said == ["cut off its edges and brought it from 128x64 to 32x32 pixels"]
    padded, said = read_picture(path, SIZE, resize=True)
    assert said == ["added a border and brought it from 128x64 to 32x32 pixels"]
    # The shape of things stays: half as large, in the middle, and the border has the colour of the edge.
    assert np.array_equal(padded[8:24], wide.reshape(16, 4, 32, 4, 3).mean((1, 3)).round().astype(np.uint8))
    assert (padded[:8] == 47).all() and (padded[24:] == 47).all()


def test_whole_multiples_are_the_models_business(scene: np.ndarray, tmp_path: Path) -> None:
    large = scene.repeat(3, axis=0).repeat(3, axis=1)
    path = saved(tmp_path / "large.png", Image.fromarray(large))
    assert np.array_equal(read_picture(path, SIZE)[0], large)
    assert np.array_equal(read_picture(path, SIZE, resize=True)[0], scene)
