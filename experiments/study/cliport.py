"""Episodes that are CLIPort's or look so: where they come from, and by what an imagined sentence succeeds."""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch

from envs.dataset import EpisodeConfig, record_episode
from envs.splits import SPLITS
from envs.tabletop import TabletopEnv
from experiments.study.pool import Worker
from experiments.study.scenes import StudyScene
from planning import THRESHOLDS, Instruction, PinholeCamera, Thing
from planning.masks import centroids
from textocvp.data.episodes import Episode, EpisodeObject, Episodes
from textocvp.metrics import object_ious


@dataclass(frozen=True, eq=False)
class Recorded:
    """An episode in a file."""

    opened: Episodes
    index: int
    split: str
    name: str


Source = Recorded | StudyScene  # an episode in a file, or a scene of our own in which our expert plays one


def read(source: Source, worker: Worker) -> Episode:
    """All of an episode, its sentence in our own wording."""
    if isinstance(source, Recorded):
        episode = source.opened.episode(source.index)
        return replace(episode, instruction=Instruction.parse(episode.instruction).text)
    env = cast(TabletopEnv, worker.environment(source).unwrapped)
    number = source.seed - SPLITS[source.split].first_seed
    played = record_episode(env, EpisodeConfig(source.split), number)
    camera, arrays = env.world.camera, played.arrays
    return Episode(
        frames=arrays["frames"], instruction=played.instruction, segmentation=arrays["segmentation"],
        objects=tuple(EpisodeObject(**item) for item in played.objects), position=arrays["object_position"],
        intrinsics=camera.intrinsics, extrinsics=camera.extrinsics,
    )  # fmt: skip


def misses(labels_THW: np.ndarray, truth: Episode, asked: Instruction) -> np.ndarray | None:
    """How far from the named bowl the named block comes to lie, by CLIPort's criterion.

    The block starts at its true place and is moved as the masks of the slot that has it in the first frame: through
    the camera, from the height at which it stood to the height at which it comes to lie. The bowl's place is where it
    stood at the start, as in CLIPort.

    Returns:
        (t,) metres in the plane, in each of the last frames; inf where no pixel shows the block. None where the truth
        is not known, or a name fits no object or several.
    """
    block, bowl = ([o for o in truth.objects if Thing(o.color, o.kind) == thing] for thing in asked.things)
    segmentation, places, K, E = truth.segmentation, truth.position, truth.intrinsics, truth.extrinsics
    if len(block) != 1 or len(bowl) != 1 or segmentation is None or places is None or K is None or E is None:
        return None
    matched = object_ious(labels_THW[0], segmentation[0], [o.label for o in truth.objects], min_pixels=1)
    slot = max(matched.slots[matched.ids == block[0].label], default=-1)
    start, end = places[[0, -1], block[0].id]
    camera = PinholeCamera(K, E)

    def place(labels_HW: np.ndarray, height: float) -> np.ndarray:
        center = centroids(torch.from_numpy(labels_HW == slot)).numpy()
        return np.full(2, np.nan) if np.isnan(center).any() else camera.unproject_to_plane(center, height)[:2]

    offset = place(labels_THW[0], float(start[2])) - start[:2]
    last = np.stack([place(labels, float(end[2])) for labels in labels_THW[-THRESHOLDS.settle_frames :]])
    return np.nan_to_num(np.linalg.norm(last - offset - places[0, bowl[0].id, :2], axis=1), nan=np.inf)


def other_sentences(truth: Episode, asked: Instruction) -> tuple[list[Instruction], Instruction]:
    """The sentence with each other bowl of the scene; and one with another block and another bowl, if there are any."""
    things = sorted({Thing(o.color, o.kind) for o in truth.objects})
    blocks, bowls = ([t for t in things if t.kind == one.kind and t != one] for one in asked.things)
    wrong = replace(asked, thing=[*blocks, asked.thing][0], target=[asked.target, *bowls][-1])
    return [replace(asked, target=bowl) for bowl in bowls], wrong
