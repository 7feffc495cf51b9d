"""Pictures of the object study: imagined masks beside true ones, and every slot drawn alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from experiments.protocol.gallery import pixels
from experiments.protocol.object_scenes import ObjectOutcome, imagine, resting, winners
from experiments.protocol.scenes import Drawn, Played, TestScene, draw, play
from experiments.protocol.workers import Worker
from experiments.reporting import Clip, Figure
from experiments.reporting.clips import gif, paint, segmentation_colors, slot_colors
from experiments.reporting.grids import picture_grid
from planning import Instruction, ground_privileged
from textocvp import Rollout

MOMENTS = (0, 4, 9, 14, 19, 24)  # that a strip shows


@dataclass(frozen=True, eq=False)
class ObjectPictures:
    """A clip, and for some scenes every slot drawn alone."""

    clip: Clip
    apart: Figure | None = None


@dataclass(frozen=True)
class ObjectPicture:
    """A unit of work: draw one scene of the object study.

    Attributes:
        scene, seed: as `ObjectScene`.
        moving: the figure it was chosen for: mean overlap of the named block and the arm.
        rank, best: its place among the best or the worst.
        apart: whether to draw every slot alone as well.
    """

    scene: TestScene
    seed: int
    moving: float
    rank: int
    best: bool
    apart: bool

    def run(self, worker: Worker) -> ObjectPictures:
        """Play and imagine it once more."""
        drawn = draw(worker.environment(self.scene), self.scene)
        played = play(worker.environment(self.scene), drawn)
        rollout = imagine(worker.world_model, drawn.observation["rgb"], drawn.texts[:1], self.seed)
        kind = "best" if self.best else "worst"
        clip = Clip(
            name=f"objects-{kind}-{self.rank}.gif",
            gif=gif(_film(rollout, played, drawn)),
            panels=("imagined", "real"),
            title=drawn.texts[0],
            caption=f"seed {self.scene.seed}; block and arm overlap by {self.moving:.2f}",
            badge=f"{kind} {self.rank}",
            tone="good" if self.best else "bad",
        )
        strip = None
        if self.apart:
            strip = _apart(
                rollout, played, drawn, f"objects-apart-{kind}-{self.rank}.png", f"{kind} {self.rank}"
            )
        return ObjectPictures(clip, strip)


def choose_objects(
    outcomes: Sequence[ObjectOutcome], seed: int, clips: int, apart: int
) -> list[ObjectPicture]:
    """The best and the worst scenes by the overlap of what moves, mean over the whole prediction.

    Args:
        seed: of the slots.
        clips: how many of each kind. apart: of how many of them every slot is drawn alone.
    """
    moving = [float(np.nanmean(outcome.scores["ours"].moving[1:])) for outcome in outcomes]
    order = np.argsort(moving, kind="stable")
    chosen = []
    for best, ranked in ((True, order[::-1]), (False, order)):
        for rank, i in enumerate(ranked[:clips].tolist(), start=1):
            chosen.append(ObjectPicture(outcomes[i].scene, seed, moving[i], rank, best, apart=rank <= apart))
    return chosen


def _film(rollout: Rollout, played: Played, drawn: Drawn) -> list[list[np.ndarray]]:
    """Imagined and real above each other's masks, one colour a thing."""
    objects = len(drawn.info["objects"])
    labels_THW = winners(rollout)[0]
    colors = slot_colors(labels_THW[0], drawn.info["segmentation"], rollout.slots.shape[2], objects)
    real = paint(played.segmentations, segmentation_colors(objects))
    return [[pixels(rollout), played.frames], [paint(labels_THW, colors), real]]


def _apart(rollout: Rollout, played: Played, drawn: Drawn, name: str, title: str) -> Figure:
    """Rows: camera, imagined, then every thing cut out of what is imagined. Columns: moments."""
    times = [t for t in MOMENTS if t < rollout.slots.shape[1]]
    real = resting(played.frames, rollout.slots.shape[1])
    imagined = pixels(rollout)
    objects_tK3HW = rollout.decode_objects(times)[0]
    masks_tKHW = rollout.decode_masks(times)[0]
    rows = {"camera": [real[t] for t in times], "imagined": [imagined[t] for t in times]}
    for thing, slots in _named_slots(rollout, drawn).items():
        rows[thing] = [_cut_out(o[slots], m[slots]) for o, m in zip(objects_tK3HW, masks_tKHW, strict=True)]
    return picture_grid(
        name, list(rows.values()), list(rows), [f"frame {t}" for t in times],
        alt=f"{drawn.texts[0]}: what each slot shows",
        caption=f"{title}: {drawn.texts[0]}. Below the whole frames: each slot drawn alone, by its own mask.",
    )  # fmt: skip


def _named_slots(rollout: Rollout, drawn: Drawn) -> Mapping[str, list[int]]:
    """Names of what the simulator says is there -> slots; only for the picture's labels."""
    truth = ground_privileged(rollout.select(0), drawn.info["segmentation"], drawn.info["objects"])[0]
    told = Instruction.parse(drawn.texts[0])
    named = (told.block_thing, told.bowl_thing)
    things = sorted(truth.things, key=lambda thing: (thing not in named, thing.kind, thing.color))
    slots = {
        f"{t.color} {t.kind}" + (" (named)" if t in named else ""): list(truth.things[t]) for t in things
    }
    slots |= {"arm": list(truth.arm), "table": list(truth.background)}
    return {name: its for name, its in slots.items() if its}


def _cut_out(objects_k3HW: torch.Tensor, masks_kHW: torch.Tensor) -> np.ndarray:
    """Some slots together on nothing: (H, W, 4) uint8, as transparent as the other slots cover them."""
    alpha_HW = masks_kHW.sum(0)
    color_3HW = (objects_k3HW * masks_kHW[:, None]).sum(0) / alpha_HW.clamp_min(1e-6)
    rgba_4HW = torch.cat([color_3HW, alpha_HW[None]]).clamp(0, 1)
    return (rgba_4HW * 255).round().byte().permute(1, 2, 0).cpu().numpy()
