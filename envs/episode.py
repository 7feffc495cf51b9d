"""One recorded episode, and how it is made from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import envs
from envs.splits import SPLITS

ENV_ID = "PutBlockInBowl-v0"


@dataclass(frozen=True)
class EpisodeConfig:
    """What, beside the seed, decides the content of an episode."""

    split: str
    image_size: int = 64
    camera: str = "close"
    object_scale: float = 1.0
    render_stride: int = 16
    physics_hz: int = 240

    def make(self) -> gym.Env[Any, Any]:
        """The environment that plays such episodes."""
        return gym.make(
            ENV_ID,
            image_size=self.image_size,
            camera=self.camera,
            object_scale=self.object_scale,
            render_stride=self.render_stride,
            physics_hz=self.physics_hz,
            record_frames=True,
        )


@dataclass(frozen=True)
class RecordedEpisode:
    """An expert's episode of T frames; frame 0 is what `reset` showed."""

    seed: int
    instruction: str
    objects: tuple[tuple[str, str], ...]
    """(kind, color) by object id."""
    target: tuple[int, int]
    """(block id, bowl id)."""
    success: bool
    frames: NDArray[np.uint8]
    """(T, H, W, 3)"""
    segmentation: NDArray[np.uint8]
    """(T, H, W)"""
    arm: NDArray[np.float32]
    """(T, 6) joint angles, radians."""
    gripper: NDArray[np.float32]
    """(T, 5): x, y, z, yaw, holding."""
    position: NDArray[np.float32]
    """(T, n, 3) metres."""
    orientation: NDArray[np.float32]
    """(T, n, 4) quaternions x y z w."""


def record_episode(env: gym.Env[Any, Any], config: EpisodeConfig, episode: int) -> RecordedEpisode:
    """Let the expert play episode number ``episode`` of the split in an environment of `EpisodeConfig.make`.

    A function of the configuration and the number alone, whatever the environment did before.
    """
    split = SPLITS[config.split]
    seed = split.seed(episode)
    _, info = env.reset(seed=seed, options=split.options(seed))
    block, bowl = (int(value) for value in info["target"][0])
    infos = [info]
    for action in envs.Expert(env).actions():
        infos.append(env.step(action)[4])
    states = [each["frame_states"] for each in infos]

    def joined(name: str) -> NDArray[np.float32]:
        return np.concatenate([state[name] for state in states])

    return RecordedEpisode(
        seed=seed,
        instruction=info["instruction"],
        objects=tuple((item["kind"], item["color"]) for item in info["objects"]),
        target=(block, bowl),
        success=bool(infos[-1]["is_success"]),
        frames=np.concatenate([each["frames"] for each in infos]),
        segmentation=np.concatenate([each["frame_segmentations"] for each in infos]),
        arm=joined("arm"),
        gripper=joined("gripper"),
        position=joined("object_position"),
        orientation=joined("object_orientation"),
    )
