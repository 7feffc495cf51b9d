"""The scenes of the studies, drawn by the environments from the seeds of a split: no data file is needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from envs import Expert, format_instruction, parse_instruction
from envs.splits import SPLITS


@dataclass(frozen=True)
class TestScene:
    """One scene of a split.

    Attributes:
        split: its name. `two_steps` and `three_steps` are scenes of `test` seeds whose goals have 2 and 3
            pairs.
        seed: of the environment.
        options: for `reset`; sorted items, so that a scene can be compared and hashed.
        steps: pairs of the goal.
    """

    __test__ = False  # not a test, whatever pytest reads into its name

    split: str
    seed: int
    options: tuple[tuple[str, Any], ...]
    steps: int = 1

    def make(self) -> gym.Env[Any, Any]:
        """The environment it is played in, which records the frames of its motions."""
        if self.steps == 1:
            return gym.make("PutBlockInBowl-v0", control="primitive", record_frames=True)
        return gym.make("PutBlocksInBowls-v0", control="primitive", record_frames=True, n_pairs=self.steps)


@dataclass(frozen=True)
class LoopColumn:
    """A column of the closed loop's table: a split, and which variant of its instructions."""

    name: str
    split: str
    variant: int = 0


LOOP_COLUMNS = (
    LoopColumn("original", "controllability", 0),
    LoopColumn("variant 1", "controllability", 1),
    LoopColumn("variant 2", "controllability", 2),
    LoopColumn("variant 3", "controllability", 3),
    LoopColumn("unseen colours", "unseen_colors"),
    LoopColumn("8 objects", "more_objects"),
    LoopColumn("two steps", "two_steps"),
    LoopColumn("three steps", "three_steps"),
)
LONG_GOALS = {"two_steps": 2, "three_steps": 3}
SCENES_PER_SEED = 10_000


def test_scenes(split: str, count: int, seed: int) -> list[TestScene]:
    """`count` scenes of a split; each `seed` chooses other ones.

    Raises:
        ValueError: if there is no such split.
    """
    if split in LONG_GOALS:
        # Seeds of the test split that no other study uses.
        source, steps, first = SPLITS["test"], LONG_GOALS[split], 1_000 * LONG_GOALS[split]
    elif split in SPLITS:
        source, steps, first = SPLITS[split], 1, 0
    else:
        raise ValueError(f"unknown split {split!r}; known: {', '.join([*SPLITS, *LONG_GOALS])}")
    seeds = [source.seed(SCENES_PER_SEED * seed + first + i) for i in range(count)]
    plain = {"n_objects": 6, "color_split": "seen"}
    options = [source.options(one) if steps == 1 else plain for one in seeds]
    return [
        TestScene(split, one, tuple(sorted(option.items())), steps)
        for one, option in zip(seeds, options, strict=True)
    ]


test_scenes.__test__ = False  # type: ignore[attr-defined]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A scene as it was drawn.

    Attributes:
        scene: which.
        observation, info: of its reset.
        texts: its own instruction, then the variants.
    """

    scene: TestScene
    observation: Mapping[str, Any]
    info: Mapping[str, Any]
    texts: tuple[str, ...]

    def options(self, variant: int) -> dict[str, Any]:
        """`reset` options that, with the scene's seed, build it again with its `variant`-th text."""
        if variant == 0:
            return dict(self.scene.options)
        # Another instruction would draw another scene from the same seed, so the objects are given.
        return {"layout": self.info["objects"], "instruction": self.texts[variant]}


def draw(env: gym.Env[Any, Any], scene: TestScene, variants: int = 0) -> Drawn:
    """Draw a scene, and name other target bowls for its block.

    Which bowls and in which order is a function of the scene's seed alone.

    Args:
        env: from `scene.make()`.
        variants: how many other target bowls to name.

    Raises:
        ValueError: if the scene has too few bowls for that many variants.
    """
    observation, info = env.reset(seed=scene.seed, options=dict(scene.options))
    texts = [info["instruction"]]
    if variants:
        (pair,) = parse_instruction(texts[0])
        bowls = [item["color"] for item in info["objects"] if item["kind"] == "bowl"]
        others = sorted(color for color in bowls if color != pair.bowl)
        if len(others) < variants:
            raise ValueError(f"seed {scene.seed} has {len(others)} other bowls, not {variants}")
        chosen = np.random.default_rng([scene.seed, 2]).permutation(others)[:variants].tolist()
        texts += [format_instruction([(pair.block, bowl)]) for bowl in chosen]
    return Drawn(scene, observation, info, tuple(texts))


def wrong_text(drawn: Drawn) -> str:
    """A sentence about the scene that names another block and another bowl than its own, as far as there are any.

    A scene always has another block or another bowl. Which is named is a function of the scene's seed alone.
    """
    (pair,) = parse_instruction(drawn.texts[0])
    rng = np.random.default_rng([drawn.scene.seed, 3])
    named = {}
    for kind, own in (("block", pair.block), ("bowl", pair.bowl)):
        colors = sorted(item["color"] for item in drawn.info["objects"] if item["kind"] == kind)
        others = [color for color in colors if color != own]
        named[kind] = others[int(rng.integers(len(others)))] if others else own
    return format_instruction([(named["block"], named["bowl"])])


@dataclass(frozen=True, eq=False)
class Played:
    """What the expert did.

    Attributes:
        frames: (T, H, W, 3) uint8, from the first observation on.
        segmentations: (T, H, W): 0 background, 1 arm, 2 + i object i.
        success: the simulator's verdict. steps: pick-and-places.
    """

    frames: np.ndarray
    segmentations: np.ndarray
    success: bool
    steps: int


def play(env: gym.Env[Any, Any], drawn: Drawn, variant: int = 0) -> Played:
    """Let the scripted expert carry out one of the scene's texts."""
    _, info = env.reset(seed=drawn.scene.seed, options=drawn.options(variant))
    frames, segmentations, steps = [info["frames"]], [info["frame_segmentations"]], 0
    for action in Expert(env).actions():
        info = env.step(action)[-1]
        frames.append(info["frames"])
        segmentations.append(info["frame_segmentations"])
        steps += 1
    return Played(np.concatenate(frames), np.concatenate(segmentations), bool(info["is_success"]), steps)
