"""Every method of the studies: who is measured, its label, note and colour, its model or planner, the paper's figures.

To compare another baseline or another planner, add one entry to `METHODS`.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from experiments.report.tables import Line, Paper, quoted
from planning import (
    BeamPlanner,
    Controller,
    Foresees,
    Goal,
    Imagines,
    LiteralController,
    LiteralPlanner,
    Planner,
    RandomPlanner,
)
from textocvp.checkpoint import CheckpointError
from textocvp.protocols import LoadCheckpoint, LoadModel

HORIZON = 24  # frames of an episode of the tabletop after the first one
MakePlanner = Callable[[Imagines, Goal, np.random.Generator, int], Planner]
"""Makes a planner of a world model, the goal of the episode, a source of chance, and the seed of the slots."""


@dataclass(frozen=True, kw_only=True)
class Method(Line):
    """A method. The fields of `Line` say how it is shown; these say what it is."""

    model: str = ""  # bundled checkpoint of a model beside the study's own; empty for none
    slots: bool = True  # whether that model has slots; if not, masks are read off its frames by our parser
    train: str = ""  # what to type to train it
    # makes the planner with which it acts in the closed loop; None for one that does not
    plan: MakePlanner | None = None
    controller: type[Controller] | type[LiteralController] = Controller  # makes actions of its plans
    replan: bool = True  # whether it looks again after every action, and plans anew
    chance: int = 0  # methods of other numbers draw other random numbers
    privileged: bool = False  # whether its planner is told by the simulator's segmentation which slot is what
    expert: bool = False  # whether it is the scripted expert

    @property
    def acts(self) -> bool:
        """Whether it acts in the closed loop."""
        return self.expert or self.plan is not None

    @property
    def ending(self) -> str:
        """Of the names of its headline figures: `_copy_frame`; empty for ours."""
        return "" if self.key == "ours" else "_" + re.sub(r"\W", "_", self.key.lower())


def _best(model: Imagines, goal: Goal, rng: np.random.Generator, seed: int) -> Planner:
    if len(goal.instructions) > 1:
        return BeamPlanner(model, horizon=HORIZON, seed=seed)
    # One step: any sentence about the scene is a candidate, not only those that the goal asks for.
    return BeamPlanner(model, depth=1, candidates="scene", horizon=HORIZON, seed=seed)


def _random(model: Imagines, goal: Goal, rng: np.random.Generator, seed: int) -> Planner:
    return RandomPlanner(model, rng, depth=1, horizon=HORIZON, seed=seed)


def _literal(model: Imagines, goal: Goal, rng: np.random.Generator, seed: int) -> Planner:
    return LiteralPlanner(cast(Foresees, model), seed=seed)  # which it never asks


_FIRST, _MEAN = ("9 frames", "19 frames"), ("frames 1-9", "frames 1-19")
_OURS = Paper(
    "paper, TextOCVP",
    {
        **quoted("test", _FIRST, ssim=(0.950, 0.931), lpips=(0.062, 0.078), jedi=(1.36, 2.23)),
        **quoted("unseen_colors", _FIRST, ssim=(0.946, 0.927), lpips=(0.066, 0.083)),
        **quoted("unseen_colors", _FIRST, ssim_drop=(0.004,), lpips_drop=(0.064, 0.064)),
        **quoted("more_objects", _FIRST, ssim=(0.936, 0.921), lpips=(0.076, 0.090)),
        **quoted("more_objects", _FIRST, ssim_drop=(0.015, 0.011), lpips_drop=(0.226, 0.154)),
        # Mean of 5 runs over 100 sequences.
        **quoted(
            "controllability",
            ("original", "variant 1", "variant 2", "variant 3", "variants mean"),
            predicted_success=(0.83, 0.86, 0.80, 0.81, 0.82),
        ),
        **quoted("test", _MEAN, iou=(0.573, 0.569)),
    },
)
_MAGE = Paper(
    "paper, MAGE-DINO",
    {
        **quoted("test", _FIRST, ssim=(0.940, 0.931), lpips=(0.064, 0.075), jedi=(2.11, 2.59)),
        **quoted("unseen_colors", _FIRST, ssim=(0.935, 0.924), lpips=(0.076, 0.087)),
        **quoted("unseen_colors", _FIRST, ssim_drop=(0.005, 0.007), lpips_drop=(0.19, 0.16)),
        **quoted("more_objects", _FIRST, ssim=(0.929, 0.920), lpips=(0.088, 0.094)),
        **quoted("more_objects", _FIRST, ssim_drop=(0.012, 0.012), lpips_drop=(0.375, 0.253)),
    },
)
_TRUE_FRAMES = Paper("paper, parser on true frames", quoted("test", _MEAN, iou=(0.554, 0.553)))
_COPY_SEED = Paper("paper, Copy-Seed", quoted("test", _MEAN, iou=(0.540, 0.525)))

_DATA = "--data data/tabletop-train.h5 --val data/tabletop-val.h5"
_TRAIN_PREDICTOR = "textocvp train predictor --parser textocvp/checkpoints/tabletop-small"
_TRAIN_LITE0 = "textocvp train parser --preset cliport-lite0 (docs/models.md has both commands)"

METHODS: dict[str, Method] = {
    method.key: method
    for method in (
        Method(key="ours", hue=0, note="imagined from one frame and the sentence", plan=_best, paper=_OURS),
        Method(key="ours, 40 frames", hue=7, note="ours, trained on to look 40 frames ahead",
               model="tabletop-small-40",
               train=f"{_TRAIN_PREDICTOR} --finetune --set predictor.window=40 {_DATA} --out runs/window40 --steps 600 "
               "--batch 16 --autoregressive 1.0 --horizon 20 --learning-rate 3e-4 --warmup 50"),
        Method(key="ours, taught by masks", hue=7, note="its parser learned from the simulator's masks",
               model="cliport-masks",
               train="textocvp train parser --preset cliport --teacher masks (docs/models.md has all three commands)"),
        Method(key="ours, frames parsed", hue=0,
               note="our parser reads the imagined frames, as it must for models without slots"),
        Method(key="ours, other words", hue=0,
               note="the same wish in another wording for each scene, of kinds that users write"),
        Method(key="ours, free words", hue=0,
               note="the same in 40 wordings by somebody who had not seen the model's rules"),
        Method(key="ours, privileged", kind="ceiling", hue=3, plan=_best, privileged=True,
               note="the same, but slots are named by the simulator's segmentation"),
        Method(key="savi", hue=7, note="published slot attention from pixels, and text", model="savi-cater-trained",
               train="python experiments/train_cater.py --only savi"),
        Method(key="ours, few updates", hue=0, note="CATER: the predictor had 4,000 updates, as those below",
               model="cater-words", train="python experiments/train_cater.py --only predictor-words"),
        Method(key="plain attention", hue=7, note="the same, without a term that matches words and slots",
               model="cater-plain", train="python experiments/train_cater.py --only predictor-plain"),
        Method(key="colour lexicon", hue=7, note="the same, with the term that matches colours alone",
               model="cater-color", train="python experiments/train_cater.py --only predictor-color"),
        Method(key="OCVP-Seq", kind="baseline", hue=5, note="slots, but no text", model="ocvp-seq-small",
               train=f"{_TRAIN_PREDICTOR} --preset ocvp-seq-small {_DATA} --out runs/ocvp-seq --steps 1500 "
               "--autoregressive 1.0"),
        Method(key="Non-OC", kind="baseline", hue=6, note="text, but one vector for the whole scene",
               model="non-oc-small", slots=False,
               train=f"textocvp train parser --preset non-oc-small {_DATA} --out runs/non-oc-parser --steps 5000 "
               "--clip 3 --stride 8 --batch 16 --learning-rate 2e-3 && "
               f"textocvp train predictor --parser runs/non-oc-parser/checkpoint {_DATA} --out runs/non-oc "
               "--autoregressive 1.0 --content-weight 1 --image-weight 10 --image-frames 2 --steps 1800"),
        Method(key="MAGE", kind="baseline", hue=3, note="text, and codes of picture patches instead of objects",
               model="mage-small", slots=False, paper=_MAGE,
               train=f"textocvp train vqvae {_DATA} --out runs/vqvae --steps 1600 && "
               f"textocvp train mage --vqvae runs/vqvae/checkpoint {_DATA} --out runs/mage --steps 1800 "
               "--autoregressive 0.8 --changed-weight 1"),
        Method(key="TextOCVP on EfficientNet-Lite0", hue=5, model="cliport-lite0", train=_TRAIN_LITE0,
               note="the published pipeline, with EfficientNet-Lite0 in DINOv2's place"),
        Method(key="slot attention on EfficientNet-Lite0", kind="ceiling", hue=5, model="cliport-lite0",
               train=_TRAIN_LITE0, note="its parser and renderer on the true frames, nothing imagined"),
        Method(key="true frames", kind="ceiling", hue=1, paper=_TRUE_FRAMES,
               note="parser and renderer on the true frames, nothing imagined"),
        Method(key="wrong text", kind="control", hue=4, note="imagined with a sentence that names something else"),
        Method(key="copy frame", kind="control", hue=2, note="the first frame repeated"),
        Method(key="copy seed", kind="control", hue=2, note="the first frame's masks held still",
               paper=_COPY_SEED),
        Method(key="no imagination", kind="control", hue=4, plan=_literal, controller=LiteralController,
               note="picks where the named block is seen, places where the named bowl is seen"),
        Method(key="expert", kind="ceiling", hue=1, note="scripted, knows every pose", expert=True),
        Method(key="random candidate", kind="control", hue=2, plan=_random,
               note="the same robot carries out a random instruction"),
    )
}  # fmt: skip
BASELINES = tuple(key for key, method in METHODS.items() if method.kind == "baseline")
"""The models that ours is compared with, in the order of the tables."""
PLANNERS = tuple(key for key, method in METHODS.items() if method.acts)  # who acts in the closed loop
OURS_40 = "ours, 40 frames"
TRAINED_LITTLE = (
    "The bundled baselines are small and were trained for minutes on two cores, as their cards say: none of them was "
    "trained to the end."
)
"""To be said wherever they stand beside ours."""


def lines(keys: Iterable[str], notes: Mapping[str, str] | None = None) -> tuple[Method, ...]:
    """Methods as lines of a table, with other notes where those in `METHODS` do not fit.

    Raises:
        KeyError: if there is no such method.
    """
    notes = notes or {}
    return tuple(replace(METHODS[key], note=notes.get(key, METHODS[key].note)) for key in keys)


def with_paper(measured: Iterable[Line], papers: Mapping[str, Paper]) -> dict[str, Line]:
    """Lines with the paper's figures below them, and SEER, which only the paper has measured."""
    lines = {line.key: replace(line, paper=papers.get(line.key)) for line in measured}
    return {**lines, "SEER": Line(key="SEER", kind="baseline", note="not run", paper=papers["SEER"])}


@dataclass(frozen=True)
class Model:
    """The model of a method, which is there."""

    key: str  # of the method
    load: LoadModel  # makes it
    slots: bool  # see `Method`
    checkpoint: str  # where it came from
    sha256: str  # of its weights
    longest: int | None  # how many frames it can imagine at once; None for any number


def find_models(loads: Mapping[str, LoadModel]) -> tuple[tuple[Model, ...], dict[str, str]]:
    """The models that are there, and key -> reason of those that are not, in the order of `METHODS`.

    Args:
        loads: key of a method -> makes its model.

    Raises:
        CheckpointError: if a checkpoint that is not the bundled one cannot be loaded: somebody has asked for it.
    """
    present, missing = [], {}
    for key in sorted(loads, key=list(METHODS).index):
        method, load = METHODS[key], loads[key]
        try:
            model = load()
        except CheckpointError:
            if load != LoadCheckpoint(method.model):
                raise
            missing[key] = f"not trained: `{method.train}`"
            continue
        where = model.checkpoint
        present.append(Model(key, load, method.slots, where.name, where.sha256, model.longest_horizon))
    return tuple(present), missing
