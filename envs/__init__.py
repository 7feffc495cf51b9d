"""Tabletop environments: a robot arm puts blocks into bowls, told by a sentence.

Importing this package registers ``PutBlockInBowl-v0`` and ``PutBlocksInBowls-v0`` with Gymnasium; without an
import, ``gymnasium.make("envs:PutBlockInBowl-v0")`` does the same.
"""

from gymnasium.envs.registration import register

from envs.expert import Expert
from envs.language import ColorPair, format_instruction, parse_instruction
from envs.tabletop import PutBlockInBowl, PutBlocksInBowls

# The environments truncate by themselves, because their limits depend on the control mode.
register(id="PutBlockInBowl-v0", entry_point="envs.tabletop:PutBlockInBowl")
register(id="PutBlocksInBowls-v0", entry_point="envs.tabletop:PutBlocksInBowls")

__all__ = [
    "ColorPair",
    "Expert",
    "PutBlockInBowl",
    "PutBlocksInBowls",
    "format_instruction",
    "parse_instruction",
]
