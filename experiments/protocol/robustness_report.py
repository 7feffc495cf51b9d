"""The robustness study's tables and page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from experiments.protocol.contenders import NOTES, TRAINED_LITTLE, Absent, absent_text
from experiments.protocol.frame_scores import METRICS, Measures
from experiments.protocol.gallery import Picture
from experiments.protocol.paper import CLIPORT, PAPER_LENGTHS, PaperFigures
from experiments.protocol.robustness import LENGTHS, REFERENCE, REREAD, SHIFTED, SPLITS, WHOLE
from experiments.reporting import (
    Card,
    Cell,
    Clip,
    Clips,
    Figure,
    Report,
    Results,
    Row,
    Section,
    Table,
    TableRow,
)
from experiments.reporting.plots import Series, interval_plot
from experiments.reporting.table import DASH, Kind

FRAME_ROWS: dict[str, tuple[Kind, str]] = {
    "ours": ("ours", "TextOCVP: imagined from one frame and the sentence"),
    "OCVP-Seq": ("control", NOTES["OCVP-Seq"]),
    "Non-OC": ("control", NOTES["Non-OC"]),
    "MAGE": ("control", NOTES["MAGE"]),
    "true frames": ("ceiling", "parser and renderer on the true frames"),
    "wrong text": ("control", "ours, told something else about the scene"),
    "copy frame": ("control", "the first frame repeated"),
}
MASK_ROWS: dict[str, tuple[Kind, str]] = {
    "ours": FRAME_ROWS["ours"],
    REREAD: ("ours", "our parser reads the imagined frames, as it must for models without slots"),
    **{method: row for method, row in FRAME_ROWS.items() if method != "ours"},
    "expert": ("ceiling", "scripted, knows every pose"),
    "random candidate": ("control", "the same robot carries out a random instruction"),
}
ABSENT = "absent; the last section says why"


@dataclass(frozen=True)
class Bar:
    """What the study is held to. Reported, never tuned for.

    Attributes:
        name: of the headline figure. title: in words. split: the scenes.
        least: the least success; or None for a drop that must be smaller than MAGE's.
    """

    name: str
    title: str
    split: str
    least: float | None = None


BARS = (
    Bar("closed_loop_unseen_colors", "closed-loop success, unseen colours", "unseen_colors", 0.75),
    Bar("closed_loop_more_objects", "closed-loop success, 8 objects", "more_objects", 0.80),
    Bar("lpips_drop_unseen_colors", "{} drop at 9 frames, unseen colours", "unseen_colors"),
    Bar("lpips_drop_more_objects", "{} drop at 9 frames, 8 objects", "more_objects"),
)


def percent(share: float) -> str:
    """`6.4 %`; a minus sign for what got better."""
    return f"{round(100 * share, 1) + 0.0:.1f} %"  # + 0 turns a negative zero round


def percents(row: Row) -> str:
    """The interval of a share."""
    low, high = (round(100 * end) + 0 for end in (row.low, row.high))
    return f"{low} to {high} %"


def verdict(bar: Bar, results: Results) -> str:
    """`pass`, `miss`, or that it cannot be decided."""
    ours = results.headline.get(bar.name)
    if bar.least is not None:
        return "not measured" if ours is None else "pass" if ours >= bar.least else "miss"
    mage = results.headline.get(f"{bar.name}_mage")
    if ours is None or mage is None:
        return "undecided: " + ("no LPIPS" if ours is None else "no MAGE")
    return "pass" if ours < mage else "miss"


def doubt(bar: Bar, results: Results, measures: Measures) -> str:
    """That the interval allows the other verdict too; empty where it does not."""
    if bar.least is not None:
        row, edge = results.find("ours", WHOLE, "closed_loop_success", bar.split), bar.least
    else:
        metric = f"{measures.main}_drop_difference"
        row, edge = results.find("ours minus MAGE", f"{LENGTHS[0]} frames", metric, bar.split), 0.0
    return "within the interval" if row is not None and row.low < edge <= row.high else ""


def bars_table(results: Results, measures: Measures) -> Table:
    """Every bar, the figure that is held against it, and the verdict."""
    lines = []
    for bar in BARS:
        ours, mage = (results.headline.get(name) for name in (bar.name, f"{bar.name}_mage"))
        show = (lambda x: f"{x:.2f}") if bar.least is not None else percent
        wanted = f"at least {bar.least:.2f}" if bar.least is not None else (
            f"less than MAGE: {DASH if mage is None else percent(mage)}"
        )  # fmt: skip
        between = Cell("")
        if bar.least is None:
            row = results.find(
                "ours minus MAGE", f"{LENGTHS[0]} frames", f"{measures.main}_drop_difference", bar.split
            )
            between = Cell(DASH) if row is None else Cell(percent(row.value), percents(row), row.n)
        cells = [
            Cell(DASH if ours is None else show(ours)),
            Cell(wanted),
            between,
            Cell(verdict(bar, results), doubt(bar, results, measures)),
        ]
        lines.append(TableRow(bar.title.format(_main(measures)), cells, "ours"))
    caption = "The difference is taken scene by scene: which scenes are hard is most of what makes a drop uncertain."
    return Table("Bars", ("ours", "bar", "ours minus MAGE", "verdict"), lines, caption)


def frame_table(rows: Sequence[Row], split: str, absent: Sequence[Absent], measures: Measures) -> Table:
    """SSIM and LPIPS of one split with their drops, as in the paper's table."""
    wanted = [(metric, length) for length in LENGTHS for metric in ("ssim", measures.main)]
    drops = split != REFERENCE
    lines = []
    for method, (kind, note) in FRAME_ROWS.items():
        missing = any(one.method == method for one in absent)
        cells = _cells(rows, split, method, [(m, f"{n} frames") for m, n in wanted], drops)
        lines.append(TableRow(method, cells, kind, ABSENT if missing else note))
        if method == "MAGE":
            lines += [
                TableRow(row.method, _paper_cells(row, drops), "paper", "CLIPort at 336x336, LPIPS (AlexNet)")
                for row in CLIPORT[split]
            ]
    columns = []
    for metric, length in wanted:
        columns += [f"{METRICS[metric]} {length}", *(["drop"] if drops else [])]
    return Table(f"Frames, {SPLITS[split]}", columns, lines)


