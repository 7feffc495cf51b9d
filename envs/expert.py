"""The scripted expert: it knows where everything is, and plays any instruction the scene allows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.geometry import WORKSPACE
from envs.motion import Action, pick_and_place
from envs.scene import find_goal
from envs.tabletop import PutBlockInBowl


class Expert:
    """Plays an environment with the simulator's own knowledge.

    Args:
        env: a `PutBlockInBowl` or `PutBlocksInBowls`, in either control mode, wrapped or not.

    Raises:
        TypeError: for another environment.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        base = env.unwrapped
        if not isinstance(base, PutBlockInBowl):
            raise TypeError(
                f"the expert plays PutBlockInBowl and PutBlocksInBowls, not {type(base).__name__}"
            )
        self._env = base

    def actions(self, instruction: str | None = None) -> Iterator[NDArray[np.float32]]:
        """The actions that carry out an instruction, in the environment's control mode.

        Each is to be executed before the next is drawn: ``for action in expert.actions(): env.step(action)``.

        Args:
            instruction: any instruction about this scene; by default the scene's own.

        Raises:
            ValueError: at once, when the instruction cannot be read or names a thing that is not there.
        """
        scene = self._env.scene
        goal = scene.goal if instruction is None else find_goal(scene.objects, instruction)
        return self._play(goal)

    def primitive(self, block: int, bowl: int) -> NDArray[np.float32]:
        """`[pick_x, pick_y, place_x, place_y]` (metres) that puts a block into a bowl, by their ids."""
        pick, place = self._env.world.pose(block)[0], self._env.world.pose(bowl)[0]
        values = np.array([*pick[:2], *place[:2]], dtype=np.float32)
        # Things can be pushed out of the workspace, where no action may point.
        low = np.array([WORKSPACE.x[0], WORKSPACE.y[0]] * 2, dtype=np.float32)
        high = np.array([WORKSPACE.x[1], WORKSPACE.y[1]] * 2, dtype=np.float32)
        return np.clip(values, low, high)

    def _play(self, goal: tuple[tuple[int, int], ...]) -> Iterator[NDArray[np.float32]]:
        for block, bowl in goal:
            if self._env.control == "primitive":
                action = self.primitive(block, bowl)
                yield np.append(action, np.float32(0)) if self._env.place_yaw else action
            else:
                yield from self._ee_actions(block, bowl)

    def _ee_actions(self, block: int, bowl: int) -> Iterator[Action]:
        # Through float32, as a primitive's values pass: both modes then move alike to the last bit.
        pick_x, pick_y, place_x, place_y = map(float, self.primitive(block, bowl))
        yield from pick_and_place(self._env.robot, (pick_x, pick_y), (place_x, place_y))
