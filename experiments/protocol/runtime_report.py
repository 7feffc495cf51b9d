"""The tables and the page of the runtime study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from experiments.protocol.contenders import Absent
from experiments.protocol.runtime_rows import OURS, PAPER_CACHE, PAPER_WINDOW, QUERY, WINDOW, threads_word
from experiments.reporting import Card, Cell, Figure, Report, Results, Row, Section, Table, TableRow
from experiments.reporting.plots import Series, interval_plot
from experiments.reporting.table import DASH

MAGE = f"MAGE / {OURS}"
PAPER = f"{PAPER_WINDOW} / {PAPER_CACHE}"


def phase_table(rows: Sequence[Row], threads: int, batch: int, frames: Sequence[int]) -> Table:
    """Milliseconds of every phase for one number of threads and one batch."""
    here = [r for r in rows if r.metric == "milliseconds" and r.split == threads_word(threads)]
    found = {(row.method, row.variant): row for row in here}
    names = list(dict.fromkeys(row.method for row in here))
    phases = [("encode", 1), *((phase, t) for phase in ("predict", "decode", "all") for t in frames)]
    lines = []
    for name in names:
        cells = [milliseconds(found.get((name, f"{phase}, {t} x {batch}"))) for phase, t in phases]
        lines.append(TableRow(name, cells, "ours" if name == OURS else "control"))
    title = f"Milliseconds, {threads_word(threads)}, batch {batch}"
    return Table(title, [phase if phase == "encode" else f"{phase} {t}" for phase, t in phases], lines)


def milliseconds(row: Row | None) -> Cell:
    """Three significant digits, and the interval; a dash without a row."""
    if row is None:
        return Cell(DASH)
    return Cell(_short(row.value), f"{_short(row.low)}{DASH}{_short(row.high)}", row.n)


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def ratio_table(rows: Sequence[Row]) -> Table:
    """Every ratio, a line each, a column for each number of threads."""
    here = [row for row in rows if row.metric == "ratio"]
    columns = list(dict.fromkeys(row.split for row in here))
    found = {(row.method, row.variant, row.split): row for row in here}
    lines = [
        TableRow(
            f"{method}: {variant}" if ":" not in method else f"{method}, {variant}",
            [Cell.of(found.get((method, variant, column)), 2) for column in columns],
            "ours" if method.startswith(f"{WINDOW} /") else "control",
        )
        for method, variant in dict.fromkeys((row.method, row.variant) for row in here)
    ]
    return Table("Ratios: how many times longer", columns, lines, "A x B: A frames of B scenes at once.")


def query_table(rows: Sequence[Row]) -> Table:
    """Planning queries and candidates a second."""
    here = [row for row in rows if row.variant == QUERY and row.metric != "ratio"]
    columns = list(dict.fromkeys(row.split for row in here))
    found = {(row.method, row.metric, row.split): row for row in here}
    words = {"queries_per_second": "queries a second", "candidates_per_second": "candidates a second"}
    lines = [
        TableRow(
            f"{name}: {words[metric]}",
            [Cell.of(found.get((name, metric, column)), 2) for column in columns],
            "ours" if name == OURS else "control",
        )
        for metric in words
        for name in dict.fromkeys(row.method for row in here)
    ]
    return Table("Planning", columns, lines, QUERY)


def build_report(
    results: Results,
    notes: Mapping[str, str],
    absent: Sequence[Absent],
    drawn: int,
    busy: float,
    command: str,
) -> Report:
    """The page.

    Args:
        notes: what each subject is, in a line. absent: baselines that are not there. drawn: the most frames that are
            drawn at the paper's sizes. busy: how busy the machine was before the study, 1 for all cores. command:
            what to type.
    """
    rows = results.rows
    timed = [row for row in rows if row.metric == "milliseconds"]
    threads = sorted({int(row.split.split()[0]) for row in timed})
    shapes = [tuple(map(int, row.variant.split(", ")[1].split(" x "))) for row in timed]
    frames, batches = (sorted({shape[i] for shape in shapes}) for i in (0, 1))
    machine = f"Measured on {results.versions['machine']}."
    if busy > 0.5:
        machine += (
            f" The machine was busy with other work when the study began (load {busy:.1f} a core): milliseconds and "
            "queries a second are too slow by about that; ratios are taken within a round and hold."
        )
    lacking = " ".join(f"{one.method} is absent: {one.reason}." for one in absent)
    what = ". ".join(f"{name}: {note}" for name, note in notes.items())
    where = Section(
        "Where the time goes",
        f"{machine} Medians of repeats with their 95 % intervals (their range where there are fewer than 6). Encode: "
        "one observed frame to slots or codes. Predict: read the sentences, imagine. Decode: draw colours and masks. "
        "All: from observed frames to imagined ones. A dash: there is no such phase; or, at the paper's sizes, more "
        f"than {drawn} frames to draw; a quick run also leaves out large batches of what is slow. {what}. {lacking}",
        [
            *(phase_table(rows, t, b, frames) for t in reversed(threads) for b in batches),
            _plot(rows, threads_word(threads[-1]), frames),
        ],
    )
    ratios = Section(
        "Figures that travel between machines",
        "Milliseconds depend on the machine, ratios much less. Where two models are compared, the ratio is taken in "
        "each round, in which both had their turn, and the median counts. Untrained models are good for timing only.",
        [ratio_table(rows)],
    )
    planning = Section(
        "Thinking before acting",
        "One query parses the picture, finds the things in it, imagines every candidate, draws the masks that the "
        "scorer looks at, scores and judges. A planner needs masks at few frames, and colours at none.",
        [query_table(rows)],
    )
    return Report(
        title="Runtime",
        question="How long does a thought take, and which part of it?",
        results=results,
        cards=_cards(results, threads_word(threads[-1])),
        sections=[where, ratios, planning],
        command=command,
        again="The seed fixes what is looked at. Milliseconds differ from run to run and from machine to machine; "
        "ratios should come out alike.",
    )


def _cards(results: Results, split: str) -> list[Card]:
    def card(label: str, method: str, variant: str, metric: str, unit: str, compare: str) -> Card:
        row = results.find(method, variant, metric, split)
        if row is None:
            return Card(label, DASH, compare=compare)
        detail = f"{_short(row.low)}{DASH}{_short(row.high)}, {row.n} repeats"
        return Card(label, f"{_short(row.value)}{unit}", detail, compare)

    window = f"{WINDOW} / {OURS}"
    return [
        card("Window over cache, 9 frames", window, "predict, 9 x 1", "ratio", " x", "our prototype: 2.4 x"),
        card("The same, 16 scenes", window, "predict, 9 x 16", "ratio", " x", "our prototype: 4.0 x"),
        card("Window over cache, paper's sizes", PAPER, "predict, 9 x 1", "ratio", " x", "untrained"),
        card("MAGE over TextOCVP, 9 frames", MAGE, "all, 9 x 1", "ratio", " x", "all phases"),
        card(
            "Decode over predict, 9 frames",
            f"{OURS}: decode / predict",
            "predict, 9 x 1",
            "ratio",
            " x",
            "paper's code: 10 x",
        ),
        card("9 frames, one scene", OURS, "all, 9 x 1", "milliseconds", " ms", split),
        card("Planning queries a second", OURS, QUERY, "queries_per_second", "", split),
    ]


def _plot(rows: Sequence[Row], split: str, frames: Sequence[int]) -> Figure:
    """Milliseconds of the phases at one scene and the middle number of frames."""
    count = 9 if 9 in frames else frames[-1]
    here = [row for row in rows if row.metric == "milliseconds" and row.split == split]
    found = {(row.method, row.variant): (row.value, row.low, row.high) for row in here}
    # The paper's sizes take many times longer: on one axis with them nothing else could be told apart.
    names = [n for n in dict.fromkeys(row.method for row in here) if n not in (PAPER_WINDOW, PAPER_CACHE)]
    columns = {
        phase: f"{phase}, {1 if phase == 'encode' else count} x 1"
        for phase in ("encode", "predict", "decode", "all")
    }
    series = [
        Series(phase, [found.get((name, variant)) for name in names]) for phase, variant in columns.items()
    ]
    return interval_plot(
        "phases.png",
        names,
        series,
        label="milliseconds",
        caption=f"{count} frames of one scene, {split}; the paper's sizes are in the tables.",
        limits=None,
    )