def mask_table(rows: Sequence[Row], split: str, absent: Sequence[Absent]) -> Table:
    """Mask IoU, predicted and closed-loop success of one split with their drops."""
    wanted = [("iou", f"{n} frames") for n in LENGTHS]
    wanted += [("predicted_success", WHOLE), ("closed_loop_success", WHOLE)]
    names = [*(f"IoU {n}" for n in LENGTHS), "predicted", "closed loop"]
    drops = split != REFERENCE
    lines = []
    for method, (kind, note) in MASK_ROWS.items():
        missing = any(one.method == method for one in absent)
        cells = _cells(rows, split, method, wanted, drops)
        lines.append(TableRow(method, cells, kind, ABSENT if missing else note))
    columns = [column for name in names for column in ([name, "drop"] if drops else [name])]
    return Table(f"Masks and goals, {SPLITS[split]}", columns, lines)


def _cells(
    rows: Sequence[Row], split: str, method: str, wanted: Sequence[tuple[str, str]], drops: bool
) -> list[Cell]:
    found = {(r.method, r.variant, r.metric): r for r in rows if r.split == split}
    cells = []
    for metric, variant in wanted:
        cells.append(Cell.of(found.get((method, variant, metric)), 2 if metric.endswith("success") else 3))
        if drops:
            row = found.get((method, variant, f"{metric}_drop"))
            cells.append(Cell(DASH) if row is None else Cell(percent(row.value), percents(row), row.n))
    return cells


def _paper_cells(row: PaperFigures, drops: bool) -> list[Cell]:
    cells = []
    for i in range(len(PAPER_LENGTHS)):
        for value, drop in ((row.ssim[i], row.ssim_drop[i]), (row.lpips[i], row.lpips_drop[i])):
            cells.append(Cell(f"{value:.3f}"))
            if drops:
                cells.append(Cell(DASH if drop is None else percent(drop)))
    return cells


def build_report(
    results: Results,
    absent: Sequence[Absent],
    measures: Measures,
    best: Sequence[Clip],
    worst: Sequence[Clip],
    acted: Sequence[Picture],
    command: str,
) -> Report:
    """The page."""
    rows = results.rows
    name = _main(measures)
    bars = Section(
        "The bars",
        "Fixed before anything was measured, and reported whichever way it went. A drop is how much worse a figure is "
        f"than on the test set, relative to it; for {name}, how much it grows. {TRAINED_LITTLE}",
        [bars_table(results, measures), _drop_plot(rows, measures), _loop_plot(rows)],
    )
    texts = {
        "test": "Six objects, caption colours that were seen in training: what everything else is held against.",
        "unseen_colors": "Six objects. Captions name CLIPort's test colours, four of which no training sentence had: "
        "pink, purple, white and orange.",
        "more_objects": "Eight objects; training had six.",
    }
    layout = (
        " Above: frames, in the layout of the paper's table, with its own figures, whose order compares with ours and "
        "whose height does not. Below: masks against the simulator's, whether they show what the sentence says, and "
        "whether a robot that plans with them reaches the goal."
    )
    splits = [
        Section(
            SPLITS[split].capitalize(),
            text + (layout if split == SHIFTED[0] else ""),
            [frame_table(rows, split, absent, measures), mask_table(rows, split, absent)],
        )
        for split, text in texts.items()
    ]
    ranked = f"Both kinds of scenes, by whether ours shows what was asked, then by its {name} at {LENGTHS[-1]} frames."
    galleries = [
        Section(title, text, [Clips(clips)])
        for title, text, clips in (
            ("The best cases", f"{ranked} Below the pictures: masks, one colour a thing.", best),
            ("The worst cases", ranked, worst),
        )
    ]
    robot = Section(
        "Planned beside executed",
        "Failures where there are any. Left: each chosen plan, imagined. Right: the camera.",
        [Clips([picture.clip for picture in acted])],
    )
    missing = " ".join(part for part in (absent_text(absent), measures.absent) if part) or "Nothing."
    return Report(
        title="Robustness",
        question="Colours that no training sentence named, and two objects more than ever before: what is lost?",
        results=results,
        cards=_cards(results, measures),
        sections=[bars, *splits, *galleries, robot, Section("What is absent", missing)],
        command=command,
    )


