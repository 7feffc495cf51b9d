"""CATER's table: no robot, scenes by number, and captions that the simulator carries out as they are said."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from envs.cater import Clip, Table, read_caption
from envs.cater.record import clip_of
from envs.cater.scenes import FRAMES
from envs.splits import SEEDS_PER_SPLIT, SPLITS
from experiments.play.links import Link, Refused
from experiments.study.cater import CaterScene, slots_of_things
from planning import PinholeCamera
from textocvp import Rollout
from textocvp.film_page import slot_names

SPLIT = "test"  # scenes that no model was trained on
CAPTIONS = 8  # that are proposed of a scene


class Cater:
    """A `World` of scenes as they are drawn. Every caption begins from the scene as it is shown."""

    horizon: int | None = FRAMES - 1
    families: tuple[str, ...] = ()

    def __init__(self, image_size: int) -> None:
        self.table = Table(image_size)
        self.link = Link()

    def close(self) -> None:
        """Give the simulator back."""
        self.table.close()

    def show(self, link: Link) -> None:
        """Draw the scene of a link, which has a seed and nothing else."""
        if link != Link(link.seed):
            raise Refused("scenes of this world have a seed, and neither a family nor a layout nor acts")
        if link.seed >= SEEDS_PER_SPLIT:
            raise Refused(f"the seeds of this world are less than {SEEDS_PER_SPLIT}, not {link.seed}")
        seed = SPLITS[SPLIT].seed(link.seed)
        clips = [CaterScene(SPLIT, seed, variant).clip() for variant in range(CAPTIONS)]
        self.link, self.clip, self.jitter = link, clips[0], clip_of(seed)[1]
        self.clips = {clip.instruction: clip for clip in clips}
        self.task = self.clip.instruction
        self.table.build(self.clip, self.jitter)
        self.rgb, self.labels = self.table.render(0)
        names = [thing.name for thing in self.clip.things]  # of which two may be alike
        counts = [names[: k + 1].count(name) for k, name in enumerate(names)]
        self.called = [f"{name} {n}" if n > 1 else name for name, n in zip(names, counts, strict=True)]

    def things(self) -> list[dict[str, Any]]:
        """What is there, and where in the picture."""
        camera = PinholeCamera(self.table.camera.intrinsics, self.table.camera.extrinsics)
        of_all = zip(self.called, self.clip.things, self.clip.poses(0)[0], strict=True)
        return [
            {"name": name, "color": list(thing.rgb), "at": camera.project(center).tolist(), "height": float(center[2])}
            for name, thing, center in of_all
        ]

    def sentences(self, picture: Rollout | None) -> list[str]:
        """The scene's own caption and others; none of a person's own picture, of which nothing is known."""
        return list(self.clips) if picture is None else []

    def names(self, rollout: Rollout, own_picture: bool) -> dict[int, str]:
        """Whose true mask a slot's covers; of a person's own picture there is no truth, and slots have numbers."""
        numbered = slot_names(rollout)
        if own_picture:
            return numbered
        named = {slot: self.called[thing] for thing, slot in slots_of_things(rollout, self.labels).items()}
        return {slot: name for slot, name in numbered.items() if name == "table"} | named

    def read(self, text: str) -> Clip:
        """What happens when a caption is carried out; the same at every time."""
        known = {" ".join(one.split()).lower(): clip for one, clip in self.clips.items()}
        rng = np.random.default_rng([self.link.seed, zlib.crc32(text.encode())])
        return known.get(" ".join(text.split()).lower()) or read_caption(text, self.clip.things, rng)

    def act(self, wish: Clip, rollout: Rollout) -> np.ndarray:
        """The frames of the clip; then the scene stands as before."""
        return self.table.film(wish, self.jitter)[0]
