"""The prediction study's tables and page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.protocol.contenders import FAR, NOTES, TRAINED_LITTLE, Absent, Contender, absent_text
from experiments.protocol.frame_scores import BOTTOM_ROWS, METRICS, PSNR_CAP, UPPER, Measures
from experiments.protocol.paper import CLIPORT, PAPER_LENGTHS, PaperFigures
from experiments.protocol.prediction import FARTHEST, LENGTHS, SPLIT
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
from experiments.reporting.plots import Series, curve_plot, interval_plot
from experiments.reporting.table import DASH, Kind

LABELS = {"ours": "TextOCVP, ours"}
ROWS: dict[str, tuple[Kind, str]] = {
    "ours": ("ours", "imagined from one frame and the sentence"),
    FAR.method: ("ours", NOTES[FAR.method]),
    "OCVP-Seq": ("control", NOTES["OCVP-Seq"]),
    "Non-OC": ("control", NOTES["Non-OC"]),
    "MAGE": ("control", NOTES["MAGE"]),
    "true frames": ("ceiling", "parser and renderer on the true frames: what drawing alone costs"),
    "wrong text": ("control", "ours, told something else about the scene"),
    "copy frame": ("control", "the first frame repeated"),
}
SEER = "not run: 406 M parameters, fine-tuned from weights that cannot be rebuilt here"
ABSENT = "absent; the last section says why"
#: Digits in tables.
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "st_lpips": 3, "jedi": 2}
NAMES = {**METRICS, "jedi": "JEDi"}
EPISODE = LENGTHS[-1]


def _cells(rows: Sequence[Row], method: str, wanted: Sequence[tuple[str, int]], ending: str) -> list[Cell]:
    found = {(r.method, r.variant, r.metric): r for r in rows if r.split == SPLIT}
    return [
        Cell.of(found.get((method, f"{length} frames", metric + ending)), DIGITS[metric])
        for metric, length in wanted
    ]


def _table(
    title: str,
    rows: Sequence[Row],
    absent: Sequence[Absent],
    wanted: Sequence[tuple[str, int]],
    *,
    ending: str = "",
    caption: str = "",
    paper: bool = False,
) -> Table:
    """A table of (metric, length) columns, a line for everybody, absent ones with dashes and the reason."""
    missing = {one.method for one in absent}
    lines = []
    for method, (kind, note) in ROWS.items():
        cells = _cells(rows, method, wanted, ending)
        label = LABELS.get(method, method)
        lines.append(TableRow(label, cells, kind, ABSENT if method in missing else note))
        if method == "MAGE" and paper:
            lines.append(TableRow("SEER", [Cell(DASH)] * len(wanted), "control", SEER))
            lines += [
                TableRow(row.method, [_paper_cell(row, *column) for column in wanted], "paper",
                         "CLIPort at 336x336, another camera")
                for row in CLIPORT[SPLIT]
            ]  # fmt: skip
    columns = [f"{NAMES[metric]} {length}" for metric, length in wanted]
    return Table(title, columns, lines, caption)


def _paper_cell(row: PaperFigures, metric: str, length: int) -> Cell:
    values = {"ssim": row.ssim, "lpips": row.lpips, "jedi": row.jedi}.get(metric)
    value = None if values is None else values[PAPER_LENGTHS.index(length)]
    return Cell(DASH if value is None else f"{value:.{DIGITS[metric]}f}")


def paper_table(rows: Sequence[Row], absent: Sequence[Absent]) -> Table:
    """SSIM, LPIPS and JEDi at 9 and 19 frames, as in the paper's table, with ST-LPIPS between."""
    wanted = [(m, n) for n in PAPER_LENGTHS for m in ("ssim", "lpips", "st_lpips", "jedi")]
    caption = (
        "Means over the first 9 and the first 19 imagined frames. SSIM: higher is better; the others: lower."
    )
    return _table(f"{PAPER_LENGTHS[0]} and {PAPER_LENGTHS[1]} frames", rows, absent, wanted,
                  caption=caption, paper=True)  # fmt: skip


def episode_table(rows: Sequence[Row], absent: Sequence[Absent]) -> Table:
    """Whole episodes, and PSNR everywhere."""
    wanted = [("psnr", n) for n in LENGTHS] + [(m, EPISODE) for m in ("ssim", "lpips", "st_lpips", "jedi")]
    caption = (
        f"PSNR in dB, higher is better, averaged frame by frame; equal frames count as {PSNR_CAP:g} dB. "
        f"An episode has {EPISODE} frames after the first."
    )
    return _table("Whole episodes, and PSNR", rows, absent, wanted, caption=caption)


def upper_table(rows: Sequence[Row], absent: Sequence[Absent], measures: Measures) -> Table:
    """The second view: without the bottom rows."""
    wanted = [(m, n) for n in LENGTHS for m in ("ssim", *measures.perceptual)]
    return _table("Without the bottom rows", rows, absent, wanted, ending=UPPER)