def _main(measures: Measures) -> str:
    return METRICS[measures.main]


def _cards(results: Results, measures: Measures) -> list[Card]:
    cards = []
    for split in SPLITS:
        row = results.find("ours", WHOLE, "closed_loop_success", split)
        bar = next((bar for bar in BARS if bar.name == f"closed_loop_{split}"), None)
        compare = f"bar {bar.least:.2f}: {verdict(bar, results)}" if bar is not None and bar.least else ""
        label = f"Closed loop, {SPLITS[split]}"
        if row is None:
            cards.append(Card(label, DASH, compare=compare))
        else:
            detail = f"{row.low:.2f}{DASH}{row.high:.2f}, {row.n} scenes"
            cards.append(Card(label, f"{row.value:.2f}", detail, compare, row.value))
    for split in SHIFTED:
        row = results.find("ours", f"{LENGTHS[0]} frames", f"{measures.main}_drop", split)
        mage = results.find("MAGE", f"{LENGTHS[0]} frames", f"{measures.main}_drop", split)
        label = f"{_main(measures)} drop at {LENGTHS[0]} frames, {SPLITS[split]}"
        paper = CLIPORT[split][1].lpips_drop[0]
        compare = f"MAGE {DASH if mage is None else percent(mage.value)}"
        compare += f", paper {percent(paper)} (LPIPS)" if paper is not None else ""
        if row is None:
            cards.append(Card(label, DASH, compare=compare))
        else:
            detail = f"{percents(row)}, {row.n} scenes"
            cards.append(Card(label, percent(row.value), detail, compare))
    row = results.find("random candidate", WHOLE, "closed_loop_success", SHIFTED[0])
    if row is not None:
        label = f"Closed loop, random candidate, {SPLITS[SHIFTED[0]]}"
        cards.append(Card(label, f"{row.value:.2f}", f"{row.n} scenes", "the floor", row.value, control=True))
    return cards


def _drop_plot(rows: Sequence[Row], measures: Measures) -> Figure:
    metric, variant = f"{measures.main}_drop", f"{LENGTHS[0]} frames"
    found = {
        (r.method, r.split): (100 * r.value, 100 * r.low, 100 * r.high)
        for r in rows
        if (r.metric, r.variant) == (metric, variant)
    }
    series = [
        Series(method, [found.get((method, split)) for split in SHIFTED], color=color)
        for color, method in enumerate(("ours", "Non-OC", "copy frame", "MAGE", "true frames"))
        if any((method, split) in found for split in SHIFTED)
    ]
    for i, color in ((1, 0), (0, 3)):
        drops = [CLIPORT[split][i].lpips_drop[0] for split in SHIFTED]
        points = [None if d is None else (100 * d, 100 * d, 100 * d) for d in drops]
        series.append(Series(CLIPORT[REFERENCE][i].method, points, hollow=True, color=color))
    return interval_plot(
        "drops.png",
        [SPLITS[split] for split in SHIFTED],
        series,
        label=f"{_main(measures)} drop at {LENGTHS[0]} frames, %",
        limits=None,
        caption="Dots with 95 % intervals over scenes; rings are the paper's figures (LPIPS, CLIPort).",
    )


def _loop_plot(rows: Sequence[Row]) -> Figure:
    found = {(r.method, r.split): (r.value, r.low, r.high) for r in rows if r.metric == "closed_loop_success"}
    series = [
        Series(method, [found.get((method, split)) for split in SPLITS], color=color)
        for method, color in (("ours", 0), ("expert", 1), ("random candidate", 2))
    ]
    caption = "Dots with 95 % intervals over scenes, judged by the simulator."
    return interval_plot(
        "closed_loop.png", list(SPLITS.values()), series, label="closed-loop success", caption=caption
    )
