"""The scenes of the studies, sampled by the environments from the seeds of a split: no data file is needed."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from envs import Expert
from envs.splits import SPLITS
from planning import Instruction, Thing

LONG_GOALS = {"two_steps": 2, "three_steps": 3}  # scenes of `test` seeds whose goals have 2 and 3 pairs
SCENES_PER_SEED = 10_000


@dataclass(frozen=True)
class StudyScene:
    """One scene of a split."""

    split: str  # its name, one of the environments' splits or of `LONG_GOALS`
    seed: int  # of the environment
    options: tuple[tuple[str, Any], ...]  # for `reset`; sorted items, so that a scene can be compared and hashed
    steps: int = 1  # pairs of the goal
    look: str = "simple"  # what it looks like: `scene` of the environment
    image_size: int = 64
    env_id: str = ""  # by default the one for goals of so many steps

    def make(self, record: bool = True) -> gym.Env[Any, Any]:
        """The environment it is played in, which may record the frames of its motions. Large ones take long to draw."""
        options: dict[str, Any] = {"scene": self.look, "image_size": self.image_size}
        if self.steps > 1:
            options["n_pairs"] = self.steps
        name = self.env_id or ("PutBlockInBowl-v0" if self.steps == 1 else "PutBlocksInBowls-v0")
        return gym.make(name, control="primitive", record_frames=record, **options)


def scene_line(scene: Any) -> str:
    """A scene in a line of `scenes.json`."""
    return json.dumps(asdict(scene), default=str)


def scene_hash(scene: Any) -> str:
    """12 hexadecimal digits that name a scene: of the SHA-256 of its line."""
    return hashlib.sha256(scene_line(scene).encode()).hexdigest()[:12]


def place_of(scene: StudyScene, variant: int = 0) -> str:
    """Where an episode counts: `place` of `EpisodeLine`."""
    return f"{scene.split}, {f'variant {variant}' if variant else 'original'}"


def study_scenes(split: str, count: int, seed: int, look: str = "simple", image_size: int = 64) -> list[StudyScene]:
    """`count` scenes of a split; each `seed` chooses other ones. Look and size: see `StudyScene`.

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
    scenes = []
    for i in range(count):
        one = source.seed(SCENES_PER_SEED * seed + first + i)
        options = source.options(one) if steps == 1 else {"n_objects": 6, "color_split": "seen"}
        scenes.append(StudyScene(split, one, tuple(sorted(options.items())), steps, look, image_size))
    return scenes


@dataclass(frozen=True, eq=False)
class SampledScene:
    """A scene as the environment sampled it."""

    scene: StudyScene  # which
    observation: Mapping[str, Any]  # of its reset
    info: Mapping[str, Any]  # of its reset
    texts: tuple[str, ...]  # its own instruction, then the variants

    def options(self, variant: int) -> dict[str, Any]:
        """`reset` options that, with the scene's seed, build it again with its `variant`-th text."""
        if variant == 0:
            return dict(self.scene.options)
        # Another instruction would sample another scene from the same seed, so the objects are given.
        return {"layout": self.info["objects"], "instruction": self.texts[variant]}

    @property
    def named_block(self) -> int:
        """The segmentation's value of the block that the scene's own instruction names."""
        thing = Instruction.parse(self.texts[0]).thing
        return next(item["label"] for item in self.info["objects"] if Thing(item["color"], item["kind"]) == thing)

    def others(self, thing: Thing) -> list[Thing]:
        """The scene's other things of the same kind, sorted."""
        things = [Thing(item["color"], item["kind"]) for item in self.info["objects"]]
        return sorted(other for other in things if other.kind == thing.kind and other != thing)


def sample_scene(env: gym.Env[Any, Any], scene: StudyScene, variants: int = 0) -> SampledScene:
    """Sample a scene, and name other target bowls for its block.

    Which `variants` bowls and in which order is a function of the scene's seed alone. `env` is from `scene.make()`.

    Raises:
        ValueError: if the scene has too few bowls for that many variants.
    """
    observation, info = env.reset(seed=scene.seed, options=dict(scene.options))
    sampled = SampledScene(scene, observation, info, (info["instruction"],))
    if not variants:
        return sampled
    own = Instruction.parse(sampled.texts[0])
    others = sampled.others(own.target)
    if len(others) < variants:
        raise ValueError(f"seed {scene.seed} has {len(others)} other bowls, not {variants}")
    order = np.random.default_rng([scene.seed, 2]).permutation(len(others))[:variants]
    return replace(sampled, texts=(own.text, *(replace(own, target=others[i]).text for i in order)))


def wrong_text(sampled: SampledScene) -> str:
    """A sentence about the scene that names another block and another bowl than its own, as far as there are any.

    A scene always has another block or another bowl. Which is named is a function of the scene's seed alone.
    """
    own = Instruction.parse(sampled.texts[0])
    rng = np.random.default_rng([sampled.scene.seed, 3])
    named = []
    for thing in own.things:
        others = sampled.others(thing)
        named.append(others[int(rng.integers(len(others)))] if others else thing)
    return Instruction(own.relation, *named).text


@dataclass(frozen=True, eq=False)
class ExpertEpisode:
    """What the scripted expert did."""

    frames: np.ndarray  # (T, H, W, 3) uint8, from the first observation on
    segmentations: np.ndarray  # (T, H, W): 0 background, 1 arm, 2 + i object i
    success: bool  # the simulator's verdict
    gained: float  # by how much the share of the goal that holds rose


def play_expert(
    env: gym.Env[Any, Any], sampled: SampledScene, variant: int = 0, order: Sequence[str | None] = (None,)
) -> ExpertEpisode:
    """Let the scripted expert do what `order` says, by default the text that the simulator judges, the `variant`-th."""
    _, info = env.reset(seed=sampled.scene.seed, options=sampled.options(variant))
    frames, segmentations, gained = [info["frames"]], [info["frame_segmentations"]], 0.0
    for text in order:
        for action in Expert(env).actions(text):
            _, reward, _, _, info = env.step(action)
            frames.append(info["frames"])
            segmentations.append(info["frame_segmentations"])
            gained += float(reward)
    success = bool(info["is_success"])
    return ExpertEpisode(np.concatenate(frames), np.concatenate(segmentations), success, round(gained, 6))