def build_report(
    results: Results,
    contenders: Sequence[Contender],
    absent: Sequence[Absent],
    measures: Measures,
    best: Sequence[Clip],
    worst: Sequence[Clip],
    command: str,
) -> Report:
    """The page."""
    rows = results.rows
    missing = " ".join(
        part for part in (absent_text(absent), measures.absent, f"SEER is absent: {SEER}.") if part
    )
    table = Section(
        "As in the paper's table",
        "Every model sees the first frame of a held-out scene and the sentence, and imagines; the expert carries the "
        "sentence out in the simulator; frames are compared one by one. The paper's figures come from other pictures: "
        "compare orders and distances, not heights. "
        f"{TRAINED_LITTLE} What a dash stands for is said in the last section.",
        [paper_table(rows, absent), _main_plot(rows, measures), episode_table(rows, absent)],
    )
    curves = Section(
        "Over time",
        f"Curves go to {FARTHEST} frames for models that can look as far. An episode is over after {EPISODE}; from "
        "then on the real film is its last frame, in which the arm rests: in the simulator, frames after the end "
        "differ from it by less than .2 of 255 grey levels in the mean. " + _horizons(rows),
        [_curve(rows, metric) for metric in measures.metrics],
    )
    upper = Section(
        "Without the bottom rows",
        f"The same without the lowest {BOTTOM_ROWS} rows of pixels. The robot stands beyond the upper edge of the "
        "picture and hardly ever reaches down there, so these rows are mostly still table, which anybody gets right.",
        [upper_table(rows, absent, measures)],
    )
    name = NAMES[measures.main]
    gallery = [
        Section(
            title,
            f"By {name} of ours over the whole episode. Below the pictures: the slots' masks beside the simulator's "
            "segmentation, one colour a thing; for models without slots, what our parser sees in their frames.",
            [Clips(clips)],
        )
        for title, clips in (("The best cases", best), ("The worst cases", worst))
    ]
    who = Section("Who was measured, and what is absent", missing, [_models(results, contenders)])
    return Report(
        title="Prediction quality",
        question="One frame and a sentence: how much do the imagined frames look like what then happens?",
        results=results,
        cards=_cards(results, measures),
        sections=[table, curves, upper, *gallery, who],
        command=command,
    )


def _horizons(rows: Sequence[Row]) -> str:
    """Who looks less far than the curves go."""
    short = []
    for method in ROWS:
        frames = [int(r.variant.split()[1]) for r in rows if r.method == method and r.variant[:6] == "frame "]
        if frames and max(frames) < FARTHEST:
            short.append(f"{LABELS.get(method, method)} {max(frames)}")
    return f"Trained for fewer frames, and drawn so far: {'; '.join(short)}." if short else ""


def _models(results: Results, contenders: Sequence[Contender]) -> Table:
    def line(label: str, name: str, sha: str, longest: int | None, note: str, kind: Kind) -> TableRow:
        far = "any" if longest is None else str(longest)
        return TableRow(label, [Cell(name), Cell(far), Cell(sha[:12] or DASH)], kind, note)

    ours = [r for r in results.rows if r.method == "ours" and r.variant.startswith("frame ")]
    frames = max(int(r.variant.split()[1]) for r in ours)
    longest = None if frames == FARTHEST else frames
    where = results.checkpoint
    lines = [line(LABELS["ours"], where.name, where.sha256, longest, "slots and text", "ours")]
    lines += [
        line(one.method, one.checkpoint, one.sha256, one.longest, NOTES[one.method], ROWS[one.method][0])
        for one in contenders
    ]
    return Table("Models", ("checkpoint", "frames at once", "SHA-256"), lines)


def _points(
    rows: Sequence[Row], method: str, metric: str, columns: Sequence[str]
) -> list[tuple[float, float, float] | None]:
    found = {(r.method, r.variant): (r.value, r.low, r.high) for r in rows if r.metric == metric}
    return [found.get((method, column)) for column in columns]


def _main_plot(rows: Sequence[Row], measures: Measures) -> Figure:
    columns = [f"{length} frames" for length in LENGTHS]
    measured = {row.method for row in rows}
    series = [
        Series(LABELS.get(method, method), _points(rows, method, measures.main, columns), color=color)
        for color, method in enumerate(ROWS)
        if method in measured
    ]
    better = "higher" if measures.main == "ssim" else "lower"
    return interval_plot("lengths.png", columns, series, label=f"{NAMES[measures.main]}, {better} is better",
                         limits=None, caption="Dots with 95 % intervals over scenes.")  # fmt: skip


def _curve(rows: Sequence[Row], metric: str) -> Figure:
    curves, colors = [], []
    for color, method in enumerate(ROWS):
        mine = [r for r in rows if (r.method, r.metric) == (method, metric) and r.variant[:6] == "frame "]
        mine.sort(key=lambda r: int(r.variant.split()[1]))
        if mine:
            curve = np.array([(r.value, r.low, r.high) for r in mine])
            curves.append((LABELS.get(method, method), curve))
            colors.append(color)
    better = "higher" if metric in ("psnr", "ssim") else "lower"
    unit = " in dB" if metric == "psnr" else ""
    return curve_plot(f"{metric}.png", curves, label=f"{NAMES[metric]}{unit}", across="frame", colors=colors,
                      caption=f"{NAMES[metric]}: {better} is better. Bands: 95 % intervals over scenes.")  # fmt: skip


def _cards(results: Results, measures: Measures) -> list[Card]:
    def card(method: str, metric: str, length: int, compare: str = "") -> Card:
        row = results.find(method, f"{length} frames", metric)
        label = f"{NAMES[metric]}, {length} frames, {LABELS.get(method, method)}"
        if row is None:
            return Card(label, DASH, compare=compare)
        digits = DIGITS[metric]
        detail = f"{row.low:.{digits}f}{DASH}{row.high:.{digits}f}, {row.n} scenes"
        return Card(label, f"{row.value:.{digits}f}", detail, compare, control=method != "ours")

    def against(metric: str, length: int) -> str:
        found = [(m, results.find(m, f"{length} frames", metric)) for m in ("MAGE", "copy frame")]
        return ", ".join(f"{m} {row.value:.{DIGITS[metric]}f}" for m, row in found if row is not None)

    wanted = [(metric, length) for length in LENGTHS for metric in ("ssim", *measures.perceptual[-1:])]
    cards = [card("ours", metric, length, against(metric, length)) for metric, length in wanted]
    cards += [card(m, measures.main, EPISODE) for m in ("true frames", "wrong text")]
    return cards
