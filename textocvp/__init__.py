"""TextOCVP: a world model that imagines, object by object, what a sentence does to a scene.

`WorldModel` loads a checkpoint and takes an observation and a text; the `Rollout` it returns holds what was
imagined.
"""

from textocvp.rollout import Rollout
from textocvp.world_model import WorldModel

__all__ = ["Rollout", "WorldModel"]
