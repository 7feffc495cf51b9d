"""Plots, each drawn for light and for dark pages: figures with intervals, curves, heat maps, grids of pictures."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure as Canvas

from experiments.report.page import Figure
from experiments.report.rows import Row
from experiments.report.tables import Line, TableSpec

WIDTH = 7.6  # inches of a wide plot
LETTER = 0.075  # inches that a letter of a row's name takes at most, on average
GAP = 1  # pixels between the pictures of a grid


@dataclass(frozen=True)
class Theme:
    """Colours of a plot: page, text, faint lines, and one colour a series."""

    page: str
    ink: str
    faint: str
    series: tuple[str, ...]


# The series colours keep at least 3:1 against their page and differ in lightness, not only in hue.
LIGHT = Theme(
    "#ffffff", "#24303b", "#dfe4e8",
    ("#1f6f8b", "#d07a2d", "#7a8894", "#8a5a9e", "#4f8a4c", "#b4472f", "#a08400", "#2f4a9e"),
)  # fmt: skip
DARK = Theme(
    "#161b20", "#d7dee4", "#303942",
    ("#62b6d4", "#eda464", "#94a1ac", "#c39ad6", "#8cc788", "#ec8f78", "#dcc04a", "#8fa6f0"),
)  # fmt: skip


@dataclass(frozen=True)
class Series:
    """One series of figures with intervals, one entry a group; None where it was not measured."""

    label: str  # its name in the legend
    # (value, low, high) a group. For a figure without an interval low = value = high.
    points: Sequence[tuple[float, float, float] | None]
    hollow: bool = False  # drawn as a ring: figures quoted from elsewhere
    color: int | None = None  # index into the theme's colours; its place among the series if None


def interval_plot(
    name: str,
    groups: Sequence[str],
    series: Sequence[Series],
    *,
    label: str,
    caption: str = "",
    limits: tuple[float, float] | None = (0.0, 1.0),
) -> Figure:
    """Dots with 95 % intervals, groups from top to bottom.

    Args:
        name: file name, with `.png`.
        groups: one name a group.
        series: their figures.
        label: of the axis.
        caption: below the plot.
        limits: ends of the axis, or None for automatic ones.
    """

    def draw(axes: Axes, theme: Theme) -> None:
        span = 0.56
        for i, one in enumerate(series):
            offset = 0.0 if len(series) == 1 else (i / (len(series) - 1) - 0.5) * span
            color = theme.series[(i if one.color is None else one.color) % len(theme.series)]
            named = False
            for g, point in enumerate(one.points):
                if point is None:
                    continue
                value, low, high = point
                at = [g + offset] * 2
                axes.plot([low, high], at, color=color, linewidth=2, alpha=0.55, solid_capstyle="round")
                axes.plot(
                    value, g + offset, "o", markersize=6, color=color, markeredgewidth=1.6,
                    markerfacecolor=theme.page if one.hollow else color, label=None if named else one.label,
                    clip_on=False, zorder=3,
                )  # fmt: skip
                named = True
        for g in range(1, len(groups)):
            axes.axhline(g - 0.5, color=theme.faint, linewidth=0.8)
        axes.set_yticks(range(len(groups)), groups)
        axes.set_ylim(len(groups) - 0.5, -0.5)
        if limits is not None:
            axes.set_xlim(*limits)
        axes.set_xlabel(label)
        axes.grid(axis="x", color=theme.faint, linewidth=0.8)
        axes.legend(
            loc="lower center", bbox_to_anchor=(0.5, 1.01), ncols=len(series) if len(series) < 5 else 3,
            frameon=False, labelcolor=theme.ink, fontsize=9, handletextpad=0.2, columnspacing=1.4,
        )  # fmt: skip

    alt = "; ".join(
        f"{one.label}: " + ", ".join(f"{g} {p[0]:.2f}" for g, p in zip(groups, one.points, strict=True) if p)
        for one in series
    )
    height = 1.2 + len(groups) * max(0.34, 0.115 * len(series))
    return _figure(name, draw, (5.8, height), f"{label}. {alt}", caption)


def plot_table(
    name: str,
    spec: TableSpec,
    rows: Iterable[Row],
    *,
    label: str,
    caption: str = "Dots with 95 % intervals over scenes.",
    limits: tuple[float, float] | None = (0.0, 1.0),
    lines: Sequence[Line] = (),
) -> Figure:
    """The figures of a table as an `interval_plot`: a group for each column, a series for each line that was measured.

    Args:
        name: file name, with `.png`.
        spec: the table.
        rows: all rows of the study.
        label: of the axis.
        caption: below the plot.
        limits: of the axis, or None for automatic ones.
        lines: only these; by default all of the table.
    """
    rows, series = list(rows), []
    for line in lines or spec.lines:
        for title, points, hollow in (
            (line.name, spec.points(rows, line), False),
            (line.paper.label if line.paper else "", spec.paper_points(line), True),
        ):
            if any(points):
                series.append(Series(title, points, hollow, line.hue))
    if any(one.hollow for one in series):
        caption += " Rings are the paper's figures."
    groups = [column.title for column in spec.columns]
    return interval_plot(name, groups, series, label=label, caption=caption, limits=limits)


def heat_map(
    name: str,
    values: np.ndarray,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    label: str,
    caption: str = "",
    top: float | None = None,
) -> Figure:
    """A map of values (rows, columns) from 0 up, each cell with its figure; `top` (default: the largest) is darkest."""

    def draw(axes: Axes, theme: Theme) -> None:
        ramp = LinearSegmentedColormap.from_list("calm", [theme.page, theme.series[0]])
        darkest = top or float(values.max()) or 1.0
        axes.imshow(values, cmap=ramp, vmin=0, vmax=darkest, aspect="auto")
        axes.set_xticks(range(len(columns)), columns, rotation=0 if len(columns) < 10 else 30)
        axes.set_yticks(range(len(rows)), rows)
        axes.xaxis.tick_top()
        for (r, c), value in np.ndenumerate(values):
            strong = value > 0.6 * darkest
            axes.text(c, r, f"{value:.2f}", ha="center", va="center", fontsize=9,
                      color=theme.page if strong else theme.ink)  # fmt: skip
        axes.set_xticks(np.arange(-0.5, len(columns)), minor=True)
        axes.set_yticks(np.arange(-0.5, len(rows)), minor=True)
        axes.grid(which="minor", color=theme.page, linewidth=2)
        axes.tick_params(which="both", length=0)

    return _figure(name, draw, (5.8, 0.8 + 0.42 * len(rows)), label, caption)


def curve_plot(
    name: str,
    curves: Sequence[tuple[str, np.ndarray]],
    *,
    label: str,
    across: str,
    caption: str = "",
    marks: Sequence[tuple[float, str]] = (),
    colors: Sequence[int] | None = None,
) -> Figure:
    """Curves over frames with bands: (label, (T, 3) value, low, high) each; `marks` are labelled levels.

    `colors` are indices into the theme's colours; without them, each curve's place among the curves.
    """

    def draw(axes: Axes, theme: Theme) -> None:
        for i, (title, curve) in enumerate(curves):
            color = theme.series[(i if colors is None else colors[i]) % len(theme.series)]
            frames = np.arange(1, len(curve) + 1)
            axes.fill_between(frames, curve[:, 1], curve[:, 2], color=color, alpha=0.18, linewidth=0)
            axes.plot(frames, curve[:, 0], color=color, linewidth=2, label=title)
        for level, text in marks:
            axes.axhline(level, color=theme.ink, linewidth=0.9, linestyle=(0, (4, 4)), alpha=0.6)
            axes.annotate(text, (1, level), xycoords=("axes fraction", "data"), ha="right", va="bottom",
                          fontsize=8.5, color=theme.ink, alpha=0.8)  # fmt: skip
        axes.set_xlabel(across)
        axes.set_ylabel(label)
        axes.grid(color=theme.faint, linewidth=0.8)
        if len(curves) <= 3:
            axes.legend(frameon=False, labelcolor=theme.ink, fontsize=9)
        else:  # there is no room for it among so many curves
            axes.legend(
                loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False, labelcolor=theme.ink,
                fontsize=9, handlelength=1.2, columnspacing=1.2,
            )  # fmt: skip

    return _figure(
        name, draw, (5.8, 3.4), f"{label} over {across}: " + ", ".join(t for t, _ in curves), caption
    )


def plot_curves(name: str, spec: TableSpec, rows: Iterable[Row], *, label: str) -> Figure:
    """The figures of a table as a `curve_plot`: its columns are the frames, its lines the curves that were measured."""
    rows = list(rows)
    points = [[point for point in spec.points(rows, line) if point] for line in spec.lines]
    drawn = [(line, np.array(its)) for line, its in zip(spec.lines, points, strict=True) if its]
    curves, hues = [(line.name, curve) for line, curve in drawn], [line.hue for line, _ in drawn]
    return curve_plot(name, curves, label=label, across="frame", caption=spec.caption, colors=hues)


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

    return _wide_figure(name, draw, size, alt, caption)


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
    return _wide_figure(name, draw, size, alt, caption)


def _figure(
    name: str, draw: Callable[[Axes, Theme], None], size: tuple[float, float], alt: str, caption: str
) -> Figure:
    """A figure of one panel."""

    def panel(canvas: Canvas, theme: Theme) -> None:
        canvas.set_layout_engine("constrained")
        axes = canvas.add_subplot(facecolor=theme.page)
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.tick_params(colors=theme.ink, labelsize=10, length=0, pad=7)
        for text in (axes.xaxis.label, axes.yaxis.label):
            text.set_color(theme.ink)
        axes.set_axisbelow(True)
        draw(axes, theme)

    return Figure(name, _png(panel, size, LIGHT, 160), _png(panel, size, DARK, 160), alt, caption)


def _wide_figure(
    name: str, draw: Callable[[Canvas, Theme], None], size: tuple[float, float], alt: str, caption: str
) -> Figure:
    """A figure of many panels, which draws its own."""
    return Figure(name, _png(draw, size, LIGHT, 130), _png(draw, size, DARK, 130), alt, caption, wide=True)


def _png(draw: Callable[[Canvas, Theme], None], size: tuple[float, float], theme: Theme, dpi: int) -> bytes:
    # Not pyplot: it keeps global state, and picks a window system.
    canvas = Canvas(figsize=size, dpi=dpi, facecolor=theme.page)
    FigureCanvasAgg(canvas)
    draw(canvas, theme)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
