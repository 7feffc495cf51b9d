"""Tabletop environments: a robot arm does what a sentence asks.

Importing this package registers ``PutBlockInBowl-v0``, ``PutBlocksInBowls-v0`` and ``RearrangeBlocks-v0`` with
Gymnasium; without an import, ``gymnasium.make("textocvp.envs:PutBlockInBowl-v0")`` does the same from anywhere, and
``"envs:PutBlockInBowl-v0"`` in a checkout.
"""

from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register, registry

from .expert import Expert
from .tabletop import TabletopEnv
from .tasks import TASKS
from .video import RecordVideo

if TYPE_CHECKING:
    from .dataset import scene_of

# The environments truncate by themselves, because their limits depend on the control mode.
for env_id, task in (
    ("PutBlockInBowl-v0", "put_block_in_bowl"),
    ("PutBlocksInBowls-v0", "put_blocks_in_bowls"),
    ("RearrangeBlocks-v0", "rearrange_blocks"),
):
    if env_id not in registry:  # by this package under its other name
        register(
            id=env_id,
            entry_point=f"{__name__}.tabletop:TabletopEnv",
            # Gymnasium's checker of first calls fails at the first step when the first reset was refused for a wrong
            # option and then put right. The tests check more, with `check_env`.
            disable_env_checker=True,
            kwargs={"task": task},
        )


def __getattr__(name: str) -> Any:
    if name != "scene_of":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .dataset import scene_of  # and with it h5py and joblib, which nothing else here needs

    return scene_of


__all__ = ["TASKS", "Expert", "RecordVideo", "TabletopEnv", "scene_of"]
