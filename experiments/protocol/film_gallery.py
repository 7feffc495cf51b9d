"""Clips of imagined films beside the real one: pictures above masks, one colour a thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from experiments.protocol.contenders import Contender
from experiments.protocol.films import as_pictures, film, slots_of
from experiments.protocol.scenes import TestScene
from experiments.protocol.workers import Worker
from experiments.reporting import Clip
from experiments.reporting.clips import gif, paint, segmentation_colors, slot_colors

#: An episode of the tabletop.
LENGTH = 24
T = TypeVar("T")


@dataclass(frozen=True)
class FilmPicture:
    """A unit of work: draw one scene, imagined by ours and the baselines.

    Attributes:
        scene: which. contenders: the baselines. seed: of the slots.
        group: first part of the file's name.
        rank, best: its place among the best or the worst.
        caption: what it was ranked by.
        good: whether that is good in itself; None where only the rank is known.
    """

    scene: TestScene
    contenders: tuple[Contender, ...]
    seed: int
    group: str
    rank: int
    best: bool
    caption: str
    good: bool | None = None

    def run(self, worker: Worker) -> Clip:
        """Imagine and play it once more."""
        happened, films = film(
            worker, self.scene, self.contenders, horizon=LENGTH, seed=self.seed, controls=False
        )
        info = happened.drawn.info
        objects = len(info["objects"])
        masks = [paint(happened.segmentations, segmentation_colors(objects))]
        for one in films:
            rollout = slots_of(worker, one, self.seed)
            labels_THW = rollout.masks[0].argmax(1).cpu().numpy()
            colors = slot_colors(labels_THW[0], info["segmentation"], rollout.slots.shape[2], objects)
            masks.append(paint(labels_THW, colors))
        kind = "best" if self.best else "worst"
        tone = "plain" if self.good is None else "good" if self.good else "bad"
        # Drawn frames of many models are noisy and do not pack well; the page enlarges them itself.
        scale = 2 if len(films) < 3 else 1
        return Clip(
            name=f"{self.group}-{kind}-{self.rank}.gif",
            gif=gif([[happened.frames, *(as_pictures(one.frames) for one in films)], masks], scale=scale),
            panels=("real", *(one.method for one in films)),
            title=happened.text,
            caption=f"{self.caption}; seed {self.scene.seed}",
            badge=f"{kind} {self.rank}",
            tone=tone,  # type: ignore[arg-type]
        )


def halves(clips: Sequence[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Clips of the best cases and of the worst ones, of both as `extremes` chose them, one after the other."""
    best = (len(clips) + 1) // 2
    return list(clips[:best]), list(clips[best:])


def extremes(cases: Sequence[T], badness: Sequence[float], count: int) -> tuple[list[T], list[T]]:
    """The `count` best cases and the `count` worst ones, most extreme first; no case is both. Of an odd number of cases
    too few for all, the best have one more.
    """
    order = [int(i) for i in np.argsort(np.asarray(badness), kind="stable")]
    worst = min(count, len(cases) // 2)
    best = min(count, len(cases) - worst)
    return [cases[i] for i in order[:best]], [cases[i] for i in reversed(order[len(order) - worst :])]
