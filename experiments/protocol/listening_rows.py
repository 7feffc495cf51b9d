"""From scenes in which slots listened to figures with intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from envs.colors import SEEN
from experiments.protocol.figures import mean_row, rate_row
from experiments.protocol.listening import COLOR_WORDS, ROLES, Heard
from experiments.protocol.listening_scenes import ListeningOutcome
from experiments.protocol.words import spoken
from experiments.reporting import Row

#: Column of the tables -> (split, variant in results.json).
COLUMNS = {
    "test": ("test", "original"),
    "4 bowls, original": ("controllability", "original"),
    "4 bowls, other bowls": ("controllability", "variants mean"),
    "unseen colours": ("unseen_colors", "original"),
    "new names": ("unseen_colors", "new names"),
}
OURS, LOOKS, SILENT, COLORS = "ours", "ours, by looks", "colour term off", "colour term alone"
WRONG, CHANCE = "wrong sentence", "chance"
METHODS = (OURS, LOOKS, SILENT, COLORS, WRONG, CHANCE)
ENDS = "ends_in_bowl"


def attends(role: str) -> str:
    """The `metric` of a role."""
    return f"attends_{role}"


def head_method(method: str, layer: int, head: int) -> str:
    """The `method` of a single head; layers and heads count from 1."""
    return f"{method}, layer {layer + 1} head {head + 1}"


@dataclass(frozen=True)
class _Part:
    """Some outcomes, and which of their texts are looked at."""

    split: str
    variant: str
    outcomes: Sequence[ListeningOutcome]
    texts: slice

    def naming(self, *roles: int) -> Sequence[ListeningOutcome]:
        """The outcomes that count for these roles: for new names, those in which one of their colours is new."""
        if self.variant != "new names":
            return self.outcomes
        words = [COLOR_WORDS[r] for r in roles]
        return [o for o in self.outcomes if any(spoken(o.texts[0])[word] not in SEEN for word in words)]


def _parts(outcomes: Sequence[ListeningOutcome]) -> list[_Part]:
    parts = []
    for split, variant in COLUMNS.values():
        here = [outcome for outcome in outcomes if outcome.scene.split == split]
        texts = slice(1, None) if variant == "variants mean" else slice(0, 1)
        if here and len(here[0].texts[texts]):
            parts.append(_Part(split, variant, here, texts))
    return parts


def listening_rows(outcomes: Sequence[ListeningOutcome]) -> list[Row]:
    """How often the named things attend most to their colour words, for every method and column."""
    rows = []
    for part in _parts(outcomes):
        for r, role in enumerate(ROLES):
            rows += _role_rows(part, r, attends(role))
        rows += _ends_rows(part)
    return rows


def _role_rows(part: _Part, r: int, metric: str) -> list[Row]:
    def rate(method: str, success: Callable[[ListeningOutcome], object]) -> Row:
        return rate_row(method, part.split, part.variant, metric, [success(o) for o in outcomes])

    outcomes, texts = part.naming(r), part.texts
    if not outcomes:
        return []
    rows = [
        rate(OURS, lambda o: [h.most_R[r] for h in o.heard[texts]]),
        rate(LOOKS, lambda o: o.by_looks_VR[texts, r]),
    ]
    first = outcomes[0]
    if first.silent:
        rows.append(rate(SILENT, lambda o: [h.most_R[r] for h in o.silent[texts]]))
    if first.colors_VR is not None:
        rows.append(rate(COLORS, lambda o: o.colors_VR[texts, r]))  # type: ignore[index]
    told = [o.wrong_R[r] for o in outcomes if not np.isnan(o.wrong_R[r])]
    if told and part.variant != "variants mean":
        rows.append(rate_row(WRONG, part.split, part.variant, metric, told))
    chance = [np.mean([h.chance_R[r] for h in o.heard[texts]]) for o in outcomes]
    rows.append(mean_row(CHANCE, part.split, part.variant, metric, chance))
    leads = [[h.margin_R[r] for h in o.heard[texts]] for o in outcomes]
    known = [np.nanmean(lead) for lead in leads if not np.isnan(lead).all()]
    if known:
        rows.append(mean_row(OURS, part.split, part.variant, metric.replace("attends", "lead"), known))
    return rows


def _ends_rows(part: _Part) -> list[Row]:
    """Whether the block's slot ends in the bowl."""

    def rate(method: str, success: Callable[[ListeningOutcome], object]) -> Row:
        return rate_row(method, part.split, part.variant, ENDS, [success(o) for o in outcomes])

    outcomes = part.naming(*range(len(ROLES)))
    if not outcomes:
        return []
    rows = [rate(OURS, lambda o: [h.ends_in_bowl for h in o.heard[part.texts]])]
    if outcomes[0].silent:
        rows.append(rate(SILENT, lambda o: [h.ends_in_bowl for h in o.silent[part.texts]]))
    if part.variant != "variants mean":
        rows.append(rate(WRONG, lambda o: o.wrong_ends))
    return rows


def head_rows(outcomes: Sequence[ListeningOutcome], split: str) -> list[Row]:
    """The same for each layer and head by itself, over all texts of the scenes of a split."""
    here = [outcome for outcome in outcomes if outcome.scene.split == split]
    rows: list[Row] = []
    for method in (OURS, SILENT):
        if not here or not _heard(here[0], method):
            continue
        layers, heads = _heard(here[0], method)[0].most_Rnh.shape[1:]
        for r, role in enumerate(ROLES):
            for n in range(layers):
                for h in range(heads):
                    most = [[one.most_Rnh[r, n, h] for one in _heard(o, method)] for o in here]
                    rows.append(rate_row(head_method(method, n, h), split, "all", attends(role), most))
    return rows


def _heard(outcome: ListeningOutcome, method: str) -> tuple[Heard, ...]:
    return outcome.heard if method == OURS else outcome.silent


def headline(rows: Sequence[Row]) -> dict[str, float]:
    """The figures that are asked for by name; those of the colour term only where the model has one."""
    found = {(row.method, row.split, row.variant, row.metric): row.value for row in rows}
    named = {}
    for role in (*ROLES, "ends_in_bowl"):
        metric = attends(role) if role in ROLES else ENDS
        for method, name in (
            (OURS, ""),
            (SILENT, "_colour_term_off"),
            (WRONG, "_wrong_sentence"),
            (CHANCE, "_chance"),
        ):
            for split, variant in COLUMNS.values():
                value = found.get((method, split, variant, metric))
                if value is not None and (
                    method == OURS or (split, variant) == ("controllability", "original")
                ):
                    part = {"original": "", "variants mean": "_variants", "new names": "_new_names"}[variant]
                    where = "" if method != OURS else f"_{split}{part}"
                    named[f"{metric}{name}{where}"] = round(value, 4)
    return named
