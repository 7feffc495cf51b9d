"""Plans as the page shows them: the search as a tree of imagined ends, and what is wrong with the obvious plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planning import Foresees, Goal, Instruction, PictureGoal, Plan, Thing, places, seen_supports
from planning.grounding import Grounding
from textocvp import Rollout
from textocvp.film_page import picture_url

BRANCHES = 12  # sequences of sentences that the tree shows

Said = tuple[Instruction, ...]  # one after another


def plan_data(world_model: Foresees, rgb: np.ndarray, goal: Goal | PictureGoal, plan: Plan) -> dict[str, Any]:
    """A plan that was made from a picture (H, W, 3), without its films; all of it can be written as JSON."""
    shown = [one.instructions for one in plan.ranking[:BRANCHES]]
    known = {one.instructions: one for one in plan.ranking}
    best = plan.best.instructions
    ends = sorted(imagined_ends(world_model, rgb, shown).items(), key=lambda end: _order(end[0], shown))
    tree = []
    for path, (frame, _) in ends:
        tree.append(
            {
                "text": path[-1].text,
                "depth": len(path),
                "picture": picture_url(frame),
                "away": round(-known[path].score, 1) if path in known else None,
                "reaches": path in known and known[path].reaches_goal,
                "chosen": path == best[: len(path)],
            }
        )
    return {
        "goal_picture": picture_url(goal.rgb) if isinstance(goal, PictureGoal) else None,
        "sentences": [one.text for one in best],
        "reaches": plan.best.reaches_goal,
        "seconds": round(plan.seconds, 1),
        "tree": tree,
        "obvious": None if isinstance(goal, PictureGoal) else _obvious(world_model, rgb, goal, plan.grounding),
    }


def imagined_ends(
    world_model: Foresees, rgb: np.ndarray, paths: Sequence[Said]
) -> dict[Said, tuple[np.ndarray, Rollout]]:
    """Where sequences of sentences, and all their beginnings, are imagined to lead: a picture and the slots."""
    level: dict[Said, Rollout] = {(): world_model.parse(rgb[None])}
    ends: dict[Said, tuple[np.ndarray, Rollout]] = {}
    for depth in range(1, 1 + max(map(len, paths))):
        wanted = list(dict.fromkeys(path[:depth] for path in paths if len(path) >= depth))
        imagined: dict[Said, Rollout] = {}
        for before, start in level.items():
            if after := [path for path in wanted if path[:-1] == before]:
                batch = world_model.outcome(start, [path[-1].text for path in after])
                imagined |= {path: batch.select(row).last for row, path in enumerate(after)}
        for path, one in imagined.items():
            frame_HW3 = one.decode_frames([0])[0, 0].permute(1, 2, 0)
            ends[path] = (frame_HW3.mul(255).round().byte().cpu().numpy(), one)
        level = imagined
    return ends


def _obvious(world_model: Foresees, rgb: np.ndarray, goal: Goal, grounding: Grounding) -> dict[str, Any]:
    """The goal's own sentences, one after another: where they are imagined to lead, and what is wrong with that."""
    asked, things = goal.instructions, sorted(grounding.things)
    frame, end = imagined_ends(world_model, rgb, [asked])[asked]
    carriers = seen_supports(places(end, grounding, things), things, grounding.view)[0]
    wrong = [
        f"the {one.thing} is imagined to end {_where(carriers[one.thing])}, not {one.relation} the {one.target}"
        for one in asked
        if carriers[one.thing] != one.target
    ]
    return {"sentences": [one.text for one in asked], "picture": picture_url(frame), "wrong": wrong}


def _order(path: Said, shown: Sequence[Said]) -> tuple[int, ...]:
    """So that a tree is written from its root, best branches first."""
    beginnings = (path[:k] for k in range(1, len(path) + 1))
    return tuple(min(n for n, one in enumerate(shown) if one[: len(part)] == part) for part in beginnings)


def _where(carrier: Thing | None) -> str:
    return "on the table" if carrier is None else f"{'in' if carrier.kind == 'bowl' else 'on'} the {carrier}"
