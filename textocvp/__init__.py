"""TextOCVP: a world model that imagines, object by object, what a sentence does to a scene.

`WorldModel` loads a checkpoint and takes an observation and a text; the `Rollout` it returns holds what was
imagined.

The environments and the planner are installed as `textocvp.envs` and `textocvp.planning`. In a checkout these are the
folders ``envs/`` and ``planning/`` beside this one, with both names: use one of the two in a program.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from textocvp.rollout import Rollout
    from textocvp.world_model import WorldModel

if not (Path(__file__).parent / "envs").is_dir():  # a checkout, and no wheel
    __path__.append(str(Path(__file__).resolve().parents[1]))


def __getattr__(name: str) -> Any:
    # Torch is imported when a model is wanted: the processes of an environment do without.
    if name == "Rollout":
        from textocvp import rollout

        return rollout.Rollout
    if name == "WorldModel":
        from textocvp import world_model

        return world_model.WorldModel
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["Rollout", "WorldModel"]
