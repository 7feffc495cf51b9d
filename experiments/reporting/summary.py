"""`summary.md`: the main tables of every study as Markdown, made from `results.json` files and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from experiments.reporting.results import Results, Row
from experiments.reporting.table import DASH


@dataclass(frozen=True)
class Pick:
    """A table to make of a study's rows: methods from top to bottom, columns from left to right.

    Attributes:
        title: of the table.
        metric: of the rows.
        columns: (split, variant) of each column; those of which there is no row are left out.
        methods: which ones and in which order; by default all that have a row.
        digits: after the point.
    """

    title: str
    metric: str
    columns: Sequence[tuple[str, str]]
    methods: Sequence[str] = ()
    digits: int = 2


def study_markdown(title: str, results: Results, picks: Sequence[Pick]) -> str:
    """A study's part of the summary: its tables, or its headline figures where none of the tables has a row."""
    lines = [f"### {title}", ""]
    tables = [table for pick in picks if (table := _pivot(results.rows, pick))]
    for table in tables or [_headline(results)]:
        lines += [table, ""]
    quick = "**Quick run**: a first look, not the figures to quote. " if results.quick else ""
    lines.append(
        f"{quick}`{results.checkpoint.name}` ({results.checkpoint.sha256[:12]}), 95 % intervals in brackets."
    )
    return "\n".join(lines) + "\n"


def _pivot(rows: Sequence[Row], pick: Pick) -> str:
    found = {(r.method, r.split, r.variant): r for r in rows if r.metric == pick.metric}
    columns = [c for c in pick.columns if any((split, variant) == c for _, split, variant in found)]
    methods = [
        method
        for method in pick.methods or dict.fromkeys(method for method, _, _ in found)
        if any((method, *column) in found for column in columns)
    ]
    if not columns or not methods:
        return ""
    splits = {split for split, _ in columns}
    names = [_words(variant if len(splits) == 1 else f"{split}, {variant}") for split, variant in columns]
    shown = [row for method in methods for column in columns if (row := found.get((method, *column)))]
    counts = {row.n for row in shown}
    title = f"{pick.title}, n = {counts.pop()}" if len(counts) == 1 else pick.title
    lines = [f"| {title} | " + " | ".join(names) + " |", "|---" * (len(columns) + 1) + "|"]
    for method in methods:
        cells = [_cell(found.get((method, *column)), pick.digits, bool(counts)) for column in columns]
        lines.append(f"| {_words(method)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _headline(results: Results) -> str:
    lines = ["| | |", "|---|---|"]
    lines += [f"| {name.replace('_', ' ')} | {value:g} |" for name, value in results.headline.items()]
    return "\n".join(lines)


def _cell(row: Row | None, digits: int, with_n: bool) -> str:
    if row is None:
        return DASH
    notes = [f"{row.low:.{digits}f} to {row.high:.{digits}f}"] if row.n > 1 else []
    notes += [f"n = {row.n}"] if with_n else []
    return f"{row.value:.{digits}f}" + (f" ({', '.join(notes)})" if notes else "")


def _words(name: str) -> str:
    """A name as words; a bar would end the cell."""
    return name.replace("_", " ").replace("|", "/")
