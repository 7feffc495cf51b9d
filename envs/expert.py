"""The scripted expert: it knows where everything is, and plays any instruction the scene allows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.physics.motion import pick_and_place
from envs.scene import GoalPair
from envs.tabletop import TabletopEnv


class Expert:
    """Plays an environment with the simulator's own knowledge.

    Args:
        env: a `TabletopEnv`, in either control mode, wrapped or not.

    Raises:
        TypeError: for another environment.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        base = env.unwrapped
        if not isinstance(base, TabletopEnv):
            raise TypeError(f"the expert plays a TabletopEnv, not {type(base).__name__}")
        self._env = base

    def actions(self, instruction: str | None = None) -> Iterator[NDArray[np.float32]]:
        """The actions that carry out an instruction, in the environment's control mode.

        Each is to be executed before the next is drawn: ``for action in expert.actions(): env.step(action)``.

        Args:
            instruction: any instruction about this scene; by default the scene's own.

        Raises:
            ValueError: at once, when the instruction cannot be read or names a thing that is not there.
        """
        scene, task = self._env.scene, self._env.task
        goal = scene.goal if instruction is None else task.find_goal(scene.objects, task.parse(instruction))
        return self._play(goal)

    def primitive(self, pair: GoalPair) -> NDArray[np.float32]:
        """`[pick_x, pick_y, place_x, place_y]` (metres) that carries out one pair of a goal."""
        world = self._env.world
        place = self._env.task.relation(pair).place(world, pair)
        values = np.array([*world.pose(pair.thing)[0][:2], *place], dtype=np.float32)
        # Things can be pushed out of the workspace, where no action may point.
        space = world.setup.workspace
        low = np.array([space.x[0], space.y[0]] * 2, dtype=np.float32)
        high = np.array([space.x[1], space.y[1]] * 2, dtype=np.float32)
        return np.clip(values, low, high)

    def _play(self, goal: tuple[GoalPair, ...]) -> Iterator[NDArray[np.float32]]:
        env = self._env
        for pair in goal:
            action = self.primitive(pair)
            if env.control == "primitive":
                yield np.append(action, np.float32(0)) if env.place_yaw else action
            else:
                # Through float32, as a primitive's values pass: both modes then move alike to the last bit.
                pick_x, pick_y, place_x, place_y = map(float, action)
                yield from pick_and_place(env.robot, (pick_x, pick_y), (place_x, place_y))
