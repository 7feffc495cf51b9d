"""The interpretability study's tables and page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.protocol.listening import GROUPS, ROLES
from experiments.protocol.listening_gallery import ListeningPictures
from experiments.protocol.listening_rows import (
    CHANCE,
    COLORS,
    COLUMNS,
    ENDS,
    LOOKS,
    METHODS,
    OURS,
    SILENT,
    WRONG,
    attends,
    head_method,
)
from experiments.protocol.listening_scenes import ListeningOutcome
from experiments.protocol.words import TEMPLATE
from experiments.reporting import Card, Cell, Clips, Figure, Report, Results, Row, Section, Table, TableRow
from experiments.reporting.grids import heat_grid
from experiments.reporting.plots import Series, curve_plot, heat_map, interval_plot
from experiments.reporting.table import DASH, Kind
from planning import THRESHOLDS
from textocvp.metrics.intervals import bootstrap_interval

NOTES: dict[str, tuple[Kind, str]] = {
    OURS: ("ours", "slots named by the simulator's segmentation, for measuring only"),
    LOOKS: ("ours", "slots named by their appearance, as the planner does it"),
    SILENT: ("control", "the same weights without the term that compares colours"),
    COLORS: ("control", "that term alone: which slot's colour is nearest to the word's, no network"),
    WRONG: ("control", "the same slots under a sentence that names other things: should be near 0"),
    CHANCE: ("control", "one guess among the slots that are present"),
}


def attends_table(rows: Sequence[Row], role: str) -> Table:
    """How often the slot of the named block (bowl) attends most to its colour word."""
    return _table(rows, attends(role), f"The named {role} attends most to its colour word", METHODS)


def _table(rows: Sequence[Row], metric: str, title: str, methods: Sequence[str]) -> Table:
    found = {(row.method, row.split, row.variant): row for row in rows if row.metric == metric}
    lines = [
        TableRow(method, [Cell.of(found.get((method, *key))) for key in COLUMNS.values()], *NOTES[method])
        for method in methods
        if any(key[0] == method for key in found)
    ]
    return Table(title, list(COLUMNS), lines)


def build_report(
    results: Results,
    outcomes: Sequence[ListeningOutcome],
    pictures: Sequence[ListeningPictures],
    split: str,
    command: str,
) -> Report:
    """The page.

    Args:
        outcomes: of all scenes. pictures: best and worst cases.
        split: whose scenes the maps and curves are means over. command: what to type for the same figures.
    """
    rows = results.rows
    here = [outcome for outcome in outcomes if outcome.scene.split == split]
    often = Section(
        "How often does the named thing listen most?",
        "Every slot divides its attention among the words: its shares sum to 1, or to less by what a text encoder's "
        "special tokens get. A slot attends most to a word if its "
        "share for that word is larger than that of every other slot that is present, table included; equal is not "
        "more. Shares are averaged over steps, layers and heads first. A colour is one word, whatever the encoder "
        "makes of it. A named thing that the parser gave no slot counts as a miss. New names: the scenes with unseen "
        "colours in which the thing's colour name is in no training caption.",
        [*(attends_table(rows, role) for role in ROLES), *(_dots(rows, role) for role in ROLES)],
    )
    sections = [often]
    if any(row.method == SILENT for row in rows):
        sections.append(_term_section(rows, here))
    sections += [
        Section(
            "Head by head",
            "The same figure for each layer and head by itself, over all instructions of these scenes.",
            [
                _heads(rows, method, role)
                for method in (OURS, SILENT)
                for role in ROLES
                if _has_heads(rows, method)
            ],
        ),
        Section(
            "What each thing listens to",
            "Mean share of each thing's slots for each word: over all heads, and head by head.",
            [_mean_map(here), _head_maps(here), *(p.words for p in pictures if p.words is not None)],
        ),
        Section(
            "Over time",
            "Shares for the two colour words while the arm reaches, carries and retreats; mean over layers and heads.",
            [*(_share_curves(here, r) for r in range(len(ROLES))), _most_curves(here)],
        ),
        Section(
            "Seen over the picture",
            "The cases in which the named things lead the most and the least. Each slot glows with its share of "
            "attention to the block's colour word and to the bowl's.",
            [Clips([picture.clip for picture in pictures])],
        ),
    ]
    return Report(
        title="Who listens to which word",
        question="Does the slot of the thing that a sentence names attend to the word that names it?",
        results=results,
        cards=_cards(results),
        sections=sections,
        command=command,
    )


def _term_section(rows: Sequence[Row], here: Sequence[ListeningOutcome]) -> Section:
    return Section(
        "Does the colour-matching term decide it?",
        "This predictor adds to the attention logits how well a slot's colour fits the colour that a lexicon gives "
        "for the word. Setting its learned gains to 0 in a copy of the model shows what the rest has learned by "
        f"itself, and whether the motion still ends within {THRESHOLDS.block_bowl_px:g} px of the named bowl. The copy "
        "was not trained without the term, so this says what these weights rely on, not what could be learned.",
        [
            _table(rows, ENDS, "The named block ends in the named bowl", (OURS, SILENT, WRONG)),
            _map("attention_silent.png", [h for o in here for h in o.silent], "without the colour term"),
        ],
    )


def _cards(results: Results) -> list[Card]:
    def card(label: str, method: str, column: str, metric: str, compare: str) -> Card:
        split, variant = COLUMNS[column]
        row = results.find(method, variant, metric, split)
        if row is None:
            return Card(label, DASH, compare=compare)
        detail = f"{row.low:.2f}{DASH}{row.high:.2f}, {row.n} scenes"
        return Card(label, f"{row.value:.2f}", detail, compare, row.value, method not in (OURS, LOOKS))

    _, plain, others, _, new = COLUMNS
    return [
        card("Block listens, original", OURS, plain, attends("block"), "not in the paper"),
        card("Bowl listens, original", OURS, plain, attends("bowl"), "not in the paper"),
        card("Bowl listens, three other bowls", OURS, others, attends("bowl"), "not in the paper"),
        card("Block listens, new colour names", OURS, new, attends("block"), "not in the paper"),
        card("Bowl, wrong sentence", WRONG, plain, attends("bowl"), "should be near 0"),
        card("Chance", CHANCE, plain, attends("bowl"), "one guess among the slots"),
        card("Bowl, colour term off", SILENT, plain, attends("bowl"), "what the rest has learned"),
        card("Ends in bowl, colour term off", SILENT, plain, ENDS, "what the motion owes to it"),
    ]


def _dots(rows: Sequence[Row], role: str) -> Figure:
    found = {
        (r.method, r.split, r.variant): (r.value, r.low, r.high) for r in rows if r.metric == attends(role)
    }
    series = [
        Series(method, [found.get((method, *key)) for key in COLUMNS.values()], color=color)
        for method, color in ((OURS, 0), (LOOKS, 1), (SILENT, 3), (WRONG, 4), (CHANCE, 2))
        if any(key[0] == method for key in found)
    ]
    caption = "Dots with 95 % intervals over scenes."
    return interval_plot(
        f"attends_{role}.png", list(COLUMNS), series, label=f"named {role} attends most", caption=caption
    )


def _has_heads(rows: Sequence[Row], method: str) -> bool:
    return any(row.method == head_method(method, 0, 0) for row in rows)


def _heads(rows: Sequence[Row], method: str, role: str) -> Figure:
    found = {row.method: row.value for row in rows if row.metric == attends(role) and row.variant == "all"}
    layers = next(n for n in range(len(found)) if head_method(method, n + 1, 0) not in found) + 1
    heads = next(h for h in range(len(found)) if head_method(method, 0, h + 1) not in found) + 1
    values = np.array([[found[head_method(method, n, h)] for h in range(heads)] for n in range(layers)])
    name = f"heads_{role}{'' if method == OURS else '_silent'}.png"
    of = "" if method == OURS else f", {SILENT}"
    return heat_map(
        name, values, [f"layer {n + 1}" for n in range(layers)], [f"head {h + 1}" for h in range(heads)],
        label="attends most", caption=f"How often the named {role} attends most to its colour word{of}.", top=1.0,
    )  # fmt: skip


def _maps(outcomes: Sequence[ListeningOutcome]) -> np.ndarray:
    """Mean over scenes and texts (n, h, G, W); nan for a group that no scene has."""
    return _nanmean(np.stack([heard.map_nhGW for outcome in outcomes for heard in outcome.heard]))


def _nanmean(values: np.ndarray) -> np.ndarray:
    seen = ~np.isnan(values)
    sums = np.where(seen, values, 0.0).sum(0)
    return np.where(seen.any(0), sums / np.maximum(seen.sum(0), 1), np.nan)


def _mean_map(outcomes: Sequence[ListeningOutcome]) -> Figure:
    return _map("attention.png", [heard for outcome in outcomes for heard in outcome.heard], "all heads")


def _map(name: str, heard: Sequence, what: str) -> Figure:
    map_GW = _nanmean(np.stack([one.map_nhGW for one in heard])).mean((0, 1))
    there = [g for g in range(len(GROUPS)) if not np.isnan(map_GW[g]).any()]
    caption = f"Mean over scenes, instructions, steps, layers and heads ({what})."
    return heat_map(
        name,
        map_GW[there],
        [GROUPS[g] for g in there],
        _short(TEMPLATE),
        label="attention to words",
        caption=caption,
    )


def _short(words: Sequence[str]) -> list[str]:
    """Template words for the narrow columns of a map."""
    return [word.replace("'s colour", "\ncolour") for word in words]


def _head_maps(outcomes: Sequence[ListeningOutcome]) -> Figure:
    maps = _maps(outcomes)
    there = [g for g in range(len(GROUPS)) if not np.isnan(maps[:, :, g]).any()]
    titles = [[f"layer {n + 1}, head {h + 1}" for h in range(maps.shape[1])] for n in range(maps.shape[0])]
    caption = "The same for each layer and head. All maps share one scale."
    return heat_grid(
        "attention_heads.png", maps[:, :, there], [GROUPS[g] for g in there], list(TEMPLATE), titles,
        label="attention to words", caption=caption,
    )  # fmt: skip


def _share_curves(outcomes: Sequence[ListeningOutcome], r: int) -> Figure:
    curves = []
    for g, group in enumerate(GROUPS):
        # A scene's texts are not independent: one curve a scene.
        films = [_nanmean(np.stack([heard.shares_RTG[r, :, g] for heard in o.heard])) for o in outcomes]
        films = [film for film in films if not np.isnan(film).any()]
        if films:
            curves.append((group, _bands(np.stack(films))))
    caption = "Mean over scenes with its 95 % interval."
    return curve_plot(
        f"shares_{ROLES[r]}.png",
        curves,
        label=f"share for the {ROLES[r]}'s colour",
        across="step",
        caption=caption,
    )


def _most_curves(outcomes: Sequence[ListeningOutcome]) -> Figure:
    curves = []
    for r, role in enumerate(ROLES):
        films = [np.mean([heard.most_RT[r] for heard in o.heard], axis=0) for o in outcomes]
        curves.append((f"named {role}", _bands(np.stack(films))))
    chance = float(np.mean([heard.chance_R.mean() for o in outcomes for heard in o.heard]))
    return curve_plot(
        "most.png", curves, label="attends most", across="step", marks=[(chance, "chance")],
        caption="Share of instructions in which the named thing attends most to its colour word, step by step.",
    )  # fmt: skip


def _bands(films_NT: np.ndarray) -> np.ndarray:
    intervals = [bootstrap_interval(column, resamples=500) for column in films_NT.T]
    return np.array([(i.value, i.low, i.high) for i in intervals])
