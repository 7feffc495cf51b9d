"""Small figures and pages for the tests of reporting."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from experiments.report.gif import gif, paint, segmentation_colors
from experiments.report.page import Card, Clip, Clips, Report, Section
from experiments.report.plots import heat_map, plot_table
from experiments.report.results import EpisodeLine, Results
from experiments.report.rows import Row
from experiments.report.tables import Cell, Column, Line, Table, TableRow, TableSpec
from textocvp.checkpoint import Checkpoint


def row(value: float = 0.9, low: float = 0.8, high: float = 0.95, method: str = "ours") -> Row:
    return Row(method, "controllability", "original", "predicted_success", value, low, high, 20)


def results(quick: bool = False) -> Results:
    return Results(
        study="controllability",
        checkpoint=Checkpoint("tabletop-small", "ab" * 32),
        versions={"python": "3.11", "torch": "2.3"},
        seeds={"slots": [0, 1], "scenes": list(range(50, 70))},
        quick=quick,
        seconds=12.5,
        rows=[row()],
        headline={"predicted_original": 0.9},
        episodes=(EpisodeLine("ours", "controllability, original", "predicted_success", "0a" * 6, 50, "go", 1.0),),
    )


@lru_cache
def report(quick: bool = False) -> Report:
    """A page with one block of every kind, and text that would break it if it were not escaped."""
    table = Table(
        "Predicted success",
        ["original", "variant 1", "variant 2", "variant 3", "variants mean"],
        [TableRow("ours", [Cell.of(row())] * 5, "ours", "a note"), TableRow("paper", [Cell("0.83")] * 5, "paper")],
    )
    labels_THW = np.random.default_rng(0).integers(0, 5, (4, 16, 16))
    film = paint(labels_THW, segmentation_colors(3))
    clip = Clip(
        "a.gif", gif([[film, film], [film, film]]), ("imagined", "real"), "put <b>it</b> there", badge="worst 1"
    )
    places = [Column(title, "controllability", title, "predicted_success") for title in ("original", "variants")]
    plot = plot_table("p.png", TableSpec("", places, [Line(key="ours")]), [row()], label="success")
    heat = heat_map("h.png", np.eye(3), ["block", "bowl", "arm"], ["put", "the", "block"], label="attention")
    return Report(
        title="Controllability",
        question="Does it?",
        results=results(quick),
        cards=[Card("Predicted", "0.90", share=0.9), Card("Wrong text", "0.00", share=0.0, control=True)],
        sections=[Section("One", "Words.", [table, plot]), Section("Two", blocks=[Clips([clip]), heat])],
        command="python experiments/controllability.py --seed 0",
    )
