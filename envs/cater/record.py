"""Clips of CATER-hard for `envs.dataset`: what `python -m envs.collect --world cater` writes."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..dataset import ARRAYS, TEXT, Arrays, Columns, World, versions
from ..physics.camera import Camera
from ..splits import SPLITS
from .scenes import ACTIONS, COLORS, FRAMES, MATERIALS, SIZES, Clip, draw_clip
from .world import CAMERA, OVERSAMPLING, Table

Captions = Literal["explicit", "ambiguous"]
LABELS = {"background": 0}  # thing i has the label 1 + i
WORDS = "the is rotating sliding to picked up and placed containing snitch gold quadrant first second third fourth"


@dataclass(frozen=True)
class RecordedClip:
    """One clip as it is written."""

    seed: int
    instruction: str
    clip: Clip
    arrays: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class CaterConfig(World):
    """What, beside the seed, decides the content of a clip.

    Attributes:
        split: a name of `SPLITS`; "train", "val" and "test" differ in their seeds alone.
        image_size: height and width, in pixels.
        captions: explicit ones name every attribute and the cell, ambiguous ones some attributes and the quadrant.
    """

    split: str
    image_size: int = 64
    captions: Captions = "explicit"
    world: str = "cater"

    def make(self) -> Table:
        return Table(self.image_size)

    def record(self, table: Table, numbers: range) -> Iterator[RecordedClip]:
        for number in numbers:
            seed = SPLITS[self.split].seed(number)
            clip, jitter = clip_of(seed)
            frames, labels = table.film(clip, jitter)
            poses = [clip.poses(frame) for frame in range(FRAMES)]
            said = clip.instruction
            if self.captions == "ambiguous":
                said = clip.ambiguous(np.random.default_rng([seed, 3]))
            position, orientation = (np.stack(part).astype(np.float32) for part in zip(*poses, strict=True))
            arrays: list[NDArray[Any]] = [frames, labels, position, orientation]
            yield RecordedClip(seed, said, clip, dict(zip(self.arrays, arrays, strict=True)))

    @property
    def arrays(self) -> Arrays:
        return {name: ARRAYS[name] for name in ("frames", "segmentation", "object_position", "object_orientation")}

    @property
    def columns(self) -> Columns:
        return {
            "length": ("i8", lambda recorded: FRAMES),
            "seed": ("i8", lambda recorded: recorded.seed),
            "instruction": (TEXT, lambda recorded: recorded.instruction),
            "objects": (TEXT, lambda recorded: json.dumps(_objects(recorded.clip))),
            "actions": (TEXT, lambda recorded: json.dumps([asdict(act) for act in recorded.clip.acts])),
        }

    @property
    def attributes(self) -> dict[str, Any]:
        camera = Camera(CAMERA, self.image_size, OVERSAMPLING)
        numbers = [str(n) for n in (-3, -2, -1, 1, 2, 3)]
        vocabulary = [*WORDS.split(), *SIZES, *MATERIALS, *COLORS, *ACTIONS, *numbers]
        return {
            "versions": json.dumps(versions("pybullet", "numpy", "h5py")),
            "vocabulary": json.dumps(list(dict.fromkeys(vocabulary))),
            "labels": json.dumps(LABELS),
            "camera_intrinsics": camera.intrinsics,
            "camera_extrinsics": camera.extrinsics,
        }


def clip_of(seed: int) -> tuple[Clip, NDArray[np.float64]]:
    """The clip with this seed, and how far its light is off its place (3,)."""
    rng = np.random.default_rng([seed, 4])
    return draw_clip(rng), rng.uniform(-1, 1, 3)


def _objects(clip: Clip) -> list[dict[str, Any]]:
    return [
        {"id": number, "label": 1 + number, "kind": thing.shape}
        | {name: getattr(thing, name) for name in ("color", "size", "material")}
        for number, thing in enumerate(clip.things)
    ]
