"""Plots, each drawn for light and for dark pages: figures with intervals, curves, heat maps, grids of pictures."""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure as Canvas

from experiments.report.page import Figure
from experiments.report.rows import Row
from experiments.report.tables import Line, TableSpec

WIDTH = 7.6  # inches of a wide plot
NARROW = 5.8  # inches of the others
LETTER = 0.075  # inches that a letter of a row's name takes at most, on average
GAP = 1  # pixels between the pictures of a grid


@dataclass(frozen=True)
class Theme:
    """Colours of a plot: page, text, faint lines, and one colour a series."""

    page: str
    ink: str
    faint: str
    series: tuple[str, ...]

    @property
    def ramp(self) -> Colormap:
        """From the page to the first colour; what is not known stays blank."""
        ramp = LinearSegmentedColormap.from_list("calm", [self.page, self.series[0]])
        return ramp.with_extremes(bad=self.page)

    @property
    def style(self) -> dict[Any, Any]:
        """Matplotlib's parameters."""
        return {
            **dict.fromkeys(("figure.facecolor", "axes.facecolor"), self.page),
            **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), self.ink),
            **dict.fromkeys((f"axes.spines.{side}" for side in ("left", "right", "top", "bottom")), False),
            **dict.fromkeys((f"{axis}tick.{size}.size" for axis in "xy" for size in ("major", "minor")), 0),
            **dict.fromkeys(("xtick.major.pad", "ytick.major.pad"), 7),
            "axes.axisbelow": True, "grid.color": self.faint, "grid.linewidth": 0.8,
            "figure.constrained_layout.use": True,
            "legend.frameon": False, "legend.labelcolor": self.ink, "legend.fontsize": 9,
        }  # fmt: skip


# The series colours keep at least 3:1 against their page and differ in lightness, not only in hue.
LIGHT = Theme(
    "#ffffff", "#24303b", "#dfe4e8",
    ("#1f6f8b", "#d07a2d", "#7a8894", "#8a5a9e", "#4f8a4c", "#b4472f", "#a08400", "#2f4a9e"),
)  # fmt: skip
DARK = Theme(
    "#161b20", "#d7dee4", "#303942",
    ("#62b6d4", "#eda464", "#94a1ac", "#c39ad6", "#8cc788", "#ec8f78", "#dcc04a", "#8fa6f0"),
)  # fmt: skip


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
    """The figures of a table as dots with intervals: a group for each column, from top to bottom, in it every line.

    Lines of which nothing was measured are left out.

    Args:
        label, limits: of the axis; None for automatic limits.
        lines: shows only these.
    """
    rows, series = list(rows), []
    for line in lines or spec.lines:
        series.append((line.name, spec.points(rows, line), line.hue, False))
        if line.paper:  # as rings; they have no interval
            series.append((line.paper.label, spec.paper_points(line), line.hue, True))
    series = [one for one in series if any(one[1])]
    if any(quoted for *_, quoted in series):
        caption += " Rings are the paper's figures."
    groups = [column.title for column in spec.columns]

    def draw(canvas: Canvas, theme: Theme) -> None:
        axes = canvas.add_subplot()
        for i, (title, points, hue, quoted) in enumerate(series):
            offset = 0.0 if len(series) == 1 else (i / (len(series) - 1) - 0.5) * 0.56
            color = theme.series[hue % len(theme.series)]
            measured = [(g + offset, *point) for g, point in enumerate(points) if point is not None]
            ys, values, lows, highs = zip(*measured, strict=True)
            axes.hlines(ys, lows, highs, color=color, linewidth=2, alpha=0.55, capstyle="round")
            axes.plot(
                values, ys, "o", markersize=6, color=color, markeredgewidth=1.6, label=title,
                markerfacecolor=theme.page if quoted else color, clip_on=False, zorder=3,
            )  # fmt: skip
        for g in range(1, len(groups)):
            axes.axhline(g - 0.5, color=theme.faint, linewidth=0.8)
        axes.set_yticks(range(len(groups)), groups)
        axes.set_ylim(len(groups) - 0.5, -0.5)
        if limits is not None:
            axes.set_xlim(*limits)
        axes.set_xlabel(label)
        axes.grid(axis="x")
        axes.legend(
            loc="lower center", ncols=len(series) if len(series) < 5 else 3, bbox_to_anchor=(0.5, 1.01),
            handletextpad=0.2, columnspacing=1.4,
        )  # fmt: skip

    alt = "; ".join(
        f"{title}: " + ", ".join(f"{g} {point[0]:.2f}" for g, point in zip(groups, points, strict=True) if point)
        for title, points, *_ in series
    )
    height = 1.2 + len(groups) * max(0.34, 0.115 * len(series))
    return _figure(name, draw, (NARROW, height), f"{label}. {alt}", caption)


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

    def draw(canvas: Canvas, theme: Theme) -> None:
        axes = canvas.add_subplot()
        for (title, curve), i in zip(curves, range(len(curves)) if colors is None else colors, strict=True):
            frames, color = np.arange(1, len(curve) + 1), theme.series[i % len(theme.series)]
            axes.fill_between(frames, curve[:, 1], curve[:, 2], color=color, alpha=0.18, linewidth=0)
            axes.plot(frames, curve[:, 0], color=color, linewidth=2, label=title)
        for level, text in marks:
            axes.axhline(level, color=theme.ink, linewidth=0.9, linestyle=(0, (4, 4)), alpha=0.6)
            axes.annotate(text, (1, level), xycoords=("axes fraction", "data"), ha="right", va="bottom",
                          fontsize=8.5, alpha=0.8)  # fmt: skip
        axes.set(xlabel=across, ylabel=label)
        axes.grid()
        if len(curves) <= 3:
            axes.legend()
        else:  # there is no room for it among so many curves
            axes.legend(loc="lower center", ncols=4, bbox_to_anchor=(0.5, 1.0), handlelength=1.2, columnspacing=1.2)

    alt = f"{label} over {across}: " + ", ".join(title for title, _ in curves)
    return _figure(name, draw, (NARROW, 3.4), alt, caption)


