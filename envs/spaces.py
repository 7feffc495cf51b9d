"""Action and observation spaces of the environments."""

from __future__ import annotations

import string
from math import pi
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .geometry import Box2
from .physics.motion import MAX_SPEED, MAX_TURN

EXTRAS = ("depth", "segmentation", "proprio")  # observations beside `rgb` and `instruction`, on request

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


def observation_space(size: int, far: float, longest: int, extras: tuple[str, ...]) -> spaces.Dict:
    """Images of ``size`` with depths up to ``far`` metres, and sentences of up to ``longest`` characters."""
    parts: dict[str, spaces.Space[Any]] = {
        "rgb": spaces.Box(0, 255, (size, size, 3), np.uint8),
        "instruction": spaces.Text(longest, min_length=1, charset=CHARSET),
    }
    possible: dict[str, spaces.Space[Any]] = {
        "depth": spaces.Box(0, np.float32(far) * 1.001, (size, size), np.float32),
        "segmentation": spaces.Box(0, 255, (size, size), np.uint8),
        "goal_rgb": spaces.Box(0, 255, (size, size, 3), np.uint8),
        "proprio": spaces.Box(-10, 10, (11,), np.float32),
    }
    return spaces.Dict(parts | {name: space for name, space in possible.items() if name in extras})
