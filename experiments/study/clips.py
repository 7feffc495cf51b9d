"""Clips for a report: imagined beside real, the best cases and the worst ones."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from experiments.report.gif import gif, paint, segmentation_colors, slot_colors
from experiments.report.page import Clip, Tone
from experiments.study.any_size import Film
from experiments.study.closed_loop import LoopEpisode, LoopOutcome
from experiments.study.methods import HORIZON, Model
from experiments.study.pool import Worker
from experiments.study.predictions import predict, slots_of, to_uint8
from experiments.study.scenes import StudyScene, sample_scene
from textocvp.metrics import slot_labels


@dataclass(frozen=True)
class PredictionClip:
    """A unit of work: one scene, real and imagined by ours and other models; pictures above masks."""

    scene: StudyScene  # which
    models: tuple[Model, ...]  # the others
    seed: int  # of the slots
    group: str  # first part of the file's name
    caption: str  # what it was ranked by
    good: bool | None = None  # whether that is good in itself; None where only the rank is known
    variant: int = 0  # which of the scene's instructions
    variants: int = 0  # how many it has beside its own
    best: bool = True  # whether it is among the best or the worst
    rank: int = 1  # its place among those

    @property
    def place(self) -> str:
        """As `best 1`."""
        return f"{'best' if self.best else 'worst'} {self.rank}"

    def run(self, worker: Worker) -> Clip:
        """Imagine and play it once more."""
        truth, predictions = predict(
            worker, self.scene, self.models, horizon=HORIZON, seed=self.seed, controls=False,
            variant=self.variant, variants=self.variants,
        )  # fmt: skip
        info = truth.sampled.info
        objects = len(info["objects"])
        masks = [paint(truth.segmentations_THW, segmentation_colors(objects))]
        for one in predictions:
            rollout = slots_of(worker, one, self.seed)
            labels_THW = slot_labels(rollout.masks[0])
            colors = slot_colors(labels_THW[0], info["segmentation"], rollout.slots.shape[2], objects)
            masks.append(paint(labels_THW, colors))
        frames = [truth.frames_THW3, *(to_uint8(one.frames_T3HW) for one in predictions)]
        verdict = "" if self.good is None else ": success" if self.good else ": failure"
        return Clip(
            name=f"{self.group}-{self.place.replace(' ', '-')}.gif",
            # Pictures of many models are noisy and do not pack well; the page enlarges them itself.
            gif=gif([frames, masks], scale=2 if len(predictions) < 3 else 1),
            panels=("real", *(one.method for one in predictions)),
            title=truth.text,
            caption=f"{self.caption}; seed {self.scene.seed}",
            badge=self.place + verdict,
            tone=tone(self.good),
        )


@dataclass(frozen=True)
class EpisodeClip:
    """A unit of work: one episode of the closed loop, each plan as imagined beside what the camera saw."""

    outcome: LoopOutcome  # of the episode
    column: str  # of the table, for the caption
    rank: int  # for the file's name

    def run(self, worker: Worker) -> Clip:
        """Play it once more."""
        episode = self.outcome.episode
        sampled = sample_scene(worker.environment(episode.scene), episode.scene, episode.variants)
        result = episode.pursue(worker, sampled)
        imagined = [to_uint8(attempt.rollout.frames[0]) for attempt in result.attempts]
        done = "; ".join(text.removeprefix("put ") for text in self.outcome.instructions) or "nothing"
        long = episode.scene.steps > 1  # only every other frame of them
        films = [np.concatenate(imagined or [result.frames[:1]]), result.frames]
        return Clip(
            name=f"closed-loop-{self.rank}.gif",
            gif=gif([[film[:: 1 + long] for film in films]], seconds_a_frame=0.2 if long else 0.14),
            panels=("the plan, imagined", "what happened"),
            title=self.outcome.text,
            caption=f"{self.column}, seed {episode.scene.seed}; done: {done}"
            + (f"; {result.error}" if result.error else ""),
            badge="success" if result.success else f"{result.gained:.0%} of the goal" if long else "failure",
            tone=tone(result.success),
        )


def tone(good: bool | None) -> Tone:
    """Colour of a badge."""
    return "plain" if good is None else "good" if good else "bad"


def episode_clips(
    outcomes: Sequence[LoopOutcome],
    column_of: Callable[[LoopEpisode], str],
    count: int,
    methods: Sequence[str] = ("ours",),
) -> list[EpisodeClip]:
    """Up to `count` failures, of each column in turn, and then successes: `2 * count` in all. Longest goals come first.

    Args:
        column_of: title of the column that an episode stands in.
        methods: whose episodes are shown.
    """
    ours = [(column_of(o.episode), o) for o in outcomes if o.episode.method in methods]
    ours.sort(key=lambda one: -one[1].episode.scene.steps)
    failed = [(column, o) for column, o in ours if not o.success]
    places = [column for column, _ in failed]
    turns = [places[:i].count(column) for i, column in enumerate(places)]
    chosen = [failed[i] for i in np.argsort(turns, kind="stable")][:count]
    chosen += [one for one in ours if one[1].success][: 2 * count - len(chosen)]
    return [EpisodeClip(o, column, rank) for rank, (column, o) in enumerate(chosen, start=1)]


Case = TypeVar("Case", bound=Any)  # a unit with the fields `scene`, `best` and `rank`
Ranked = TypeVar("Ranked", PredictionClip, Film)  # units with the fields `best` and `rank`


def extreme_clips(clips: Sequence[Ranked], badness: Sequence[float], count: int) -> list[Ranked]:
    """The `count` best and then the `count` worst, each with its rank, most extreme first; none is both.

    Of an odd number of clips too few for all, the best have one more.
    """
    order = np.argsort(np.asarray(badness), kind="stable").tolist()
    worst = min(count, len(clips) // 2)
    best = min(count, len(clips) - worst)
    return [
        replace(clips[i], best=good, rank=rank)
        for good, chosen in ((True, order[:best]), (False, order[::-1][:worst]))
        for rank, i in enumerate(chosen, start=1)
    ]


def extremes_by_scene(cases: Sequence[Case], badness: Sequence[Any], count: int) -> list[Case]:
    """The `count` best and the `count` worst cases, each of another scene, with their ranks."""
    chosen = []
    for best in (True, False):
        firsts: dict[int, Case] = {}
        for i in sorted(range(len(cases)), key=badness.__getitem__, reverse=not best):
            firsts.setdefault(cases[i].scene.seed, cases[i])
        ranked = enumerate(list(firsts.values())[:count], start=1)
        chosen += [replace(case, best=best, rank=rank) for rank, case in ranked]
    return chosen


def best_and_worst(clips: Sequence[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Clips of the best cases and of the worst ones, in the order of `extreme_clips`."""
    best = (len(clips) + 1) // 2
    return list(clips[:best]), list(clips[best:])
