"""The ablation study's units of work: one scene, under every model at once, so that all see the very same."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from experiments.protocol.films import Film
from experiments.protocol.frame_scores import Measures, Scorer
from experiments.protocol.object_scenes import named_block, score_masks, winners
from experiments.protocol.predicted import imagine_and_judge
from experiments.protocol.scenes import TestScene, draw, play
from experiments.protocol.workers import LoadCheckpoint, Worker
from planning import PinholeCamera
from textocvp.metrics.frames import psnr
from textocvp.training.evaluate_predictor import PIXEL, REACHED

NEAR = REACHED / PIXEL  # pixels of 64
ENDS = f"ends_within_{NEAR:g}_px"  # the metric: the block's mask ends that near to the bowl's
LENGTH = 9  # frames that pictures are compared over: the paper's shorter length


@dataclass(frozen=True)
class Entrant:
    """A model that is measured.

    Attributes:
        name: of its row. load: makes it.
        num_slots: that its parser uses, background included; None for its own number.
    """

    name: str
    load: LoadCheckpoint
    num_slots: int | None = None


@dataclass(frozen=True, eq=False)
class Followed:
    """One model in one scene with V instructions, the original one first.

    Attributes:
        success_V: imagined with the instruction, does the scene obey it? bool, by the calibrated criterion.
        ends_V: does the block end near the bowl, by the looser criterion of the training's own figures? bool.
        wrong_V: imagined with another instruction of the list, does the block end near this one's bowl? bool; empty
            for V = 1.
        pictures: metric -> mean over the first frames of the original instruction; empty where not asked for.
    """

    success_V: np.ndarray
    ends_V: np.ndarray
    wrong_V: np.ndarray
    pictures: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class FollowingOutcome:
    """What came of a scene, by model."""

    scene: TestScene
    texts: tuple[str, ...]
    models: Mapping[str, Followed]


@dataclass(frozen=True)
class FollowingScene:
    """A unit of work: does what each model imagines obey the sentence, and does it look like what happened?

    Attributes:
        scene: where. entrants: who.
        variants: how many further instructions, with another target bowl each.
        seed: of the slots.
        measures: of pictures; None to compare none, which saves the expert's motion.
    """

    scene: TestScene
    entrants: tuple[Entrant, ...]
    variants: int
    seed: int
    measures: Measures | None = None

    def run(self, worker: Worker) -> FollowingOutcome:
        """Imagine and judge, with every model."""
        env = worker.environment(self.scene)
        drawn = draw(env, self.scene, self.variants)
        camera = PinholeCamera.from_info(drawn.info["camera"])
        scorer = None
        if self.measures is not None:
            frames = play(env, drawn).frames[: LENGTH + 1]
            scorer = Scorer(_film(frames), self.measures, upper=False)
        models = {}
        for entrant in self.entrants:
            with warnings.catch_warnings():
                # That a text encoder has never met a colour's name is what the unseen colours are about.
                warnings.filterwarnings("ignore", "the text encoder has never met", UserWarning)
                rollout, ours, wrong = imagine_and_judge(
                    worker.other(entrant.load), drawn.observation["rgb"], camera, drawn.texts, self.seed
                )
            pictures: dict[str, float] = {}
            if scorer is not None:
                film = Film(entrant.name, rollout.select(0).decode_frames(range(LENGTH + 1))[0])
                scores = scorer.score(film)
                pictures = {metric: float(curve.mean()) for metric, curve in scores.curves.items()}
            ends_V, wrong_V = ours.miss_SV[0] < NEAR, wrong.miss_SV[0] < NEAR
            models[entrant.name] = Followed(
                ours.success_SV[0], ends_V, wrong_V if self.variants else wrong_V[:0], pictures
            )
        return FollowingOutcome(self.scene, drawn.texts, models)


@dataclass(frozen=True, eq=False)
class Parsed:
    """One parser on one episode; means over its frames.

    Attributes:
        miou: of blocks and bowls, slots matched afresh in every frame. kept: the same, each held against the slot that
            had it in the first frame. ari: over the foreground, arm included.
        psnr: of the redrawn frames, dB.
    """

    miou: float
    kept: float
    ari: float
    psnr: float


@dataclass(frozen=True, eq=False)
class ParsingOutcome:
    """What came of a scene, by model."""

    scene: TestScene
    models: Mapping[str, Parsed]


@dataclass(frozen=True)
class ParsingScene:
    """A unit of work: how well does each parser take the expert's episode apart?"""

    scene: TestScene
    entrants: tuple[Entrant, ...]
    seed: int

    def run(self, worker: Worker) -> ParsingOutcome:
        """Play the episode and parse it with every model."""
        env = worker.environment(self.scene)
        drawn = draw(env, self.scene)
        played = play(env, drawn)
        real = _film(played.frames)
        models = {}
        for entrant in self.entrants:
            parsed = worker.other(entrant.load).parse(
                played.frames, seed=self.seed, num_slots=entrant.num_slots
            )
            scores = score_masks(winners(parsed)[0], played.segmentations, named_block(drawn))
            redrawn = float(psnr(parsed.frames[0], real).mean())
            miou, kept, ari = (float(np.nanmean(curve)) for curve in (scores.iou, scores.kept, scores.ari))
            models[entrant.name] = Parsed(miou, kept, ari, redrawn)
        return ParsingOutcome(self.scene, models)


def _film(frames_THW3: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(frames_THW3)).permute(0, 3, 1, 2).float() / 255
