"""How well imagined masks fit the simulator's segmentation, scene by scene and frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from envs import parse_instruction
from experiments.protocol.scenes import Drawn, TestScene, draw, play, wrong_text
from experiments.protocol.workers import LoadWorldModel, StudyModel, Worker
from textocvp import Rollout
from textocvp.metrics import foreground_ari, object_ious, overlaps, slot_labels

BACKGROUND, ARM = 0, 1  # their labels in a segmentation
#: Lengths of the prediction: the paper's two, a whole episode, and for models that can, far beyond what is trained.
LENGTHS = (9, 19, 24, 40)


@dataclass(frozen=True, eq=False)
class MaskScores:
    """How well the masks of T frames fit. All (T,), frame 0 is the observed one; nan where nothing of it is seen.

    Attributes:
        iou: mean over the blocks and bowls that are seen; slots are matched to them afresh in every frame (Hungarian),
            as in the paper.
        moving: mean of the named block and the arm, the only things that move; matched as above, with the arm.
        block, arm: these two by themselves.
        still: as `iou`, without the named block.
        kept: mean over blocks and bowls, each held against the one slot that was matched to it in frame 0: a model
            that lets two slots swap their objects loses here and nowhere else.
        kept_moving: the same for the named block and the arm.
        ari: adjusted Rand index over the foreground, arm included.
    """

    iou: np.ndarray
    moving: np.ndarray
    block: np.ndarray
    arm: np.ndarray
    still: np.ndarray
    kept: np.ndarray
    kept_moving: np.ndarray
    ari: np.ndarray


def score_masks(labels_THW: np.ndarray, truth_THW: np.ndarray, moved: int) -> MaskScores:
    """Compare masks with the simulator's segmentation.

    Args:
        labels_THW: the slot that wins each pixel.
        truth_THW: 0 background, 1 arm, 2 + i object i.
        moved: value of the named block there.

    Raises:
        ValueError: if the two differ in size.
    """
    if labels_THW.shape != truth_THW.shape:
        raise ValueError(f"labels are {labels_THW.shape}, the segmentation {truth_THW.shape}")
    things = [int(label) for label in np.unique(truth_THW) if label != BACKGROUND]
    first = object_ious(labels_THW[0], truth_THW[0], things)
    held = dict(zip(first.ids.tolist(), first.slots.tolist(), strict=True))
    columns = []
    for labels, truth in zip(labels_THW, truth_THW, strict=True):
        objects = object_ious(labels, truth, [label for label in things if label != ARM])
        matched = object_ious(labels, truth, things)
        of = dict(zip(matched.ids.tolist(), matched.ious.tolist(), strict=True))
        block, arm = of.get(moved, np.nan), of.get(ARM, np.nan)
        kept = _held_ious(labels, truth, held)
        columns.append(
            (
                _mean(objects.ious),
                _mean([block, arm]),
                block,
                arm,
                _mean(objects.ious[objects.ids != moved]),
                _mean([iou for i, iou in kept.items() if i != ARM]),
                _mean([kept.get(moved, np.nan), kept.get(ARM, np.nan)]),
                foreground_ari(labels, truth),
            )
        )
    return MaskScores(*np.array(columns, dtype=np.float64).T)


def _held_ious(labels: np.ndarray, truth: np.ndarray, held: Mapping[int, int]) -> dict[int, float]:
    """Overlap of each thing that is seen with the slot it has been given; 0 if that slot shows nothing."""
    ious, slots, ids = overlaps(labels, truth, list(held))
    found = {}
    for column, i in enumerate(ids.tolist()):
        row = np.flatnonzero(slots == held[i])
        found[i] = float(ious[row[0], column]) if len(row) else 0.0
    return found


def _mean(values: object) -> float:
    array = np.asarray(values, dtype=np.float64)
    array = array[~np.isnan(array)]
    return float(array.mean()) if len(array) else float("nan")


@dataclass(frozen=True, eq=False)
class ObjectOutcome:
    """One scene, measured.

    Attributes:
        scene, text: the scene and its instruction.
        wrong_text: what the control was told.
        frames: of the expert's motion, the first included; afterwards its last frame stands still.
        scores: by method; a method that cannot look as far ahead as another has fewer frames.
    """

    scene: TestScene
    text: str
    wrong_text: str
    frames: int
    scores: Mapping[str, MaskScores]


@dataclass(frozen=True)
class ObjectScene:
    """A unit of work: one scene under all methods.

    Attributes:
        scene: where.
        seed: of the slots.
        others: methods that imagine with another model under the same sentence: (name, makes it).
    """

    scene: TestScene
    seed: int
    others: tuple[tuple[str, LoadWorldModel], ...] = ()

    def run(self, worker: Worker) -> ObjectOutcome:
        """Play it, imagine it, compare."""
        drawn = draw(worker.environment(self.scene), self.scene)
        # Played first: the simulator's frames are what everything is held against.
        played = play(worker.environment(self.scene), drawn)
        wrong = wrong_text(drawn)
        model, seen = worker.world_model, drawn.observation["rgb"]
        ours, other = winners(imagine(model, seen, [drawn.texts[0], wrong], self.seed))
        labels = {"ours": ours, "wrong text": other}
        for name, load in self.others:
            labels[name] = winners(imagine(worker.other(load), seen, [drawn.texts[0]], self.seed))[0]
        longest = max(map(len, labels.values()))
        labels["copy seed"] = resting(ours[:1], longest)
        labels["true frames"] = resting(winners(model.parse(played.frames, seed=self.seed))[0], longest)
        moved = named_block(drawn)
        scores = {
            method: score_masks(labels_THW, resting(played.segmentations, len(labels_THW)), moved)
            for method, labels_THW in labels.items()
        }
        return ObjectOutcome(self.scene, drawn.texts[0], wrong, len(played.frames), scores)


def imagine(model: StudyModel, seen: np.ndarray, texts: Sequence[str], seed: int) -> Rollout:
    """One scene under some texts, as far as the model can look ahead, at most the longest of `LENGTHS`."""
    horizon = min(LENGTHS[-1], model.longest_horizon or LENGTHS[-1])
    return model.rollout(model.parse(seen[None], seed=seed), list(texts), horizon=horizon, seed=seed)


def named_block(drawn: Drawn) -> int:
    """The segmentation's value of the block that the scene's own instruction names."""
    (pair,) = parse_instruction(drawn.texts[0])
    return 2 + next(  # labels 0 and 1 are background and arm
        item["id"] for item in drawn.info["objects"] if (item["kind"], item["color"]) == ("block", pair.block)
    )


def winners(rollout: Rollout) -> np.ndarray:
    """The slot that wins each pixel, (B, T, H, W)."""
    return slot_labels(rollout.masks)


def resting(film: np.ndarray, frames: int) -> np.ndarray:
    """The first so many frames of a film; where it is shorter, its last frame stands still."""
    return film[np.minimum(np.arange(frames), len(film) - 1)]
