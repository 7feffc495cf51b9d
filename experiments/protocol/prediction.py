"""The prediction study's unit of work, and its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.protocol.contenders import Contender
from experiments.protocol.figures import interval_row, mean_row
from experiments.protocol.films import film
from experiments.protocol.frame_scores import FrameScores, Measures, Scorer
from experiments.protocol.scenes import TestScene
from experiments.protocol.workers import Worker
from experiments.reporting import Row
from textocvp.metrics.jedi import jedi

SPLIT = "test"
#: The paper's two lengths, and a whole episode of the tabletop.
LENGTHS = (9, 19, 24)
#: How far the curves go, for models that can look as far.
FARTHEST = 40


@dataclass(frozen=True, eq=False)
class PredictionOutcome:
    """One scene, imagined by everybody and measured.

    Attributes:
        scene, text: the scene and its instruction. wrong_text: what the control was told.
        scores: of each method, in the order of the table.
        real_features: length -> (D,) of the real film, for JEDi.
    """

    scene: TestScene
    text: str
    wrong_text: str
    scores: tuple[FrameScores, ...]
    real_features: Mapping[int, np.ndarray]

    def of(self, method: str) -> FrameScores:
        """The scores of a method.

        Raises:
            KeyError: if there are none.
        """
        for scores in self.scores:
            if scores.method == method:
                return scores
        raise KeyError(method)


@dataclass(frozen=True)
class PredictionScene:
    """A unit of work: one scene, imagined by every model and every control.

    Attributes:
        scene: which. contenders: the baselines. measures: what is measured.
        seed: of the slots.
    """

    scene: TestScene
    contenders: tuple[Contender, ...]
    measures: Measures
    seed: int

    def run(self, worker: Worker) -> PredictionOutcome:
        """Imagine, watch, measure."""
        happened, films = film(worker, self.scene, self.contenders, horizon=FARTHEST, seed=self.seed)
        scorer = Scorer(happened.film, self.measures, upper=True)
        return PredictionOutcome(
            scene=self.scene,
            text=happened.text,
            wrong_text=happened.wrong_text,
            scores=tuple(scorer.score(one) for one in films),
            real_features=scorer.real_features(),
        )


def methods_of(outcomes: Sequence[PredictionOutcome]) -> list[str]:
    """Everybody who was measured, in the order of the table."""
    return [scores.method for scores in outcomes[0].scores] if outcomes else []


def length_rows(outcomes: Sequence[PredictionOutcome]) -> list[Row]:
    """Means over the first so many frames, of every metric, with and without the bottom rows."""
    rows = []
    for method in methods_of(outcomes):
        scores = [outcome.of(method) for outcome in outcomes]
        for metric in scores[0].curves:
            for length in LENGTHS:
                values = [value for one in scores if (value := one.mean(metric, length)) is not None]
                if values:
                    rows.append(mean_row(method, SPLIT, f"{length} frames", metric, values))
    return rows


def jedi_rows(outcomes: Sequence[PredictionOutcome]) -> list[Row]:
    """JEDi at each length; none where its features were not computed."""
    rows = []
    for method in methods_of(outcomes):
        scores = [outcome.of(method) for outcome in outcomes]
        for length in scores[0].features:
            imagined_ND = np.stack([one.features[length] for one in scores])
            real_ND = np.stack([outcome.real_features[length] for outcome in outcomes])
            found = jedi(imagined_ND, real_ND)
            rows.append(interval_row(method, SPLIT, f"{length} frames", "jedi", found))
    return rows


def frame_rows(outcomes: Sequence[PredictionOutcome], metrics: Sequence[str]) -> list[Row]:
    """Every metric at every frame: what the curves are drawn from."""
    rows = []
    for method in methods_of(outcomes):
        scores = [outcome.of(method) for outcome in outcomes]
        for metric in metrics:
            for t in range(len(scores[0].curves[metric])):
                values = [one.curves[metric][t] for one in scores]
                rows.append(mean_row(method, SPLIT, f"frame {t + 1}", metric, values))
    return rows
