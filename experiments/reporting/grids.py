"""Figures of many small panels: frames of a rollout in rows and columns, and heat maps side by side."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure as Canvas

from experiments.reporting.document import Figure
from experiments.reporting.plots import DARK, LIGHT, Theme

WIDTH = 7.6  # inches
LETTER = 0.075  # inches that a letter of a row's name takes at most, on average
GAP = 1  # pixels of the pictures, between them


def picture_grid(
    name: str,
    pictures: Sequence[Sequence[np.ndarray]],
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    alt: str,
    caption: str = "",
) -> Figure:
    """Pictures in rows and columns with their names.

    Args:
        name: file name, with `.png`.
        pictures: rows of (H, W, 3) or, with transparency, (H, W, 4) uint8, all of one size. What is transparent takes
            the colour of the page.
        rows, columns: names.

    Raises:
        ValueError: if the pictures do not fit the names.
    """
    if len(pictures) != len(rows) or any(len(row) != len(columns) for row in pictures):
        raise ValueError(
            f"{len(rows)} x {len(columns)} names, but rows of {[len(row) for row in pictures]} pictures"
        )
    height, width = pictures[0][0].shape[:2]
    down, across = height + GAP, width + GAP
    left, top = 0.12 + LETTER * max(map(len, rows)), 0.3
    wide = WIDTH - left - 0.04
    high = wide * (len(rows) * down + GAP) / (len(columns) * across + GAP)
    size = (WIDTH, high + top + 0.04)

    def draw(canvas: Canvas, theme: Theme) -> None:
        # One image, not one panel a picture: laying out a hundred panels takes seconds.
        page, line = (np.array(to_rgb(color)) * 255 for color in (theme.page, theme.faint))
        sheet = np.tile(line, (len(rows) * down + GAP, len(columns) * across + GAP, 1))
        for r, row in enumerate(pictures):
            for c, picture in enumerate(row):
                alpha = picture[..., 3:] / 255 if picture.shape[-1] == 4 else 1.0
                y, x = GAP + r * down, GAP + c * across
                sheet[y : y + height, x : x + width] = picture[..., :3] * alpha + page * (1 - alpha)
        axes = canvas.add_axes((left / size[0], 0.04 / size[1], wide / size[0], high / size[1]))
        axes.imshow(sheet.round().astype(np.uint8), interpolation="nearest", aspect="auto")
        axes.set_xticks(GAP + across * np.arange(len(columns)) + width / 2, columns, fontsize=9)
        axes.set_yticks(GAP + down * np.arange(len(rows)) + height / 2, rows, fontsize=9)
        axes.xaxis.tick_top()
        axes.tick_params(colors=theme.ink, length=0, pad=4)
        for spine in axes.spines.values():
            spine.set_visible(False)

    return _figure(name, draw, size, alt, caption)


def heat_grid(
    name: str,
    values: np.ndarray,
    rows: Sequence[str],
    columns: Sequence[str],
    titles: Sequence[Sequence[str]],
    *,
    label: str,
    caption: str = "",
) -> Figure:
    """Heat maps of one scale in rows and columns.

    Args:
        name: file name, with `.png`.
        values: (panel rows, panel columns, rows, columns) from 0 up; nan stays blank.
        rows, columns: names of the cells, drawn at the left and at the bottom.
        titles: one a panel.

    Raises:
        ValueError: if the values do not fit the names.
    """
    values = np.asarray(values, dtype=float)
    wanted = (len(titles), len(titles[0]), len(rows), len(columns))
    if values.shape != wanted:
        raise ValueError(f"values are {values.shape}, the names ask for {wanted}")
    top = float(np.nanmax(values)) or 1.0

    def draw(canvas: Canvas, theme: Theme) -> None:
        canvas.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02, hspace=0.01, wspace=0.01)
        axes = canvas.subplots(len(titles), len(titles[0]), squeeze=False)
        ramp = LinearSegmentedColormap.from_list("calm", [theme.page, theme.series[0]]).with_extremes(
            bad=theme.page
        )
        for (r, c), one in np.ndenumerate(axes):
            one.imshow(values[r, c], cmap=ramp, vmin=0, vmax=top, aspect="auto")
            one.set_facecolor(theme.page)
            one.set_title(titles[r][c], fontsize=9, color=theme.ink, pad=4)
            one.set_yticks(range(len(rows)), rows if c == 0 else [""] * len(rows), fontsize=8)
            last = r == len(axes) - 1
            one.set_xticks(
                range(len(columns)), columns if last else [""] * len(columns), rotation=90, fontsize=8
            )
            one.tick_params(colors=theme.ink, length=0, pad=3)
            for spine in one.spines.values():
                spine.set(visible=True, color=theme.faint, linewidth=0.6)

    size = (WIDTH, 0.9 + len(titles) * (0.3 + 0.19 * len(rows)))
    alt = f"{label}: heat maps of {', '.join(rows)} against {', '.join(columns)}"
    return _figure(name, draw, size, alt, caption)


def _figure(
    name: str, draw: Callable[[Canvas, Theme], None], size: tuple[float, float], alt: str, caption: str
) -> Figure:
    def png(theme: Theme) -> bytes:
        canvas = Canvas(figsize=size, dpi=130, facecolor=theme.page)
        FigureCanvasAgg(canvas)
        draw(canvas, theme)
        buffer = io.BytesIO()
        canvas.savefig(buffer, format="png", metadata={"Software": None})
        return buffer.getvalue()

    return Figure(name=name, light=png(LIGHT), dark=png(DARK), alt=alt, caption=caption, wide=True)
