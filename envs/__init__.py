"""Tabletop environments: a robot arm does what a sentence asks.

Importing this package registers ``PutBlockInBowl-v0``, ``PutBlocksInBowls-v0`` and ``RearrangeBlocks-v0`` with
Gymnasium; without an import, ``gymnasium.make("envs:PutBlockInBowl-v0")`` does the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

from envs.expert import Expert
from envs.tabletop import TabletopEnv
from envs.tasks import TASKS
from envs.video import RecordVideo

if TYPE_CHECKING:
    from envs.dataset import scene_of

# The environments truncate by themselves, because their limits depend on the control mode.
for env_id, task in (
    ("PutBlockInBowl-v0", "put_block_in_bowl"),
    ("PutBlocksInBowls-v0", "put_blocks_in_bowls"),
    ("RearrangeBlocks-v0", "rearrange_blocks"),
):
    register(id=env_id, entry_point="envs.tabletop:TabletopEnv", kwargs={"task": task})


def __getattr__(name: str) -> Any:
    if name != "scene_of":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from envs.dataset import scene_of  # and with it h5py and joblib, which nothing else here needs

    return scene_of


__all__ = ["TASKS", "Expert", "RecordVideo", "TabletopEnv", "scene_of"]
