"""The scripted expert: it knows where everything is, and plays any instruction the scene allows."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from .physics.motion import pick_and_place
from .physics.supports import supports
from .scene import GoalPair
from .spaces import primitive_space
from .tabletop import TabletopEnv
from .tasks.rearrange import Rearrange, Supports, arrangement_after


class Expert:
    """Plays a `TabletopEnv`, in either control mode, wrapped or not, with the simulator's own knowledge.

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
        By default the instruction is the scene's own.

        Raises:
            ValueError: at once, when the instruction cannot be read or names a thing that is not there.
        """
        scene, task = self._env.scene, self._env.task
        if instruction is not None:
            return self._play(task.find_goal(scene.objects, task.parse(instruction)))
        return self._play(self.search() if isinstance(task, Rearrange) else scene.goal)

    def search(self, budget: int = 40) -> tuple[GoalPair, ...]:
        """Sentences that lead to the goal of a `RearrangeBlocks-v0`, tried in a copy of the scene.

        A plan is searched by what its sentences should lead to, and then tried. Where one leads elsewhere, that is
        kept in mind and a new plan is made, until one succeeds or ``budget`` sentences were tried. Then it is what was
        tried last; with no plan at all, nothing.
        """
        env, task = self._env, self._env.task
        assert isinstance(task, Rearrange)
        surprises: dict[tuple[Supports, GoalPair], Supports] = {}
        start, plan, twin = supports(env.world, env.robot), None, env.copy()
        while budget > 0 and (plan := task.solve(env.scene, start, surprises)):
            state, tried = start, 0
            for sentence in plan:
                for action in Expert(twin)._play((sentence,)):
                    twin.step(action)
                before, state, tried = state, supports(twin.world, twin.robot), tried + 1
                if state != surprises.get((before, sentence), arrangement_after(before, sentence)):
                    surprises[before, sentence] = state
                    break
            budget, plan = budget - tried, plan[:tried]
            if task.succeeded(twin.world, twin.robot, env.scene):
                break
            twin.follow(env)
        twin.close()
        return plan or ()

    def primitive(self, pair: GoalPair) -> NDArray[np.float32]:
        """`[pick_x, pick_y, place_x, place_y]` (metres) that carries out one pair of a goal."""
        world = self._env.world
        place = self._env.task.relation(pair).place(world, pair)
        values = np.array([*world.pose(pair.thing)[0][:2], *place], dtype=np.float32)
        # Things can be pushed out of the workspace, where no action may point.
        space = primitive_space(world.setup.workspace, place_yaw=False)
        return np.clip(values, space.low, space.high)

    def _play(self, goal: tuple[GoalPair, ...]) -> Iterator[NDArray[np.float32]]:
        env = self._env
        for pair in goal:
            action = self.primitive(pair)
            if env.control == "primitive":
                yield np.append(action, np.float32(0)) if env.place_yaw else action
            else:  # from the float32 values of a primitive: both modes then move alike to the last bit
                x, y, place_x, place_y = action.tolist()
                yield from pick_and_place(env.robot, (x, y), (place_x, place_y))
