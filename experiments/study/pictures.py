"""The same scene in other light, through a worse camera or in other words: does the imagined block reach its bowl?"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from experiments.report.rows import Row, figure_rows
from experiments.report.tables import TableSpec, columns
from experiments.study.methods import HORIZON, lines
from experiments.study.pool import Worker
from experiments.study.scenes import StudyScene, sample_scene
from experiments.study.wordings import free_wording, paraphrase
from planning import Instruction, Thing
from textocvp.inputs import ForeignPictureWarning
from textocvp.metrics import overlaps
from textocvp.training.evaluate_predictor import PIXEL, REACHED
from textocvp.training.light import jpeg

FOUND = 0.25  # IoU above which a slot holds a thing
WOOD = (139, 101, 66)  # RGB

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def change_picture(name: str, rgb_HW3: Picture, table_HW: Mask, rng: np.random.Generator) -> Picture:
    """A picture changed as `CHANGES` says; `table_HW` is where it shows the table."""
    return CHANGES[name](rgb_HW3, table_HW, rng).round().clip(0, 255).astype(np.uint8)


def _shade(rgb_HW3: Picture, _: Mask, rng: np.random.Generator) -> NDArray[Any]:
    """Light from 125 % at one edge, in a random direction, to 75 % at the other."""
    H, W, _ = rgb_HW3.shape
    angle = rng.uniform(0, 2 * np.pi)
    across_HW = np.cos(angle) * np.linspace(-1, 1, W) + np.sin(angle) * np.linspace(-1, 1, H)[:, None]
    return rgb_HW3 * (1 + 0.25 * across_HW / abs(across_HW).max())[..., None]


def _lay_wood(rgb_HW3: Picture, table_HW: Mask, rng: np.random.Generator) -> NDArray[Any]:
    """A table of four brown planks, up to 15 % lighter or darker, with grain of deviation 10 % along them."""
    H, W = table_HW.shape
    noise_HW = ndimage.gaussian_filter(rng.standard_normal((H, W)), (0.7 * H / 64, 12 * H / 64))
    plank_H = rng.uniform(-0.15, 0.15, 4)[np.arange(H) * 4 // H]
    wood_HW3 = np.array(WOOD) * (1 + plank_H[:, None] + 0.1 * noise_HW / noise_HW.std())[..., None]
    return np.where(table_HW[..., None], wood_HW3, rgb_HW3)


UNCHANGED = "unchanged"
CHANGES: Mapping[str, Callable[[Picture, Mask, np.random.Generator], NDArray[Any]]] = {
    UNCHANGED: lambda rgb_HW3, table_HW, rng: rgb_HW3,
    "light x 0.7": lambda rgb_HW3, table_HW, rng: rgb_HW3 * 0.7,
    "light x 1.25": lambda rgb_HW3, table_HW, rng: rgb_HW3 * 1.25,
    "light gradient 25 %": _shade,
    "noise, sigma 8": lambda rgb_HW3, table_HW, rng: rgb_HW3 + 8 * rng.standard_normal(rgb_HW3.shape),
    "JPEG, quality 75": lambda rgb_HW3, table_HW, rng: jpeg(rgb_HW3, 75),
    "wooden table": _lay_wood,
}
"""Title of a column -> what is done to the first picture."""

WORDS: Mapping[str, Callable[[int, Instruction], str]] = {
    "ours": lambda number, asked: asked.text,
    "ours, other words": lambda number, asked: paraphrase(number, asked.thing.color, asked.target.color),
    "ours, free words": lambda number, asked: free_wording(number, asked.thing.color, asked.target.color),
}
"""Line of a table -> the wording, of the scene's number and what is asked for."""


@dataclass(frozen=True)
class ChangedOutcome:
    """What came of a scene in another light."""

    scene: StudyScene  # which
    change: str  # key of `CHANGES`
    words: str  # key of `WORDS`
    reached: bool  # the imagined block ends within 6 pixels of 64 of the named bowl
    warned: bool  # the model said that the picture is not of its world


@dataclass(frozen=True)
class ChangedScene:
    """A unit of work: one changed observation, imagined with the scene's own sentence or with a paraphrase of it.

    The true masks say which slots hold the block and the bowl, as in `InstructionFollowing`: what is measured is the
    model, not the grounding by colour.
    """

    scene: StudyScene
    change: str
    seed: int
    words: str = "ours"  # key of `WORDS`
    number: int = 0  # of the scene, which decides the paraphrase

    def run(self, worker: Worker) -> ChangedOutcome:
        """Change, imagine, look where the block ends."""
        sampled = sample_scene(worker.environment(self.scene), self.scene)
        rgb, labels_HW = sampled.observation["rgb"], sampled.info["segmentation"]
        table_HW = (labels_HW == 0) & (rgb == np.array(sampled.info["palette"]["table"])).all(-1)
        changed = change_picture(self.change, rgb, table_HW, np.random.default_rng([self.scene.seed, 4]))
        asked = Instruction.parse(sampled.texts[0])
        text = WORDS[self.words](self.number, asked)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            rollout = worker.world_model.rollout(changed, [text], horizon=HORIZON, seed=self.seed)
        label_of = {Thing(item["color"], item["kind"]): item["label"] for item in sampled.info["objects"]}
        seen_HW = rollout.decode_masks([0])[0, 0].argmax(0).cpu().numpy()
        block, bowl = (_best_slot(seen_HW, labels_HW, label_of[one]) for one in (asked.thing, asked.target))
        places_TK2 = rollout.positions[0].cpu() * 64 / rollout.image_size[0]  # pixels of 64
        away = float((places_TK2[-1, block] - places_TK2[0, bowl]).norm())
        reached = min(block, bowl) >= 0 and away < REACHED / PIXEL
        warned = any(issubclass(one.category, ForeignPictureWarning) for one in said)
        return ChangedOutcome(self.scene, self.change, self.words, reached, warned)


def _best_slot(seen_HW: NDArray[np.int64], labels_HW: NDArray[np.uint8], label: int) -> int:
    """The slot whose pixels overlap an object's best; -1 if none does by an IoU of `FOUND`."""
    ious_SN, slots_S, _ = overlaps(seen_HW, labels_HW, [label], min_pixels=1)
    return int(slots_S[ious_SN.argmax()]) if ious_SN.max(initial=0.0) >= FOUND else -1


def change_rows(outcomes: Sequence[ChangedOutcome]) -> list[Row]:
    """For each wording, split and change the share of scenes that reach the bowl, and the share that is warned of."""
    return figure_rows(
        (one.scene.split, {(one.words, one.change, metric): getattr(one, metric) for metric in ("reached", "warned")})
        for one in outcomes
    )


def change_tables(split: str) -> list[TableSpec]:
    """What `change_rows` makes of a split, a column a change and a line a wording."""
    titles = {
        "reached": "The imagined block reaches the named bowl",
        "warned": "The model says that the picture is not of its world",
    }
    places = {change: (split, change) for change in CHANGES}
    return [TableSpec(title, columns(metric, places), lines(WORDS)) for metric, title in titles.items()]
