"""Action and observation spaces of the environments."""

import string
from collections.abc import Iterable, Sequence
from math import pi
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .checks import check_choice
from .geometry import Box2
from .goals import GOALS, STATE_SIZE, goal_sizes
from .physics.motion import MAX_SPEED, MAX_TURN
from .tasks import Task

EXTRAS = ("depth", "segmentation", "proprio", "state", "goal", *GOALS)  # observations on request

CHARSET = string.ascii_lowercase + " "
"""Characters an instruction is made of. Gymnasium's default charset for ``Text`` lacks the space."""

EE_NAMES = ("dx", "dy", "dz", "dyaw", "suction")
PRIMITIVE_NAMES = ("pick_x", "pick_y", "place_x", "place_y", "yaw")


def primitive_space(workspace: Box2, place_yaw: bool) -> spaces.Box:
    """`[pick_x, pick_y, place_x, place_y]` in metres of the world frame, and with ``place_yaw`` radians."""
    low = [workspace.x[0], workspace.y[0]] * 2 + [-pi] * place_yaw
    high = [workspace.x[1], workspace.y[1]] * 2 + [pi] * place_yaw
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


def ee_space(frame_time: float) -> spaces.Box:
    """`[dx, dy, dz, dyaw, suction]`: metres and radians within a frame of ``frame_time`` seconds."""
    high = np.array([MAX_SPEED * frame_time] * 3 + [MAX_TURN * frame_time, 1], dtype=np.float32)
    low = np.array([*-high[:4], 0], dtype=np.float32)
    return spaces.Box(low, high, dtype=np.float32)


def check_action(space: spaces.Box, action: Any) -> NDArray[np.float32]:
    """The action as float32; ValueError when it is not a finite element of ``space``."""
    try:
        values = np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError):
        values = np.empty(0, dtype=np.float32)
    if values.shape == space.shape and np.isfinite(values).all() and space.contains(values):
        return values
    # Only the tool motion has a signed first component.
    names = EE_NAMES if space.low[0] < 0 else PRIMITIVE_NAMES
    raise ValueError(
        f"{action!r} is not in the action space: [{', '.join(names[: space.low.size])}], finite numbers "
        f"from {space.low.tolist()} to {space.high.tolist()}"
    )


def read_observations(
    observations: str | Sequence[str] | None, extras: str | Sequence[str], always: tuple[str, ...]
) -> tuple[str, ...]:
    """The names of all observations; ValueError for one that there is not."""
    extras = (extras,) if isinstance(extras, str) else extras
    if not isinstance(extras, Iterable) or not isinstance(observations, str | Iterable | None):
        raise ValueError("extras and observations are names, or lists of names")
    for extra in extras:
        check_choice("extras", extra, EXTRAS)
    if observations is not None:
        names = (observations,) if isinstance(observations, str) else tuple(observations)
        for name in names:
            check_choice("observation", name, (*always, *EXTRAS))
        if not names or extras:
            raise ValueError("observations names all that there shall be, at least one, and goes without extras")
        return tuple(dict.fromkeys(names))
    goals = ("goal", *GOALS) if "goal" in extras else ()
    return (*always, *(name for name in EXTRAS if name in (*extras, *goals)))


def observation_space(size: int, far: float, task: Task, names: tuple[str, ...]) -> spaces.Dict:
    """Of the observations with these names: images of ``size`` with depths up to ``far`` metres, and a task's goals."""
    numbers = goal_sizes(task) | {"state": STATE_SIZE, "proprio": 11}
    boxes: dict[str, spaces.Space[Any]] = {
        name: spaces.Box(-10, 10, (length,), np.float32) for name, length in numbers.items()
    }
    possible = boxes | {
        "rgb": spaces.Box(0, 255, (size, size, 3), np.uint8),
        "instruction": spaces.Text(task.longest_sentence, min_length=1, charset=CHARSET),
        "depth": spaces.Box(0, np.float32(far) * 1.001, (size, size), np.float32),
        "segmentation": spaces.Box(0, 255, (size, size), np.uint8),
        "goal_rgb": spaces.Box(0, 255, (size, size, 3), np.uint8),
    }
    return spaces.Dict({name: possible[name] for name in names})
