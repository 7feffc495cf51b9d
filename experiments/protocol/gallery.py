"""Pictures for a report: imagined beside real, the best cases and the worst ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.protocol.closed_loop import LoopEpisode, LoopOutcome
from experiments.protocol.predicted import HORIZON, PredictedOutcome
from experiments.protocol.scenes import TestScene, draw, play
from experiments.protocol.workers import Worker
from experiments.reporting import Clip
from experiments.reporting.clips import gif, paint, segmentation_colors, slot_colors
from planning import GroundingError, Instruction, PinholeCamera, ground
from textocvp import Rollout, WorldModel


@dataclass(frozen=True, eq=False)
class AttentionMap:
    """What some slots of one rollout attended to, mean over layers, heads and frames.

    Attributes:
        slots: names of the chosen slots. words: of the sentence.
        weights: (slots, words).
    """

    slots: tuple[str, ...]
    words: tuple[str, ...]
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Picture:
    """A clip, and for imagined rollouts of a real checkpoint an attention map."""

    clip: Clip
    attention: AttentionMap | None = None


@dataclass(frozen=True)
class PredictedPicture:
    """A unit of work: draw one case of the predicted study."""

    scene: TestScene
    variant: int
    variants: int
    seed: int
    success: bool
    miss: float
    rank: int
    best: bool

    def run(self, worker: Worker) -> Picture:
        """Imagine and play it once more."""
        env = worker.environment(self.scene)
        drawn = draw(env, self.scene, self.variants)
        text = drawn.texts[self.variant]
        asks = {"attention": True} if isinstance(worker.world_model, WorldModel) else {}
        rollout = worker.world_model.rollout(
            drawn.observation["rgb"], [text], horizon=HORIZON, seed=self.seed, **asks
        )
        played = play(env, drawn, self.variant)
        objects = len(drawn.info["objects"])
        labels_THW = rollout.masks[0].argmax(1).numpy()
        colors = slot_colors(labels_THW[0], drawn.info["segmentation"], rollout.slots.shape[2], objects)
        grid = [
            [pixels(rollout), played.frames],
            [paint(labels_THW, colors), paint(played.segmentations, segmentation_colors(objects))],
        ]
        kind = "best" if self.best else "worst"
        variant = "original" if self.variant == 0 else f"variant {self.variant}"
        missed = (
            f"block ends {self.miss:.1f} px from the bowl's centre" if np.isfinite(self.miss) else "not found"
        )
        clip = Clip(
            name=f"predicted-{kind}-{self.rank}.gif",
            gif=gif(grid),
            panels=("imagined", "real"),
            title=text,
            caption=f"{variant}, seed {self.scene.seed}; {missed}",
            badge=f"{kind} {self.rank}: {'success' if self.success else 'failure'}",
            tone="good" if self.success else "bad",
        )
        attention = None
        if self.best and rollout.attention is not None and isinstance(worker.world_model, WorldModel):
            words = tuple(worker.world_model.model.text.words(text))
            attention = attention_map(rollout, PinholeCamera.from_info(drawn.info["camera"]), text, words)
        return Picture(clip, attention)


@dataclass(frozen=True)
class LoopPicture:
    """A unit of work: draw one episode of the closed loop."""

    outcome: LoopOutcome
    column: str
    rank: int

    def run(self, worker: Worker) -> Picture:
        """Play it once more."""
        episode: LoopEpisode = self.outcome.episode
        drawn = draw(worker.environment(episode.scene), episode.scene, episode.variants)
        result = episode.pursue(worker, drawn)
        imagined = [pixels(attempt.plan.rollout) for attempt in result.attempts] or [result.frames[:1]]
        steps = f"{result.steps} pick-and-place" + ("s" if result.steps != 1 else "")
        word = "success" if result.success else "failure"
        clip = Clip(
            name=f"closed-loop-{self.rank}.gif",
            gif=gif([[np.concatenate(imagined), result.frames]]),
            panels=("the plan, imagined", "what happened"),
            title=self.outcome.text,
            caption=f"{self.column}, seed {episode.scene.seed}; {steps}"
            + (f"; {result.error}" if result.error else ""),
            badge=word,
            tone="good" if result.success else "bad",
        )
        return Picture(clip)


def choose_predicted(
    outcomes: Sequence[PredictedOutcome], variants: int, seed: int, count: int
) -> list[PredictedPicture]:
    """The `count` best and `count` worst cases of the first slot seed, each of another scene.

    Args:
        variants: how many variants the scenes have. seed: the first slot seed.
    """
    cases = [
        (bool(o.ours.success_SV[0, v]), float(o.ours.miss_SV[0, v]), o.scene, v)
        for o in outcomes
        for v in range(variants + 1)
    ]
    worst = sorted(cases, key=lambda case: (case[0], -case[1]))
    best = sorted(cases, key=lambda case: (not case[0], case[1]))
    chosen = []
    for kind, ranked in ((True, best), (False, worst)):
        firsts: dict[int, tuple[bool, float, TestScene, int]] = {}
        for case in ranked:
            firsts.setdefault(case[2].seed, case)
        for rank, (success, miss, scene, v) in enumerate(list(firsts.values())[:count], start=1):
            chosen.append(PredictedPicture(scene, v, variants, seed, success, miss, rank, kind))
    return chosen


def choose_loop(
    outcomes: Sequence[LoopOutcome], columns: Mapping[tuple[str, int], str], count: int
) -> list[LoopPicture]:
    """Up to `count` failures of ours, and successes with the longest goals: `2 * count` in all.

    Args:
        columns: (split, variant) -> name of the column.
    """
    ours = [o for o in outcomes if o.episode.method == "ours"]
    failures = [o for o in ours if not o.success][:count]
    successes = sorted((o for o in ours if o.success), key=lambda o: -o.episode.scene.steps)
    chosen = successes[: 2 * count - len(failures)] if len(failures) < count else successes[:count]
    return [
        LoopPicture(o, columns[o.episode.scene.split, o.episode.variant], rank)
        for rank, o in enumerate(chosen + failures, start=1)
    ]


def pixels(rollout: Rollout) -> np.ndarray:
    """The frames of a rollout (B = 1) as (T, H, W, 3) uint8."""
    return (rollout.frames[0] * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


def attention_map(
    rollout: Rollout, camera: PinholeCamera, text: str, words: tuple[str, ...]
) -> AttentionMap | None:
    """Attention of the named block and bowl, the arm and another bowl; None if they cannot be found."""
    assert rollout.attention is not None
    instruction = Instruction.parse(text)
    try:
        grounding = ground(rollout, camera)[0].told([instruction.block_thing, instruction.bowl_thing])
        slots = {
            f"{instruction.block} block (named)": grounding.find(instruction.block_thing),
            f"{instruction.bowl} bowl (named)": grounding.find(instruction.bowl_thing),
            "arm": grounding.arm,
        }
    except GroundingError:
        return None
    for thing, its in grounding.things.items():
        if thing not in (instruction.block_thing, instruction.bowl_thing) and thing.kind == "bowl":
            slots[f"{thing.color} bowl"] = its
            break
    weights_KL = rollout.attention[0].mean(dim=(0, 1, 2))[:, : len(words)]
    rows = [weights_KL[list(its)].mean(0).numpy() for its in slots.values()]
    return AttentionMap(tuple(slots), words, np.stack(rows))
