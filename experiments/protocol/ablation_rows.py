"""From the ablation study's outcomes to rows with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from experiments.protocol.ablation_runs import RUNS
from experiments.protocol.ablation_scenes import ENDS, LENGTH, FollowingOutcome, Parsed, ParsingOutcome
from experiments.protocol.closed_loop import LoopOutcome
from experiments.protocol.figures import mean_row, rate_row
from experiments.reporting import Row

SHIPPED = "shipped"
SLOT_COUNTS = (8, 10, 12, 14, 16)
PICTURES = f"{LENGTH} frames"


def slots_name(count: int) -> str:
    """The method that is the shipped model with so many slots."""
    return f"{SHIPPED}, {count} slots"


def following_rows(outcomes: Sequence[FollowingOutcome]) -> list[Row]:
    """Success and likeness of every model on every split, as far as there are outcomes."""
    rows = []
    for split, method, here in _groups(outcomes):
        found = [outcome.models[method] for outcome in here]
        for metric, name in ((ENDS, "ends_V"), ("predicted_success", "success_V")):
            values = [getattr(one, name) for one in found]
            rows.append(rate_row(method, split, "original", metric, [v[0] for v in values]))
            if len(values[0]) > 1:
                rows.append(rate_row(method, split, "variants mean", metric, [v[1:] for v in values]))
        if len(found[0].wrong_V):
            rows.append(rate_row(method, split, "wrong text", ENDS, [one.wrong_V for one in found]))
        for metric in found[0].pictures:
            rows.append(mean_row(method, split, PICTURES, metric, [f.pictures[metric] for f in found]))
    return rows


def acted_rows(outcomes: Sequence[tuple[str, LoopOutcome]]) -> list[Row]:
    """Success in the closed loop of a robot that plans with each model, and of those that plan with none."""
    rows = []
    for method in dict.fromkeys(name for name, _ in outcomes):
        here = [outcome.success for name, outcome in outcomes if name == method]
        rows.append(rate_row(method, "controllability", "original", "closed_loop_success", here))
    return rows


def parsing_rows(outcomes: Sequence[ParsingOutcome]) -> list[Row]:
    """How well every parser takes episodes apart, on every split."""
    return [
        mean_row(
            method,
            split,
            "true frames",
            metric.name,
            [getattr(outcome.models[method], metric.name) for outcome in here],
        )
        for split, method, here in _groups(outcomes)
        for metric in fields(Parsed)
    ]


def _groups(outcomes: Sequence) -> list[tuple[str, str, list]]:
    """(split, method, the outcomes that have it), in the order of appearance."""
    pairs = dict.fromkeys((o.scene.split, method) for o in outcomes for method in o.models)
    return [
        (split, method, [o for o in outcomes if o.scene.split == split and method in o.models])
        for split, method in pairs
    ]


def headline(rows: Sequence[Row]) -> dict[str, float]:
    """Following of every predictor, overlap of every parser and slot count, as far as they were measured."""
    found = {(row.method, row.split, row.variant, row.metric): row.value for row in rows}
    wanted: dict[str, tuple[str, str, str, str]] = {}
    for name in (SHIPPED, *(run.name for run in RUNS)):
        word = name.replace("-", "_")
        place = (name, "controllability")
        wanted[f"{word}_original_strict"] = (*place, "original", "predicted_success")
        wanted[f"{word}_original"] = (*place, "original", ENDS)
        wanted[f"{word}_variants_mean"] = (*place, "variants mean", ENDS)
        wanted[f"{word}_wrong_text"] = (*place, "wrong text", ENDS)
        wanted[f"{word}_unseen_colors"] = (name, "unseen_colors", "original", ENDS)
        wanted[f"{word}_closed_loop"] = (*place, "original", "closed_loop_success")
        wanted[f"{word}_miou"] = (name, "test", "true frames", "miou")
    for count in SLOT_COUNTS:
        for split, words in (("test", "6_objects"), ("more_objects", "8_objects")):
            place = (slots_name(count), split)
            wanted[f"slots_{count}_{words}_miou"] = (*place, "true frames", "miou")
            wanted[f"slots_{count}_{words}_original"] = (*place, "original", "predicted_success")
    return {name: round(found[key], 4) for name, key in wanted.items() if key in found}
