"""The Gymnasium environment of all tasks: a robot arm, a table with blocks and bowls, and a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .checks import check_choice, check_range
from .factors import Factors
from .goals import BEFORE, GOALS, REWARDS, Reward, compute_reward, goal_vectors, state_vector
from .options import OPTIONS, ResetOptions, Scenes, override, read_options, read_scenes, read_seed
from .physics.arm import Joints
from .physics.motion import Action, pick_and_place
from .physics.recorder import Recorder
from .physics.robot import Robot
from .physics.simulation import FIRST_OBJECT, Tabletop
from .physics.supports import supports
from .scene import Scene
from .scenes import Setup, make_setup
from .spaces import check_action, ee_space, observation_space, primitive_space, read_observations
from .tasks import TASKS, Task

Observation = dict[str, Any]
Control = Literal["primitive", "ee"]
EE_SECONDS = 5 / 3  # time for each attempt in "ee" mode; a pick-and-place takes 1.6 s
MAX_SETTLE_STEPS = 120


class TabletopEnv(gym.Env[Observation, NDArray[np.float32]]):
    """Do what one sentence asks, with a suction gripper.

    ## Description
    The task says which sentences there are and when they are fulfilled: "put_block_in_bowl"
    (`PutBlockInBowl-v0`: put the named block into the named bowl), "put_blocks_in_bowls"
    (`PutBlocksInBowls-v0`: 2 or 3 blocks, each into its bowl), "rearrange_blocks" (`RearrangeBlocks-v0`: blocks
    into bowls and onto blocks, in scenes where what a sentence leads to is not always what it says). A goal is a
    list of (thing, target) pairs or, in `RearrangeBlocks-v0`, a picture.

    ## Observation
    A dict: `rgb` (H, W, 3) uint8 and `instruction` (text). With ``extras``: `depth` (H, W) float32 in metres,
    `segmentation` (H, W) uint8 (0 table, 1 arm, 2 + i object i), `proprio` (11,) float32 (6 joint angles in
    radians; tip x, y, z in metres; yaw in radians; 1 if something is held), and for policies that read no sentence and
    see no picture `state` (133,) float32 (the gripper and all objects, see `envs.goals.state_vector`) and `goal`, which
    brings `achieved_goal` and `desired_goal` with it (float32, see `envs.goals.goal_vectors`). `RearrangeBlocks-v0`
    also has `goal_rgb` (H, W, 3) uint8, the goal picture; black where the instruction says the goal. With
    ``observations``: these alone.

    ## Action
    ``control="primitive"``: `[pick_x, pick_y, place_x, place_y]` in metres of the world frame (with
    ``place_yaw=True`` a fifth value: radians by which the block is turned). One step is one whole
    pick-and-place. ``control="ee"``: `[dx, dy, dz, dyaw, suction]`; metres and radians per camera frame,
    suction on above 0.5. One step is one camera frame. The tip stays within its reach; a downward motion
    stops at contact.

    ## Reward and end
    ``reward="sparse"``: the change in the share of goal pairs that are fulfilled, with a goal picture of blocks that
    are supported as it shows. ``reward="dense"``: what is left to do, 0 when all is done and never above: -1/P times
    the sum over the unfulfilled of the P pairs of 1/2 + 1/4 min(1, d/0.5) + 1/4 min(1, t/0.5), with d metres from the
    thing to its place in the plane and t from the tip to the thing. With `achieved_goal` and `desired_goal` among the
    observations, ``compute_reward(achieved_goal, desired_goal, info)`` is the reward of a step, or of a batch.

    The episode terminates when all pairs are fulfilled and the arm is back home (so both modes end alike, and a next
    instruction may start); it truncates after ``max_steps``. In `RearrangeBlocks-v0` success itself asks that the empty
    gripper is home and all objects rest.

    ## Info
    Fresh copies at each call: `is_success`, `cliport_success` (CLIPort's 5 cm criterion), `instruction`, `target`
    (goal pairs as an array of the task's most pairs (P, 2): ids of the object that shall move and of that at which it
    shall end, then rows of -1), `objects` (dicts with id, label (its value in the segmentation), kind, color,
    position and orientation), `segmentation`, `palette` (RGB in 0..255: `colors` by name, `robot`, `table`), `camera`
    (`intrinsics` (3, 3) and `extrinsics` (4, 4) world -> camera, OpenCV's frame; the centre of the top-left pixel is
    (0.5, 0.5)), `gripper` (position, yaw, holding: an object id or -1), `factors` (their values in this scene, see
    `envs.factors.Factors`), `supports` (of each object what carries it: an id, -1 the table, -2 nothing, see
    `envs.physics.supports`), `sim_step`. `RearrangeBlocks-v0` has no `target` but `goal` (tuples of a relation and
    the two ids; none with a goal picture), `goal_supports` (of a goal picture, or None) and `family` (of the scene,
    or None). With ``record_frames=True`` also `frames`, `frame_segmentations` and `frame_states` of this step or of
    `reset`: see `envs.physics.recorder.Recorder`. With ``scenes`` also `scene_number` in that list. With
    `achieved_goal` also `achieved_before`, as it was before the step.

    Under `AsyncVectorEnv` with shared memory Gymnasium returns text observations as "aaaa..."; read
    ``info["instruction"]`` there, or pass ``shared_memory=False``.

    ## Reset options
    `instruction`; `layout`: a list of objects such as ``{"kind": "block", "color": "red", "xy": (0.5, 0.1)}``
    (``info["objects"]`` of an earlier reset is one too); or a random scene with `n_objects`, `n_bowls`,
    `color_split` ("seen", "unseen", "all"), `blocks_in_bowls` (how many other blocks start in bowls) and
    `target_in_bowl`; `arm_start`: "home", "random" or 6 joint angles; `factors`: values of an earlier
    ``info["factors"]`` instead of random ones. Layout and factors together show the same scene again.
    `RearrangeBlocks-v0` takes `family` ("plain", "occupied", "covered", "swap", "tower", "picture"; by default the
    seed draws one), which says what a random scene and its goal are like, with `n_objects`, `n_bowls` and
    `color_split`; or a `layout` with an `instruction` or a `goal_layout` (the arrangement that the goal picture
    shows). Blocks of its layouts may stand on each other where their `position` says so.

    Vectorised environments reset without options: there, give them to the constructor.

    ## Copies
    A copy, deep copy or pickle has a simulator of its own in the same state, to the last bit: it builds the scene
    and repeats the actions since the reset. It has no window.

    Args:
        scene: "simple" (made easy), "cliport" (CLIPort's table, robot, grays, light and speed, in the paper's
            view) or "varied" (the same with random factors).
        task: a name of `envs.tasks.TASKS`, or a task of your own.
        n_pairs: how many pairs a random goal has; by default the task's fewest. A given instruction may name
            1 to the task's most. In `RearrangeBlocks-v0` the family says it.
        control: "primitive" or "ee".
        image_size: height and width of the square image, in pixels.
        camera: "close" (a narrow workspace fills the frame) or "paper"; by default the scene's own.
        sizes: "paper" (blocks of 5.8 cm, bowls of 14 cm) or "cliport" (4 cm, 11.4 cm); by default the scene's.
        factors: ranges of what varies from scene to scene; by default the scene's. Values, as in
            ``info["factors"]``, are a reset option for every scene.
        object_scale: scales blocks and bowls, 0.5 to 1; at 1 they are the paper's, and 8 of them just fit.
        render_stride: physics steps between two camera frames.
        physics_hz: physics steps per second; by default 240 in "simple" and CLIPort's 480 in the others.
        max_steps: steps until truncation; by default 3 primitives (`RearrangeBlocks-v0`: 8) for each goal pair, or
            as many frames as they may take.
        extras: further observations, one or several of "depth", "segmentation", "proprio", "state", "goal",
            "achieved_goal", "desired_goal".
        place_yaw: whether a primitive has a fifth value.
        record_frames: whether `info` holds all frames of a step.
        render_mode: "rgb_array" (`render` gives the newest frame), "rgb_array_list" (all frames since the last
            `render` or `reset`, also those within a primitive), "human" or None.
        render_size: height and width of what `render` gives, in pixels; by default the image size.
        scenes: a list of scenes, or a JSON file with one, that resets walk through again and again: seeds, or
            mappings of reset options and `seed` (by default the scene's number). A reset with a seed goes to the
            scene of that number, modulo their count, and on from there.
        reward: "sparse" or "dense".
        observations: the names of those that there shall be, for libraries that know no text; by default `rgb`,
            `instruction`, in `RearrangeBlocks-v0` `goal_rgb`, and the extras.
        **wishes: any other reset option, for every reset that does not say otherwise.

    Raises:
        ValueError: for values that are not allowed.
        TypeError: for an argument that there is not.
    """

    # Not a ClassVar, because Gymnasium declares it so.
    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "rgb_array_list", "human"], "render_fps": 15}  # noqa: RUF012

    def __init__(
        self,
        task: str | Task = "put_block_in_bowl",
        n_pairs: int | None = None,
        control: Control = "primitive",
        image_size: int = 64,
        camera: str | None = None,
        object_scale: float = 1.0,
        render_stride: int = 16,
        physics_hz: int | None = None,
        max_steps: int | None = None,
        extras: str | Sequence[str] = (),
        place_yaw: bool = False,
        record_frames: bool = False,
        render_mode: str | None = None,
        scene: str = "simple",
        sizes: str | None = None,
        factors: Factors | Mapping[str, Any] | None = None,
        render_size: int | None = None,
        scenes: Scenes | None = None,
        reward: Reward = "sparse",
        observations: str | Sequence[str] | None = None,
        **wishes: Any,
    ) -> None:
        if not isinstance(task, Task):
            check_choice("task", task, TASKS)
        self.task = task if isinstance(task, Task) else TASKS[task]
        self.n_pairs = self.task.pairs[0] if n_pairs is None else n_pairs
        check_range("n_pairs", self.n_pairs, *self.task.pairs, whole=True)
        check_choice("control", control, ("primitive", "ee"))
        if isinstance(factors, Mapping):
            wishes, factors = wishes | {"factors": factors}, None
        if unknown := set(wishes) - {*OPTIONS, *self.task.scene_options}:
            allowed = ", ".join([*OPTIONS, *self.task.scene_options])
            raise TypeError(f"unexpected argument {min(unknown)!r}; reset options that are arguments: {allowed}")
        self.setup = setup = make_setup(scene, camera, sizes, factors, object_scale)
        check_choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        check_choice("reward", reward, REWARDS)
        for name, value in (("place_yaw", place_yaw), ("record_frames", record_frames)):
            check_choice(name, value, (False, True))
        always = ("rgb", "instruction", *("goal_rgb",) * self.task.stacks)
        self.observations = read_observations(observations, extras, always)
        check_range("image_size", image_size, 16, 2048, whole=True)
        self.render_size = image_size if render_size is None else render_size
        check_range("render_size", self.render_size, 16, 2048, whole=True)
        physics_hz = setup.physics_hz if physics_hz is None else physics_hz
        check_range("physics_hz", physics_hz, 120, 2000, whole=True)
        check_range("render_stride", render_stride, 1, physics_hz // 10, whole=True)
        if max_steps is not None:
            check_range("max_steps", max_steps, 1, 10**9, whole=True)
        self.control, self.render_mode, self.scene_name = control, render_mode, scene
        self.reward, self.place_yaw, self.record_frames = reward, place_yaw, record_frames
        frames = 1 if control == "primitive" else EE_SECONDS * physics_hz / render_stride
        self.max_steps = max_steps or round(self.task.attempts * frames) * self.n_pairs
        self.metadata = self.metadata | {"render_fps": max(1, round(physics_hz / render_stride))}
        if control == "primitive":
            self._box = primitive_space(setup.workspace, place_yaw)
        else:
            self._box = ee_space(render_stride / physics_hz)
        self.action_space = self._box  # type: ignore[assignment]  # Box knows no element type
        self.observation_space = observation_space(image_size, setup.camera.far, self.task, self.observations)
        self._wishes, self._scenes = wishes, None if scenes is None else read_scenes(scenes)
        self._scene_number, self._next_scene = -1, 0
        self._read(None)
        for number, (_, wished) in enumerate(self._scenes or ()):
            try:
                self._read(wished)
            except ValueError as error:
                raise ValueError(f"scene {number} of scenes: {error}") from None
        self._simulator = (image_size, physics_hz, render_stride)
        self._start_simulator()
        self._film: list[NDArray[np.uint8]] = []  # for `render`
        self._motion = np.zeros(5, np.float32)  # the latest
        self._start: tuple[Setup, Scene, Joints] | None = None  # what was built
        self._actions: list[NDArray[np.float32]] = []  # since the reset
        self._goal_rgb = np.zeros((image_size, image_size, 3), np.uint8)
        self._drawn: dict[str, Any] = {}

    @property
    def scene(self) -> Scene:
        """The scene as it was built, for experts; gymnasium.error.ResetNeeded before the first reset."""
        if self._start is None:
            raise gym.error.ResetNeeded("call reset() first")
        return self._start[1]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Build a new scene; see the class for `options`. A seed is a scene, bit for bit.

        Raises:
            ValueError: for options or a seed that are not allowed, before anything changes.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        number, seed = self._next_scene, None if seed is None else read_seed(seed)
        if self._scenes is not None:
            number = number if seed is None else seed % len(self._scenes)
            seed, wished = self._scenes[number]
            options = override(wished, options, self.task)
        checked = self._read(options)
        self.world.check_open()
        super().reset(seed=seed)
        if self._scenes is not None:
            self._scene_number, self._next_scene = number, (number + 1) % len(self._scenes)
        setup, self._drawn, scene, joints = checked.draw(self.np_random)
        self._goal_rgb = np.zeros_like(self._goal_rgb)
        if scene.picture is not None:
            self._build(setup, replace(scene, objects=scene.picture), setup.arm.home_joints)
            self._goal_rgb = self.world.render().rgb
        self._show(setup, scene, joints)
        return self._observe(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """One pick-and-place, or one camera frame of tool motion.

        Raises:
            ValueError: for an action that is not in the action space.
            gymnasium.error.ResetNeeded: before the first reset.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        before = self._fulfilled()
        self._remember()
        values = check_action(self._box, action)
        self._recorder.restart()
        self._actions.append(values)
        if self.control == "primitive":
            x, y, place_x, place_y, *turn = values.tolist()
            for motion in pick_and_place(self.robot, (x, y), (place_x, place_y), *turn):
                self._move(motion)
                # Rendering changes nothing in the world, so unwanted frames are not drawn.
                if self.record_frames or self.render_mode in ("rgb_array_list", "human"):
                    self._capture()
        else:
            self._move(values)
        if not self._recorder.images:
            self._capture()
        if self.reward == "sparse":
            after = self._fulfilled()
            reward = (sum(after) - sum(before)) / len(after)
        else:
            goals = self._goals()
            reward = float(compute_reward("dense", goals["achieved_goal"], goals["desired_goal"]))
        terminated = self.task.succeeded(self.world, self.robot, self.scene) and self.robot.is_home
        return self._observe(), reward, terminated, len(self._actions) >= self.max_steps, self._info()

    @property
    def compute_reward(self) -> Callable[[ArrayLike, ArrayLike, Any], NDArray[np.float64]]:
        """See `envs.goals.compute_reward`, with this environment's reward.

        Raises:
            AttributeError: without goals among the observations; libraries take what has it for goal-conditioned.
        """
        if not set(GOALS) <= set(self.observations):
            raise AttributeError('compute_reward needs achieved_goal and desired_goal: extras=("goal",)')
        return partial(compute_reward, self.reward)

    def render(self) -> NDArray[np.uint8] | list[NDArray[np.uint8]] | None:  # type: ignore[override]
        """What ``render_mode`` says: a frame (H, W, 3), a list of those, or None; a window shows itself.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn("render() needs a render_mode: gym.make(..., render_mode='rgb_array')")
            return None
        if not self._recorder.images:
            raise gym.error.ResetNeeded("call reset() first")
        if self.render_mode == "rgb_array_list":
            film, self._film = self._film, []
            return film
        return self._picture() if self.render_mode == "rgb_array" else None

    def copy(self) -> TabletopEnv:
        """The same scene in the same state in a simulator of its own, to try things; its pictures are tiny."""
        twin = TabletopEnv(
            self.task,
            control=self.control,
            image_size=16,
            render_stride=self.robot.frame_steps,
            physics_hz=self.world.physics_hz,
            place_yaw=self.place_yaw,
            scene=self.scene_name,
        )
        twin.follow(self)
        return twin

    def follow(self, original: TabletopEnv) -> None:
        """Come to the state of the environment that this one is a copy of, to the last bit.

        Its scene is built and its actions are repeated, because PyBullet's own saved states are not exact.

        Raises:
            gymnasium.error.ResetNeeded: before the original's first reset.
        """
        scene, actions = original.scene, original._actions
        assert original._start is not None
        setup, _, joints = original._start
        self._show(setup, scene, joints)
        for action in actions:
            self.step(action)

    def __getstate__(self) -> dict[str, Any]:
        self.world.check_open()
        own = ("world", "robot", "_recorder")
        return deepcopy({name: value for name, value in vars(self).items() if name not in own})

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self.render_mode == "human":
            self.render_mode = None  # PyBullet has one window only
        self._start_simulator()
        if self._start is not None:
            self.follow(self)
            self._film = state["_film"]

    def close(self) -> None:
        """Give PyBullet's memory back. Safe to call twice."""
        self.world.close()

    def _start_simulator(self) -> None:
        image_size, physics_hz, render_stride = self._simulator
        self.world = Tabletop(self.setup, image_size, physics_hz, gui=self.render_mode == "human")
        self.robot = Robot(self.world, render_stride)
        self._recorder = Recorder(self.robot)

    def _read(self, options: Any) -> ResetOptions:
        """What `reset` is asked for, over what the constructor was."""
        x, y, _ = self.setup.arm.home
        request = replace(
            self.task.request(self.n_pairs),
            spawn=self.setup.spawn,
            edge=self.setup.edge,
            avoid=(x, y) if self.task.stacks else None,
        )
        return read_options(override(self._wishes, options, self.task), self.task, request, self.setup)

    def _show(self, setup: Setup, scene: Scene, joints: Joints) -> None:
        """Start anew with ``scene``, and take its first frame."""
        self._build(setup, scene, joints)
        self._film, self._motion = [], np.zeros(5, np.float32)
        self._recorder.restart()
        self._capture()
        self._remember()

    def _capture(self) -> None:
        """Take a frame of this moment."""
        self._recorder.capture(self._motion)
        if self.render_mode == "rgb_array_list":
            self._film.append(self._picture())

    def _picture(self) -> NDArray[np.uint8]:
        """This moment as `render` shows it."""
        if self.render_size == self.world.image_size:
            return self._recorder.images[-1].rgb.copy()
        return self.world.render(self.render_size).rgb

    def _build(self, setup: Setup, scene: Scene, joints: Joints) -> None:
        """Start anew with ``scene``, settled, and the arm at ``joints``."""
        self.world.build(setup, scene, joints)
        self.robot.reset(joints, scene.held)
        self.robot.hold_still(MAX_SETTLE_STEPS)
        self._start, self._actions = (setup, scene, joints), []

    def _move(self, action: Action) -> None:
        self._motion = action
        self.robot.move(action[:3], float(action[3]), bool(action[4] > 0.5))

    def _fulfilled(self) -> list[bool]:
        return self.task.fulfilled(self.world, self.robot, self.scene)

    def _goals(self) -> dict[str, NDArray[np.float32]]:
        return goal_vectors(self.task, self.world, self.robot, self.scene)

    def _remember(self) -> None:
        """Keep the achieved goal from before a step, from which the sparse reward is a change."""
        self._before = self._goals()["achieved_goal"] if "achieved_goal" in self.observations else None

    def _observe(self) -> Observation:
        image, state = self._recorder.images[-1], self._recorder.states[-1]
        seen = {
            "rgb": image.rgb.copy(),
            "instruction": self.scene.instruction,
            "goal_rgb": self._goal_rgb.copy(),
            "depth": image.depth.copy(),
            "segmentation": image.segmentation.copy(),
            "proprio": np.concatenate([state["arm"], state["gripper"]]),
            "state": state_vector(state["gripper"], state["object_position"], self.scene.objects),
        }
        if {"goal", *GOALS} & set(self.observations):
            seen |= self._goals()
        return {name: seen[name] for name in self.observations}

    def _info(self) -> dict[str, Any]:
        world, robot, goal = self.world, self.robot, self.scene.goal
        info: dict[str, Any] = {
            "is_success": self.task.succeeded(world, robot, self.scene),
            "cliport_success": all(self.task.relation(pair).is_near(world, pair) for pair in goal),
            "instruction": self.scene.instruction,
            # As many rows always, so that vectorised environments can join them.
            "target": np.array([*[pair[1:] for pair in goal], *[(-1, -1)] * (self.task.pairs[1] - len(goal))]),
            "objects": [],
            "segmentation": self._recorder.images[-1].segmentation.copy(),
            "palette": world.setup.palette,
            "camera": {"intrinsics": world.camera.intrinsics, "extrinsics": world.camera.extrinsics},
            "gripper": {"position": np.array(robot.tip()), "yaw": robot.yaw, "holding": robot.holding},
            "supports": supports(world, robot),
            "sim_step": world.steps,
            "factors": deepcopy(self._drawn),
        }
        if self.task.stacks:
            picture = self.scene.picture
            del info["target"]
            info |= {
                "goal": tuple(tuple(pair) for pair in goal),
                "goal_supports": None if picture is None else tuple(item.support for item in picture),
                "family": self.scene.family,
            }
        for index, item in enumerate(self.scene.objects):
            position, orientation = map(np.array, world.pose(index))
            named = {"id": index, "label": FIRST_OBJECT + index, "kind": item.kind, "color": item.color}
            info["objects"].append(named | {"position": position, "orientation": orientation})
        if self._scenes is not None:
            info["scene_number"] = self._scene_number
        if self._before is not None:
            info[BEFORE] = self._before.copy()
        return info | (self._recorder.info() if self.record_frames else {})
