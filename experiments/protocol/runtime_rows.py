"""From timings to rows: milliseconds, planning queries a second, and the ratios that travel between machines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from experiments.protocol.runtime_subjects import CANDIDATES, STEPS, Cell
from experiments.protocol.timing import median_interval
from experiments.reporting import Row

OURS, WINDOW = "TextOCVP", "TextOCVP, published window"
PAPER_CACHE, PAPER_WINDOW = "paper's sizes, cache", "paper's sizes, published window"
UNTRAINED = "untrained, timing only"
QUERY = f"planning query, {CANDIDATES} candidates x {STEPS} frames"

Timings = Mapping[tuple[str, Cell], np.ndarray]
"""(name of a subject, cell) -> (rounds,) seconds."""


def threads_word(count: int) -> str:
    return f"{count} thread" + ("s" if count > 1 else "")


def _row(method: str, split: str, variant: str, metric: str, values: np.ndarray) -> Row:
    interval = median_interval(values)
    return Row(method, split, variant, metric, interval.value, interval.low, interval.high, interval.n)


def cell_rows(seconds: Timings) -> list[Row]:
    """Milliseconds of every cell; `n` counts repeats."""
    return [
        _row(
            name, threads_word(c.threads), f"{c.phase}, {c.frames} x {c.batch}", "milliseconds", 1000 * taken
        )
        for (name, c), taken in seconds.items()
    ]


def query_rows(queries: Mapping[int, Mapping[str, np.ndarray]]) -> list[Row]:
    """Planning queries and candidates a second."""
    rows = []
    for count, timed in queries.items():
        for name, taken in timed.items():
            rows.append(_row(name, threads_word(count), QUERY, "queries_per_second", 1 / taken))
            rows.append(_row(name, threads_word(count), QUERY, "candidates_per_second", CANDIDATES / taken))
    return rows


def ratio_rows(seconds: Timings, queries: Mapping[int, Mapping[str, np.ndarray]]) -> list[Row]:
    """How many times longer one thing takes than another; medians of the ratios of single rounds."""
    rows = []
    for (name, cell), taken in seconds.items():
        against = {WINDOW: OURS, PAPER_WINDOW: PAPER_CACHE}.get(name, OURS if cell.phase == "all" else None)
        other = None if against in (None, name) else seconds.get((against, cell))
        if other is not None:
            where = f"{cell.phase}, {cell.frames} x {cell.batch}"
            both = min(len(taken), len(other))  # the rounds in which both took part
            ratio = taken[:both] / other[:both]
            rows.append(_row(f"{name} / {against}", threads_word(cell.threads), where, "ratio", ratio))
        rows += _own_ratios(name, cell, seconds)
    for count, timed in queries.items():
        if {OURS, WINDOW} <= set(timed):
            both = min(len(timed[WINDOW]), len(timed[OURS]))
            ratio = timed[WINDOW][:both] / timed[OURS][:both]
            rows.append(_row(f"{WINDOW} / {OURS}", threads_word(count), QUERY, "ratio", ratio))
    return rows


def _own_ratios(name: str, cell: Cell, seconds: Timings) -> Iterator[Row]:
    """A subject against itself: other phases, larger batches, fewer threads. Measured at different moments, so the
    rounds are not paired: the medians are divided, and the interval is that of the worst case.
    """

    def divided(label: str, above: Cell, below: Cell, factor: float = 1.0) -> Iterator[Row]:
        if (name, above) in seconds and (name, below) in seconds:
            a, b = (median_interval(seconds[name, one]) for one in (above, below))
            where = f"{cell.phase}, {cell.frames} x {cell.batch}"
            yield Row(
                f"{name}: {label}",
                threads_word(cell.threads),
                where,
                "ratio",
                a.value / b.value / factor,
                a.low / b.high / factor,
                a.high / b.low / factor,
                min(a.n, b.n),
            )

    if cell.phase == "predict":
        yield from divided("decode / predict", Cell("decode", cell.frames, cell.batch, cell.threads), cell)
    if cell.batch > 1:
        one = Cell(cell.phase, cell.frames, 1, cell.threads)
        yield from divided("a scene of a batch / a scene alone", cell, one, cell.batch)
    if cell.threads > 1:
        yield from divided("1 thread / all", Cell(cell.phase, cell.frames, cell.batch, 1), cell)


def headline(rows: Sequence[Row], threads: int) -> dict[str, float]:
    """The figures that are asked for by name, on all threads, as far as they were measured."""
    paper = f"{PAPER_WINDOW} / {PAPER_CACHE}"
    wanted = {
        "window_over_cache_9_frames": (f"{WINDOW} / {OURS}", "predict, 9 x 1", "ratio"),
        "window_over_cache_9_frames_batch_16": (f"{WINDOW} / {OURS}", "predict, 9 x 16", "ratio"),
        "window_over_cache_24_frames": (f"{WINDOW} / {OURS}", "predict, 24 x 1", "ratio"),
        "window_over_cache_planning": (f"{WINDOW} / {OURS}", QUERY, "ratio"),
        "paper_window_over_cache_9_frames": (paper, "predict, 9 x 1", "ratio"),
        "paper_window_over_cache_9_frames_batch_16": (paper, "predict, 9 x 16", "ratio"),
        "decode_over_predict_9_frames": (f"{OURS}: decode / predict", "predict, 9 x 1", "ratio"),
        "mage_over_textocvp_9_frames": (f"MAGE / {OURS}", "all, 9 x 1", "ratio"),
        "mage_over_textocvp_9_frames_batch_16": (f"MAGE / {OURS}", "all, 9 x 16", "ratio"),
        "batch_16_per_scene": (f"{OURS}: a scene of a batch / a scene alone", "all, 9 x 16", "ratio"),
        "one_thread_over_all": (f"{OURS}: 1 thread / all", "all, 9 x 16", "ratio"),
        "planning_queries_per_second": (OURS, QUERY, "queries_per_second"),
        "milliseconds_9_frames": (OURS, "all, 9 x 1", "milliseconds"),
    }
    found = {(r.method, r.variant, r.metric): r.value for r in rows if r.split == threads_word(threads)}
    return {name: round(found[key], 4) for name, key in wanted.items() if key in found}