def plot_curves(name: str, spec: TableSpec, rows: Iterable[Row], *, label: str) -> Figure:
    """The figures of a table as a `curve_plot`: its columns are the frames, its lines the curves that were measured."""
    rows = list(rows)
    points = [[point for point in spec.points(rows, line) if point] for line in spec.lines]
    drawn = [(line, np.array(its)) for line, its in zip(spec.lines, points, strict=True) if its]
    curves, hues = [(line.name, curve) for line, curve in drawn], [line.hue for line, _ in drawn]
    return curve_plot(name, curves, label=label, across="frame", caption=spec.caption, colors=hues)


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
    darkest = top or float(values.max()) or 1.0

    def draw(canvas: Canvas, theme: Theme) -> None:
        axes = canvas.add_subplot()
        axes.imshow(values, cmap=theme.ramp, vmin=0, vmax=darkest, aspect="auto")
        axes.set_xticks(range(len(columns)), columns, rotation=0 if len(columns) < 10 else 30)
        axes.set_yticks(range(len(rows)), rows)
        axes.xaxis.tick_top()
        for (r, c), value in np.ndenumerate(values):
            color = theme.page if value > 0.6 * darkest else theme.ink
            axes.text(c, r, f"{value:.2f}", ha="center", va="center", fontsize=9, color=color)
        axes.set_xticks(np.arange(-0.5, len(columns)), minor=True)
        axes.set_yticks(np.arange(-0.5, len(rows)), minor=True)
        axes.grid(which="minor", color=theme.page, linewidth=2)

    return _figure(name, draw, (NARROW, 0.8 + 0.42 * len(rows)), label, caption)


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
    """Heat maps of one scale, a title each, with names of their cells at the left and at the bottom.

    Args:
        values: (panel rows, panel columns, rows, columns) from 0 up; nan stays blank.

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
        for (r, c), one in np.ndenumerate(axes):
            one.imshow(values[r, c], cmap=theme.ramp, vmin=0, vmax=top, aspect="auto")
            one.set_title(titles[r][c], fontsize=9, pad=4)
            left, bottom = c == 0, r == len(axes) - 1
            one.set_yticks(range(len(rows)), rows if left else [""] * len(rows), fontsize=8)
            names = columns if bottom else [""] * len(columns)
            one.set_xticks(range(len(columns)), names, rotation=90, fontsize=8)
            one.tick_params(pad=3)
            for spine in one.spines.values():
                spine.set(visible=True, color=theme.faint, linewidth=0.6)

    size = (WIDTH, 0.9 + len(titles) * (0.3 + 0.19 * len(rows)))
    alt = f"{label}: heat maps of {', '.join(rows)} against {', '.join(columns)}"
    return _figure(name, draw, size, alt, caption)


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
        pictures: rows of (H, W, 3) or, with transparency, (H, W, 4) uint8, all of one size. What is transparent takes
            the colour of the page.

    Raises:
        ValueError: if the pictures do not fit the names.
    """
    if len(pictures) != len(rows) or any(len(row) != len(columns) for row in pictures):
        found = [len(row) for row in pictures]
        raise ValueError(f"{len(rows)} x {len(columns)} names, but rows of {found} pictures")
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
        canvas.set_layout_engine("none")
        axes = canvas.add_axes((left / size[0], 0.04 / size[1], wide / size[0], high / size[1]))
        axes.imshow(sheet.round().astype(np.uint8), interpolation="nearest", aspect="auto")
        axes.set_xticks(GAP + across * np.arange(len(columns)) + width / 2, columns, fontsize=9)
        axes.set_yticks(GAP + down * np.arange(len(rows)) + height / 2, rows, fontsize=9)
        axes.xaxis.tick_top()
        axes.tick_params(pad=4)

    return _figure(name, draw, size, alt, caption)


def _figure(
    name: str, draw: Callable[[Canvas, Theme], None], size: tuple[float, float], alt: str, caption: str
) -> Figure:
    wide = size[0] == WIDTH

    def png(theme: Theme) -> bytes:
        with matplotlib.rc_context(theme.style):
            # Not pyplot: it keeps global state, and picks a window system.
            canvas = Canvas(figsize=size, dpi=130 if wide else 160)
            FigureCanvasAgg(canvas)
            draw(canvas, theme)
            canvas.savefig(buffer := io.BytesIO(), format="png", metadata={"Software": None})
        return buffer.getvalue()

    return Figure(name, png(LIGHT), png(DARK), alt, caption, wide)
