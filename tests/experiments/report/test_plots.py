"""Figures of many panels: what is drawn where."""

import io

import numpy as np
import pytest
from PIL import Image

from experiments.report.page import Report, Section
from experiments.report.plots import heat_grid, picture_grid
from tests.experiments import examples

RED, BLUE = ((200, 0, 0), (0, 0, 200))


def flat(color: tuple[int, ...]) -> np.ndarray:
    return np.full((8, 8, len(color)), color, np.uint8)


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def center(picture: np.ndarray, color: tuple[int, ...]) -> tuple[float, float]:
    """Mean place (x, y) of a colour, as a share of the picture's width and height."""
    y, x = np.nonzero((np.abs(picture - color) < 3).all(-1))
    return float(x.mean() / picture.shape[1]), float(y.mean() / picture.shape[0])


def test_pictures_stand_in_their_row_and_column() -> None:
    grid = picture_grid(
        "g.png", [[flat(RED), flat((0, 0, 0, 0))], [flat((0, 0, 0, 0)), flat(BLUE)]], ["a", "b"], ["1", "2"], alt="x"
    )
    light, dark = pixels(grid.light), pixels(grid.dark)
    assert light.shape == dark.shape and light.shape[1] > 900
    (red_x, red_y), (blue_x, blue_y) = center(light, RED), center(light, BLUE)
    assert red_x < blue_x and red_y < blue_y
    # What is transparent shows the page, so black is nowhere in a light picture but for the letters.
    assert (light.sum(-1) < 60).mean() < 0.02
    assert grid.wide


def test_long_names_are_not_cut_off() -> None:
    grid = picture_grid("g.png", [[flat(RED)] * 6], ["yellow bowl (named)"], list("123456"), alt="x")
    assert (pixels(grid.light)[:, :8] == 255).all()


def test_names_and_panels_must_fit() -> None:
    with pytest.raises(ValueError, match="1 x 2 names"):
        picture_grid("g.png", [[flat(RED)]], ["a"], ["1", "2"], alt="x")
    with pytest.raises(ValueError, match=r"values are \(1, 1, 2, 2\), the names ask for \(1, 1, 2, 3\)"):
        heat_grid("h.png", np.ones((1, 1, 2, 2)), ["a", "b"], ["x", "y", "z"], [["t"]], label="l")


def test_a_larger_value_is_darker_and_all_panels_share_a_scale() -> None:
    values = np.zeros((1, 2, 1, 1))
    values[0, 0], values[0, 1] = 1.0, 0.5
    picture = pixels(heat_grid("h.png", values, ["a"], ["x"], [["strong", "weak"]], label="l").light)
    left, right = picture[:, : picture.shape[1] // 2], picture[:, picture.shape[1] // 2 :]
    strong = np.array([0x1F, 0x6F, 0x8B])
    assert (np.abs(left - strong) < 3).all(-1).mean() > 0.2
    assert (np.abs(right - strong) < 3).all(-1).mean() < 0.01
    assert (np.abs(right - (strong + 255) / 2) < 4).all(-1).mean() > 0.2


def test_what_is_not_known_is_blank() -> None:
    values = np.array([[[[np.nan, 1.0]]]])
    picture = pixels(heat_grid("h.png", values, ["a"], ["x", "y"], [["t"]], label="l").light)
    assert 0.2 < (np.abs(picture - [0x1F, 0x6F, 0x8B]) < 3).all(-1).mean() < 0.5


def test_a_wide_figure_gets_the_width_of_the_page() -> None:
    grid = picture_grid("g.png", [[flat(RED)]], ["a"], ["1"], alt="x")
    base = examples.report()
    page = Report("t", "q", base.results, [], [Section("s", blocks=[grid])], "c").to_html()
    assert '<figure class="wide">' in page
    assert '<figure class="wide">' not in base.to_html()
