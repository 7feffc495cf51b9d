"""The object study's tables and page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.protocol.contenders import FAR, NOTES, TRAINED_LITTLE, Absent, absent_text
from experiments.protocol.object_gallery import ObjectPictures
from experiments.protocol.object_scenes import LENGTHS, ObjectOutcome
from experiments.reporting import (
    Card,
    Cell,
    Clips,
    Figure,
    Report,
    Results,
    Row,
    Section,
    Table,
    TableRow,
)
from experiments.reporting.plots import Series, curve_plot, interval_plot
from experiments.reporting.table import DASH, Kind
from textocvp.metrics.intervals import bootstrap_interval

SPLIT = "test"
#: Name in results.json -> field of `MaskScores`.
METRICS = {
    "iou": "iou",
    "iou_moving": "moving",
    "iou_named_block": "block",
    "iou_arm": "arm",
    "iou_still": "still",
    "iou_kept": "kept",
    "iou_kept_moving": "kept_moving",
    "foreground_ari": "ari",
}
METHODS: dict[str, tuple[Kind, str]] = {
    "ours": ("ours", "imagined from one frame and the sentence"),
    FAR.method: ("ours", FAR.note),
    "true frames": ("ceiling", "the parser on the simulator's frames, nothing imagined"),
    "OCVP-Seq": ("control", NOTES["OCVP-Seq"]),
    "copy seed": ("control", "the first frame's masks held still"),
    "wrong text": ("control", "imagined with a sentence that names something else"),
}
#: Each method's colour in every plot.
HUES = {"ours": 0, FAR.method: 7, "true frames": 1, "OCVP-Seq": 3, "copy seed": 2, "wrong text": 4}
# Mask IoU on CLIPort after 9 and 19 frames.
PAPER = {"ours": (0.573, 0.569), "true frames": (0.554, 0.553), "copy seed": (0.540, 0.525)}
PAPER_NAMES = {
    "ours": "paper, TextOCVP",
    "true frames": "paper, parser on true frames",
    "copy seed": "paper, Copy-Seed",
}
MINUS = "ours minus "


def mean_to(length: int) -> str:
    """The `variant` of a mean over the first predicted frames."""
    return f"frames 1-{length}"


def frame_at(length: int) -> str:
    """The `variant` of one frame alone."""
    return f"frame {length}"


def iou_table(
    rows: Sequence[Row], metric: str, title: str, *, paper: bool = False, single: bool = True
) -> Table:
    """One metric of all methods: means up to each length, then single frames.

    Args:
        metric: its name in results.json. title: of the table.
        paper: whether the paper's figures stand beside.
        single: whether the single frames do; a terminal has no room for them.
    """
    found = {(row.method, row.variant): row for row in rows if row.metric == metric}
    known = [length for length in LENGTHS if any(variant == mean_to(length) for _, variant in found)]
    variants = [*map(mean_to, known), *(map(frame_at, known) if single else ())]
    lines = []
    for method, (kind, note) in METHODS.items():
        cells = [Cell.of(found.get((method, variant)), 3) for variant in variants]
        if any(one == method for one, _ in found) or method == "OCVP-Seq":
            lines.append(TableRow(method, cells, kind, note))
        if paper and method in PAPER:
            quoted = dict(
                zip(map(mean_to, LENGTHS), (f"{value:.3f}" for value in PAPER[method]), strict=False)
            )
            lines.append(
                TableRow(
                    PAPER_NAMES[method], [Cell(quoted.get(v, DASH)) for v in variants], "paper", "on CLIPort"
                )
            )
    return Table(title, variants, lines)


def details_table(rows: Sequence[Row], length: int) -> Table:
    """The other metrics, as means up to one length."""
    columns = {
        "foreground ARI": "foreground_ari",
        "named block": "iou_named_block",
        "arm": "iou_arm",
        "still objects": "iou_still",
        "kept slot": "iou_kept",
        "kept slot, moving": "iou_kept_moving",
    }
    found = {(row.method, row.metric): row for row in rows if row.variant == mean_to(length)}
    lines = [
        TableRow(method, [Cell.of(found.get((method, metric)), 3) for metric in columns.values()], kind)
        for method, (kind, _) in METHODS.items()
        if (method, "iou") in found
    ]
    caption = "Kept slot: each object against the one slot that had it in the first frame."
    return Table(f"Apart, mean of frames 1-{length}", list(columns), lines, caption)


def difference_table(rows: Sequence[Row]) -> Table:
    """Ours minus each other method, scene by scene."""
    found = {(row.method, row.metric, row.variant): row for row in rows if row.method.startswith(MINUS)}
    others = [method for method in METHODS if any(key[0] == MINUS + method for key in found)]
    known = [length for length in LENGTHS if any(key[2] == mean_to(length) for key in found)]
    columns = [(metric, length) for metric in ("iou", "iou_moving") for length in known]
    lines = [
        TableRow(
            MINUS + method,
            [Cell.of(found.get((MINUS + method, metric, mean_to(length))), 3) for metric, length in columns],
            METHODS[method][0],
        )
        for method in others
    ]
    names = [f"{'all' if metric == 'iou' else 'moving'}, 1-{length}" for metric, length in columns]
    caption = "Differences within the same scene, so their intervals are narrower than those of the figures."
    return Table("Mask IoU, difference", names, lines, caption)


def build_report(
    results: Results,
    outcomes: Sequence[ObjectOutcome],
    pictures: Sequence[ObjectPictures],
    absent: Sequence[Absent],
    command: str,
) -> Report:
    """The page.

    Args:
        outcomes: of all scenes, for the curves. pictures: best and worst scenes.
        absent: the baselines that are not there. command: what to type for the same figures.
    """
    rows = results.rows
    length = max(length for length in LENGTHS if results.find("ours", mean_to(length), "iou"))
    missing = f" {TRAINED_LITTLE}" + (f" {absent_text(absent)}" if absent else "")
    overlap = Section(
        "Mask IoU against the simulator",
        "Slots are matched to the blocks and bowls that are seen, anew in every frame (Hungarian), and overlaps are "
        "averaged over objects, frames, and then scenes. The paper's figures come from another renderer of the task, "
        "at 336x336, so their order matters more than their height. When an episode is over, its last frame stays."
        + missing,
        [
            iou_table(rows, "iou", "All blocks and bowls", paper=True),
            _dots(results),
            _curves(outcomes, "iou", "mask IoU, all objects", "iou.png"),
        ],
    )
    moving = Section(
        "Only what moves",
        "Most objects stand still, and copying the first frame is right about those. What the sentence decides is "
        "where the named block and the arm go.",
        [
            iou_table(rows, "iou_moving", "Named block and arm"),
            _curves(outcomes, "moving", "mask IoU, block and arm", "iou_moving.png"),
            difference_table(rows),
        ],
    )
    apart = Section(
        "Foreground ARI, and object by object",
        "",
        [details_table(rows, length), _curves(outcomes, "ari", "foreground ARI", "ari.png")],
    )
    strips = [picture.apart for picture in pictures if picture.apart is not None]
    drawn = Section(
        "Every slot drawn alone",
        "What the renderer makes of one slot, cut out by its mask. The names come from the simulator's segmentation of "
        "the first frame and serve as labels only.",
        strips,
    )
    gallery = Section(
        "Imagined beside real",
        "The best and the worst scenes by the overlap of block and arm. Below the pictures: the slots' masks beside "
        "the simulator's segmentation, one colour a thing.",
        [Clips([picture.clip for picture in pictures])],
    )
    sections = [overlap, moving, apart, *([drawn] if strips else []), gallery]
    return Report(
        title="Objects",
        question="Do the imagined masks stay on the objects, and does the one that is named go where it should?",
        results=results,
        cards=_cards(results),
        sections=sections,
        command=command,
    )


def _cards(results: Results) -> list[Card]:
    def card(label: str, method: str, metric: str, length: int, compare: str) -> Card:
        row = results.find(method, mean_to(length), metric)
        if row is None:
            return Card(label, DASH, compare=compare)
        detail = f"{row.low:.3f}{DASH}{row.high:.3f}, {row.n} scenes"
        share = min(max(row.value, 0.0), 1.0)
        return Card(label, f"{row.value:.3f}", detail, compare, share, METHODS[method][0] == "control")

    return [
        card("Mask IoU, 9 frames", "ours", "iou", 9, "paper .573"),
        card("Mask IoU, 19 frames", "ours", "iou", 19, "paper .569"),
        card("Copy-Seed, 19 frames", "copy seed", "iou", 19, "paper .525"),
        card("Parser on true frames, 19", "true frames", "iou", 19, "paper .553; the ceiling"),
        card("Block and arm, 19 frames", "ours", "iou_moving", 19, "not in the paper"),
        card("Block and arm, Copy-Seed", "copy seed", "iou_moving", 19, "the floor"),
        card("Block and arm, wrong text", "wrong text", "iou_moving", 19, "should be low"),
        card("Foreground ARI, 19 frames", "ours", "foreground_ari", 19, "not in the paper"),
    ]


def _dots(results: Results) -> Figure:
    groups = {"9": 9, "19": 19, "24": 24}
    series = []
    for method in ("ours", "true frames", "OCVP-Seq", "copy seed", "wrong text"):
        found = [results.find(method, mean_to(length), "iou") for length in groups.values()]
        points = [(r.value, r.low, r.high) if r else None for r in found]
        if any(points):
            series.append(Series(method, points, color=HUES[method]))
    for method, values in PAPER.items():
        quoted = [*((value, value, value) for value in values), None]
        short = PAPER_NAMES[method].removeprefix("paper, ").removesuffix(" on true frames")
        series.append(Series(f"{short}, paper", quoted, hollow=True, color=HUES[method]))
    caption = (
        "Mean of the first 9, 19 and 24 predicted frames, 95 % intervals over scenes; rings are the paper's."
    )
    names = [f"{name} frames" for name in groups]
    return interval_plot("iou_dots.png", names, series, label="mask IoU", caption=caption)


def _curves(outcomes: Sequence[ObjectOutcome], field: str, label: str, name: str) -> Figure:
    curves = []
    for method in METHODS:
        films = [getattr(o.scores[method], field)[1:] for o in outcomes if method in o.scores]
        if films:
            # Frames in which no scene shows the thing cannot be drawn; there are none but in tiny tests.
            columns = [column for column in np.stack(films, axis=1) if not np.isnan(column).all()]
            intervals = [bootstrap_interval(column, resamples=500) for column in columns]
            curves.append((method, np.array([(i.value, i.low, i.high) for i in intervals])))
    caption = "Mean over scenes with its 95 % interval."
    hues = [HUES[method] for method, _ in curves]
    return curve_plot(name, curves, label=label, across="frame", caption=caption, colors=hues)
