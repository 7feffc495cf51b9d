"""The controllability study's tables and page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.protocol.gallery import Picture
from experiments.protocol.predicted import PredictedOutcome
from experiments.protocol.scenes import LOOP_COLUMNS
from experiments.reporting import Card, Cell, Clips, Figure, Report, Results, Row, Section, Table, TableRow
from experiments.reporting.plots import Series, curve_plot, heat_map, interval_plot
from experiments.reporting.table import DASH, Kind
from planning import THRESHOLDS

PREDICTED_COLUMNS = ("original", "variant 1", "variant 2", "variant 3", "variants mean")
# TextOCVP, controllability on CLIPort: mean of 5 runs over 100 sequences.
PAPER = (0.83, 0.86, 0.80, 0.81, 0.82)
PREDICTED_NOTES: dict[str, tuple[Kind, str]] = {
    "ours": ("ours", "imagined with the sentence, judged on the imagined masks"),
    "true frames": ("ceiling", "the parser on the simulator's frames: the ceiling"),
    "wrong text": ("control", "imagined with another sentence, judged for this one: must be near 0"),
    "copy frame": ("control", "the first frame repeated: must be near 0"),
}
LOOP_NOTES: dict[str, tuple[Kind, str]] = {
    "ours": (
        "ours",
        "imagine every instruction, score, act, look, replan; nothing from the simulator's state",
    ),
    "ours, privileged": ("ceiling", "the same, but slots are named by the simulator's segmentation"),
    "expert": ("ceiling", "scripted, knows every pose"),
    "random candidate": ("control", "the same loop with a random instruction instead of the best-scored one"),
}


def predicted_table(rows: Sequence[Row]) -> Table:
    """Rows as in the paper's table, with our controls and the paper's own figures."""
    found = {(r.method, r.variant): r for r in rows if r.metric == "predicted_success"}
    lines = [
        TableRow(method, [Cell.of(found.get((method, column))) for column in PREDICTED_COLUMNS], kind, note)
        for method, (kind, note) in PREDICTED_NOTES.items()
    ]
    paper = [Cell(f"{value:.2f}") for value in PAPER]
    lines.insert(
        1, TableRow("paper, TextOCVP", paper, "paper", "CLIPort at 336x336, mean of 5 runs over 100 scenes")
    )
    return Table("Predicted success", PREDICTED_COLUMNS, lines)


def loop_table(rows: Sequence[Row]) -> Table:
    """Success of the closed loop, a column for each kind of goal and scene."""
    found = {(r.method, r.variant): r for r in rows if r.metric == "closed_loop_success"}
    columns = [column.name for column in LOOP_COLUMNS]
    lines = [
        TableRow(method, [Cell.of(found.get((method, column))) for column in columns], kind, note)
        for method, (kind, note) in LOOP_NOTES.items()
    ]
    return Table("Closed-loop success", columns, lines)


def details_table(rows: Sequence[Row], seconds: Mapping[str, Mapping[str, float]]) -> Table:
    """Ranking, steps and planning time of the closed loop."""
    found = {(r.method, r.variant, r.metric): r for r in rows}
    columns = [column.name for column in LOOP_COLUMNS]

    def line(label: str, method: str, metric: str, digits: int, note: str = "") -> TableRow:
        cells = [Cell.of(found.get((method, column, metric)), digits) for column in columns]
        return TableRow(label, cells, LOOP_NOTES[method][0], note)

    times = [seconds.get("ours", {}).get(column) for column in columns]
    lines = [
        line(
            "candidate ranking, ours",
            "ours",
            "candidate_ranking",
            2,
            "the best-scored is the one that was asked for",
        ),
        line("candidate ranking, privileged", "ours, privileged", "candidate_ranking", 2),
        line("pick-and-places, ours", "ours", "steps", 1, "mean of all episodes"),
        line("pick-and-places, expert", "expert", "steps", 1),
        line("pick-and-places, random", "random candidate", "steps", 1),
        TableRow(
            "seconds a plan, ours",
            [Cell(DASH if t is None else f"{t:.2f}") for t in times],
            "ours",
            "parse, imagine all candidates, score; one core, not in results.json",
        ),
    ]
    return Table("Ranking, steps and planning time", columns, lines)


def build_report(
    results: Results,
    outcomes: Sequence[PredictedOutcome],
    seconds: Mapping[str, Mapping[str, float]],
    predicted_pictures: Sequence[Picture],
    loop_pictures: Sequence[Picture],
    command: str,
) -> Report:
    """The page.

    Args:
        outcomes: of the predicted study, for the curves. seconds: planning time, method -> column -> seconds.
        predicted_pictures, loop_pictures: to show. command: what to type for the same figures.
    """
    rows = results.rows
    limits = THRESHOLDS
    predicted = Section(
        "Predicted: does the imagined scene obey the sentence?",
        "Each scene is imagined with its own instruction and with three that name another bowl. A rollout "
        f"counts when the arm stays within {limits.arm_block_px:g} px of the named block for "
        f"{limits.hold_frames} frames and the block ends within {limits.block_bowl_px:g} px of the named "
        f"bowl's centre in the last {limits.settle_frames} frames, all read off the masks. The thresholds "
        "were calibrated on the simulator's masks, never on predictions.",
        [predicted_table(rows), _predicted_plot(rows), _distance_plot(outcomes)],
    )
    gallery = Section(
        "Imagined beside real",
        "The best cases and the worst ones by where the block ends. Below the pictures: the slots' masks "
        "beside the simulator's segmentation, one colour a thing.",
        [Clips([picture.clip for picture in predicted_pictures])],
    )
    loop = Section(
        "Closed loop: does a robot that trusts it reach the goal?",
        "The planner sees a picture and a goal, imagines the candidates, and the best one's masks become a "
        "pick-and-place. PyBullet executes it and the simulator alone judges. Afterwards the planner looks "
        "again and replans while it does not see the goal reached, up to three times for each block.",
        [loop_table(rows), _loop_plot(rows), details_table(rows, seconds)],
    )
    acted = Section(
        "Planned beside executed",
        "Long goals, and failures where there are any. Left: each chosen plan, imagined. Right: the camera.",
        [Clips([picture.clip for picture in loop_pictures])],
    )
    sections = [predicted, gallery, loop, acted]
    maps = [picture.attention for picture in predicted_pictures if picture.attention is not None]
    if maps:
        figure = heat_map(
            "attention.png", maps[0].weights, maps[0].slots, maps[0].words, label="attention to words"
        )
        text = "Text-to-slot attention of the first best case, mean over layers, heads and frames."
        sections.append(Section("Which words a slot listens to", text, [figure]))
    return Report(
        title="Controllability",
        question="Change the sentence and nothing else: does the world model imagine what it says, and can a "
        "robot that plans with it do it?",
        results=results,
        cards=_cards(results),
        sections=sections,
        command=command,
    )


def _cards(results: Results) -> list[Card]:
    def card(label: str, method: str, variant: str, metric: str, compare: str) -> Card:
        row = results.find(method, variant, metric)
        if row is None:
            return Card(label, DASH, compare=compare)
        detail = f"{row.low:.2f}{DASH}{row.high:.2f}, {row.n} scenes"
        return Card(
            label, f"{row.value:.2f}", detail, compare, row.value, method not in ("ours", "true frames")
        )

    return [
        card("Predicted, original instruction", "ours", "original", "predicted_success", "paper 0.83"),
        card("Predicted, three other bowls", "ours", "variants mean", "predicted_success", "paper 0.82"),
        card(
            "Closed loop, original instruction", "ours", "original", "closed_loop_success", "not in the paper"
        ),
        card(
            "Closed loop, three other bowls",
            "ours",
            "variants mean",
            "closed_loop_success",
            "not in the paper",
        ),
        card(
            "Best-scored candidate is the right one", "ours", "all", "candidate_ranking", "not in the paper"
        ),
        card("True frames, parsed", "true frames", "all", "predicted_success", "the ceiling"),
        card("Wrong text", "wrong text", "all", "predicted_success", "should be near 0"),
        card(
            "Closed loop, random candidate",
            "random candidate",
            "original",
            "closed_loop_success",
            "the floor",
        ),
    ]


def _points(
    rows: Sequence[Row], method: str, metric: str, columns: Sequence[str]
) -> list[tuple[float, float, float] | None]:
    found = {(r.method, r.variant): (r.value, r.low, r.high) for r in rows if r.metric == metric}
    return [found.get((method, column)) for column in columns]


def _predicted_plot(rows: Sequence[Row]) -> Figure:
    columns = PREDICTED_COLUMNS
    series = [
        Series(m, _points(rows, m, "predicted_success", columns))
        for m in ("ours", "true frames", "wrong text")
    ]
    series.append(Series("paper", [(value, value, value) for value in PAPER], hollow=True, color=3))
    caption = "Dots with 95 % intervals over scenes; rings are the paper's figures."
    return interval_plot("predicted.png", columns, series, label="predicted success", caption=caption)


def _loop_plot(rows: Sequence[Row]) -> Figure:
    columns = [column.name for column in LOOP_COLUMNS]
    series = [
        Series(method, _points(rows, method, "closed_loop_success", columns), color=color)
        for method, color in (("ours", 0), ("ours, privileged", 3), ("expert", 1), ("random candidate", 2))
    ]
    caption = "Dots with 95 % intervals over scenes, judged by the simulator."
    return interval_plot("closed_loop.png", columns, series, label="closed-loop success", caption=caption)


FARTHEST = 64
"""Pixels along a side of the frame."""


def _distance_plot(outcomes: Sequence[PredictedOutcome]) -> Figure:
    curves = []
    for title, name in (("imagined", "imagined_TV"), ("true frames", "true_TV")):
        # Without the observed frame.
        columns = [column[1:] for outcome in outcomes for column in getattr(outcome, name).T]
        length = max(len(column) for column in columns)
        distances = np.stack([np.pad(column, (0, length - len(column)), mode="edge") for column in columns])
        # What cannot be seen is farther off than anything that can.
        distances[~np.isfinite(distances)] = FARTHEST
        low, middle, high = np.quantile(distances, (0.1, 0.5, 0.9), axis=0)
        curves.append((title, np.stack([middle, low, high], axis=1)))
    return curve_plot(
        "distance.png",
        curves,
        label="block to bowl, px",
        across="frame",
        caption="Distance of the named block to the named bowl: median, and the middle 80 % of all cases. One that "
        f"cannot be seen counts as {FARTHEST} px.",
        marks=[(THRESHOLDS.block_bowl_px, "counts as in the bowl")],
    )
