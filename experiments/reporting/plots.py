"""Plots with intervals, each drawn for light and for dark pages."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure as Canvas

from experiments.reporting.document import Figure


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
    """One series of figures with intervals, one entry a group; None where it was not measured.

    Attributes:
        label: its name in the legend.
        points: (value, low, high) a group. For a figure without an interval low = value = high.
        hollow: drawn as a ring: figures quoted from elsewhere.
        color: index into the theme's colours; its place among the series if None.
    """

    label: str
    points: Sequence[tuple[float, float, float] | None]
    hollow: bool = False
    color: int | None = None


def interval_plot(
    name: str,
    groups: Sequence[str],
    series: Sequence[Series],
    *,
    label: str,
    caption: str = "",
    limits: tuple[float, float] | None = (0.0, 1.0),
    bar: float | None = None,
) -> Figure:
    """Dots with 95 % intervals, groups from top to bottom.

    Args:
        name: file name, with `.png`.
        groups: one name a group. series: their figures.
        label: of the axis. limits: its ends, or None for automatic ones. bar: a value to mark with a line.
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
                axes.plot(
                    [low, high],
                    [g + offset] * 2,
                    color=color,
                    linewidth=2,
                    alpha=0.55,
                    solid_capstyle="round",
                )
                axes.plot(
                    value, g + offset, "o", markersize=6, color=color, markeredgewidth=1.6,
                    markerfacecolor=theme.page if one.hollow else color, label=None if named else one.label,
                    clip_on=False, zorder=3,
                )  # fmt: skip
                named = True
        for g in range(1, len(groups)):
            axes.axhline(g - 0.5, color=theme.faint, linewidth=0.8)
        if bar is not None:
            axes.axvline(bar, color=theme.ink, linewidth=0.9, linestyle=(0, (4, 4)), alpha=0.6)
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


def _figure(
    name: str, draw: Callable[[Axes, Theme], None], size: tuple[float, float], alt: str, caption: str
) -> Figure:
    return Figure(
        name=name, light=_png(draw, size, LIGHT), dark=_png(draw, size, DARK), alt=alt, caption=caption
    )


def _png(draw: Callable[[Axes, Theme], None], size: tuple[float, float], theme: Theme) -> bytes:
    # Not pyplot: it keeps global state, and picks a window system.
    canvas = Canvas(figsize=size, dpi=160, facecolor=theme.page, layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.add_subplot(facecolor=theme.page)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(colors=theme.ink, labelsize=10, length=0, pad=7)
    for text in (axes.xaxis.label, axes.yaxis.label):
        text.set_color(theme.ink)
    axes.set_axisbelow(True)
    draw(axes, theme)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
