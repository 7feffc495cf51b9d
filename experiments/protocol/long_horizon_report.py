"""The tables and the page of the study of long goals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from experiments.protocol.gallery import Picture
from experiments.protocol.long_goals import LONG_COLUMNS
from experiments.reporting import Card, Cell, Clips, Figure, Report, Results, Row, Section, Table, TableRow
from experiments.reporting.plots import Series, interval_plot
from experiments.reporting.table import DASH, Kind

COLUMNS = tuple(column.name for column in LONG_COLUMNS)
NOTES: dict[str, tuple[Kind, str]] = {
    "ours, replanning": ("ours", "imagine sequences, do the best one's first step, look, imagine again"),
    "ours, one plan": ("ours", "the first plan is carried out to its end, whatever happens"),
    "ours without the rule, replanning": (
        "control",
        "not told that a bowl has room for one block: imagination alone",
    ),
    "random order, replanning": ("control", "told the goal's steps; only their order is left to chance"),
    "random order, one plan": ("control", "the same, carried out without another look"),
    "random sequence, replanning": ("control", "as many random steps; drawn again after every action"),
    "random sequence, one plan": ("control", "as many random steps"),
    "expert": ("ceiling", "scripted, knows every pose, and empties a taken bowl first"),
    "expert, order as written": ("control", "the expert without thinking: shows that order matters"),
}


def success_table(rows: Sequence[Row]) -> Table:
    """Whole goals reached."""
    return _table("Whole goal reached", rows, "closed_loop_success")


def goals_table(rows: Sequence[Row]) -> Table:
    """Share of the goal's parts reached."""
    return _table("Share of sub-goals reached", rows, "subgoals_reached")


def _table(title: str, rows: Sequence[Row], metric: str) -> Table:
    found = {(row.method, row.variant): row for row in rows if row.metric == metric}
    lines = [
        TableRow(method, [Cell.of(found.get((method, column))) for column in COLUMNS], kind, note)
        for method, (kind, note) in NOTES.items()
    ]
    return Table(title, COLUMNS, lines)


def details_table(rows: Sequence[Row], seconds: Mapping[str, Mapping[str, float]]) -> Table:
    """Actions, beliefs, first steps and planning time."""
    found = {(row.method, row.variant, row.metric): row for row in rows}

    def line(label: str, method: str, metric: str, digits: int, note: str = "") -> TableRow:
        cells = [Cell.of(found.get((method, column, metric)), digits) for column in COLUMNS]
        return TableRow(label, cells, NOTES[method][0], note)

    both = ("ours, replanning", "ours, one plan")
    lines = [line(f"pick-and-places, {method}", method, "steps", 1) for method in (*both, "expert")]
    lines += [
        line(
            f"wrong belief, {method}",
            method,
            "wrong_belief",
            2,
            "the planner's own verdict at the end is not the simulator's",
        )
        for method in both
    ]
    lines += [
        line(f"empties the bowl first, {method}", method, "empties_first", 2)
        for method in ("ours, one plan", "random order, one plan")
    ]
    times = [seconds.get("ours, replanning", {}).get(column) for column in COLUMNS]
    lines.append(
        TableRow(
            "seconds a plan, ours",
            [Cell(DASH if t is None else f"{t:.2f}") for t in times],
            "ours",
            "on one core, as busy as it was; not in results.json",
        )
    )
    return Table("Actions, beliefs and planning time", COLUMNS, lines)


def build_report(
    results: Results, seconds: Mapping[str, Mapping[str, float]], pictures: Sequence[Picture], command: str
) -> Report:
    """The page.

    Args:
        seconds: planning time, method -> column -> seconds. pictures: to show. command: what to type for the same
            figures.
    """
    rows = results.rows
    success = Section(
        "Whole goals",
        "A goal of n steps names n blocks and a bowl for each. With one plan, n actions are made; with replanning, "
        "up to three times as many. In the first three columns the order of the steps does not matter, because no "
        "two of them share a bowl: the row with the goal's own steps in random order then shows what carrying out "
        "alone achieves, and what is lost against it was lost by choosing. In the last column one of the blocks "
        "lies in the bowl that the other is to go into, and the sentence names the moves in the order that does not "
        "work. Ours then rests on a rule of the planner, that a bowl in which a block is seen has no room; the row "
        "without the rule shows what the imagined frames alone achieve.",
        [success_table(rows), _plot(rows, "closed_loop_success", "success.png", "whole goal reached")],
    )
    parts = Section(
        "Parts of goals",
        "How much of the goal holds at the end, by the simulator; nothing of it holds at the start.",
        [
            goals_table(rows),
            _plot(rows, "subgoals_reached", "subgoals.png", "share of sub-goals reached"),
            details_table(rows, seconds),
        ],
    )
    shown = Section(
        "Planned beside executed",
        "Failures first, then the longest goals that were reached. Left: the course that each action was read off, one "
        "after another. Right: the camera.",
        [Clips([picture.clip for picture in pictures])] if pictures else [],
    )
    return Report(
        title="Long goals",
        question="Can a robot that imagines several steps ahead reach goals that need them, and what does it gain by "
        "looking again after every step?",
        results=results,
        cards=_cards(results),
        sections=[success, parts, shown],
        command=command,
    )


def _cards(results: Results) -> list[Card]:
    def card(label: str, method: str, column: str, compare: str, control: bool = False) -> Card:
        row = results.find(method, column, "closed_loop_success")
        if row is None:
            return Card(label, DASH, compare=compare)
        detail = f"{row.low:.2f}{DASH}{row.high:.2f}, {row.n} scenes"
        return Card(label, f"{row.value:.2f}", detail, compare, row.value, control)

    def against(column: str) -> str:
        row = results.find("ours, one plan", column, "closed_loop_success")
        return "one plan " + (DASH if row is None else f"{row.value:.2f}")

    cards = [
        card(f"{name.capitalize()}, replanning", "ours, replanning", name, against(name)) for name in COLUMNS
    ]
    cards += [
        card(
            "Two steps, order left to chance",
            "random order, one plan",
            "two steps",
            "told the steps",
            control=True,
        ),
        card(
            "Bowl taken, order left to chance",
            "random order, one plan",
            "bowl taken",
            "order matters",
            control=True,
        ),
        card("Two steps, random steps", "random sequence, one plan", "two steps", "the floor", control=True),
        card(
            "Bowl taken, expert as written",
            "expert, order as written",
            "bowl taken",
            "must be 0",
            control=True,
        ),
    ]
    return cards


def _plot(rows: Sequence[Row], metric: str, name: str, label: str) -> Figure:
    found = {(r.method, r.variant): (r.value, r.low, r.high) for r in rows if r.metric == metric}
    short = {
        "ours, replanning": ("replanning", 0),
        "ours, one plan": ("one plan", 3),
        "random order, one plan": ("random order", 1),
        "random sequence, one plan": ("random steps", 2),
    }
    series = [
        Series(title, [found.get((method, column)) for column in COLUMNS], color=color)
        for method, (title, color) in short.items()
    ]
    return interval_plot(
        name,
        COLUMNS,
        series,
        label=label,
        caption="Dots with 95 % intervals over scenes; all but the first carry out one plan.",
    )
