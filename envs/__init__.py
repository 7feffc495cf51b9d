"""Tabletop environments: a robot arm does what a sentence asks.

Importing this package registers ``PutBlockInBowl-v0``, ``PutBlocksInBowls-v0`` and ``RearrangeBlocks-v0`` with
Gymnasium; without an import, ``gymnasium.make("envs:PutBlockInBowl-v0")`` does the same.
"""

from gymnasium.envs.registration import register

from envs.dataset import scene_of
from envs.expert import Expert
from envs.tabletop import TabletopEnv
from envs.tasks import TASKS
from envs.video import RecordVideo

# The environments truncate by themselves, because their limits depend on the control mode.
for env_id, task in (
    ("PutBlockInBowl-v0", "put_block_in_bowl"),
    ("PutBlocksInBowls-v0", "put_blocks_in_bowls"),
    ("RearrangeBlocks-v0", "rearrange_blocks"),
):
    register(id=env_id, entry_point="envs.tabletop:TabletopEnv", kwargs={"task": task})

__all__ = ["TASKS", "Expert", "RecordVideo", "TabletopEnv", "scene_of"]
