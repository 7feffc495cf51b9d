"""What stands on what, what sentences lead to, and the families of scenes in which that matters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet as p
import pytest
from gymnasium.utils.env_checker import check_env

from envs import Expert
from envs.scene import NOWHERE, TABLE, GoalPair, ObjectSpec
from envs.tabletop import TabletopEnv
from envs.tasks.rearrange import FAMILIES, Rearrange, Supports, arrangement_after, outcome

Make = Callable[..., gym.Env[Any, Any]]
TASK = Rearrange()
BLOCK, FLOOR = 0.058, 0.006  # metres: the edge of a block, and how high the floor of a bowl is
FEWEST = {"plain": {1}, "occupied": {2}, "covered": {2}, "swap": {3}, "tower": {2}, "picture": {1, 2, 3, 4}}


def block(color: str, x: float, y: float, level: int = 0, bowl: bool = False) -> dict[str, Any]:
    """A block with so many others under it."""
    height = FLOOR * bowl + BLOCK * (level + 0.5)
    return {"kind": "block", "color": color, "position": (x, y, height), "yaw": 0.4 * level}


def bowl(color: str, x: float, y: float) -> dict[str, Any]:
    return {"kind": "bowl", "color": color, "xy": (x, y)}


# A block on the table, one in a bowl, a tower of three, two blocks in a bowl, an empty bowl.
RED, GREEN, BLUE = block("red", 0.46, -0.13), block("green", 0.46, 0.0, 1), block("blue", 0.46, 0.0)
BOWL, IN_BOWL, UPPER = (
    bowl("gray", 0.62, 0.13),
    block("cyan", 0.62, 0.13, 0, True),
    block("brown", 0.62, 0.13, 1, True),
)
EMPTY, TOP = bowl("yellow", 0.62, -0.12), block("pink", 0.46, 0.0, 2)
LAYOUT = [RED, GREEN, BLUE, BOWL, IN_BOWL, UPPER, EMPTY, TOP]
SUPPORTS = [TABLE, 2, TABLE, TABLE, 3, 4, TABLE, 1]
ANY_GOAL = "put the red block in the yellow bowl"


@pytest.fixture
def env(make: Make) -> Iterator[TabletopEnv]:
    env = make("RearrangeBlocks-v0").unwrapped
    assert isinstance(env, TabletopEnv)
    yield env


def say(env: TabletopEnv, text: str) -> list[int]:
    """The supports after a sentence."""
    for action in Expert(env).actions(text):
        info = env.step(action)[4]
    return list(info["supports"])


# -- Supports ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["simple", "cliport"])
def test_supports_are_read_off_the_simulator(make: Make, scene: str) -> None:
    env = make("RearrangeBlocks-v0", scene=scene)
    _, info = env.reset(options={"layout": LAYOUT, "instruction": ANY_GOAL})
    assert list(info["supports"]) == SUPPORTS
    _, again = env.reset(options={"layout": info["objects"], "instruction": ANY_GOAL})
    assert list(again["supports"]) == SUPPORTS, "the info of a scene with stacks is a layout"
    for one, other in zip(info["objects"], again["objects"], strict=True):
        assert np.allclose(one["position"], other["position"], atol=0.002)


def test_what_is_held_askew_or_falling_has_no_support(env: TabletopEnv) -> None:
    env.reset(options={"layout": LAYOUT, "instruction": ANY_GOAL})
    world, red = env.world, env.world.objects[0]
    rim = world.pose(6)[0][0] - world.sizes.bowl_radius
    tilted = p.getQuaternionFromEuler([0.0, 0.8, 0.0])
    for position, turn in (((0.46, -0.13, 0.2), [0, 0, 0, 1]), ((rim, -0.12, 0.09), tilted)):
        world.bullet.resetBasePositionAndOrientation(red, position, turn)
        world.step()
        assert list(env._info()["supports"]) == [NOWHERE, *SUPPORTS[1:]]
    world.bullet.resetBasePositionAndOrientation(red, (0.46, -0.13, BLOCK / 2), [0, 0, 0, 1])
    world.settle(50)
    assert list(env._info()["supports"]) == SUPPORTS
    env.robot._seal(0)
    assert list(env._info()["supports"]) == [NOWHERE, *SUPPORTS[1:]]


# -- What sentences lead to, by physics ----------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["simple", "cliport"])
@pytest.mark.parametrize(
    ("text", "moves", "to"),
    [
        ("put the red block in the yellow bowl", 0, 6),
        ("put the red block in the gray bowl", 0, 5),  # onto what is on what is in it
        ("put the brown block on the red block", 5, 0),  # out of a bowl, and a tower grows
        ("put the blue block in the yellow bowl", 7, 6),  # takes the top of the tower
        ("put the cyan block on the red block", 5, 0),  # takes the upper of two in a bowl
        ("put the red block on the cyan block", 0, 5),
        ("put the green block on the blue block", 7, 1),  # takes the top one, which goes back to where it was
    ],
)
def test_physics_does_what_the_rule_says(make: Make, scene: str, text: str, moves: int, to: int) -> None:
    env = make("RearrangeBlocks-v0", scene=scene).unwrapped
    env.reset(options={"layout": LAYOUT, "instruction": ANY_GOAL})
    pair = TASK.find_goal(env.scene.objects, TASK.parse(text))[0]
    assert outcome(tuple(SUPPORTS), pair) == (moves, to)
    expected = [to if index == moves else support for index, support in enumerate(SUPPORTS)]
    assert list(arrangement_after(tuple(SUPPORTS), pair)) == expected
    assert say(env, text) == expected


def test_a_second_block_in_a_bowl_is_a_block_higher(env: TabletopEnv) -> None:
    two = [RED, bowl("gray", 0.62, 0.13), block("cyan", 0.62, 0.13, 0, True), block("blue", 0.46, 0.0)]
    env.reset(options={"layout": two, "instruction": "put the blue block in the gray bowl"})
    assert say(env, "put the red block in the gray bowl") == [2, TABLE, 1, TABLE]
    assert env.world.pose(0)[0][2] - env.world.pose(2)[0][2] == pytest.approx(BLOCK, abs=0.002)


def test_a_carried_block_passes_over_towers(env: TabletopEnv) -> None:
    """The way of the red block leads through a tower of three."""
    layout = [block("red", 0.46, -0.15), *(block(c, 0.46, 0.0, k) for k, c in enumerate(("green", "blue", "cyan")))]
    layout.append(bowl("gray", 0.46, 0.15))
    env.reset(options={"layout": layout, "instruction": "put the red block in the gray bowl"})
    assert say(env, "put the red block in the gray bowl") == [4, TABLE, 1, 2, TABLE]
    assert env._info()["is_success"]


# -- Success -------------------------------------------------------------------------------------------------


def test_success_is_strict(env: TabletopEnv) -> None:
    layout, text = [RED, EMPTY, block("green", 0.46, 0.05)], "put the red block in the yellow bowl"
    env.reset(options={"layout": layout, "instruction": text})
    action = next(Expert(env).actions(text))
    _, reward, terminated, _, info = env.step(action)
    assert (reward, terminated, info["is_success"]) == (1.0, True, True)

    home, robot = env.robot.tip(), env.robot
    away = np.array([0.06, 0.0, 0.05], np.float32)
    robot.move(away, 0.0, False)
    assert env._fulfilled() == [True] and not env._info()["is_success"], "the gripper is not home"
    robot.move(-away, 0.0, False)
    robot.hold_still(60)
    assert np.allclose(robot.tip(), home, atol=0.005) and env._info()["is_success"]

    env.world.bullet.resetBaseVelocity(env.world.objects[2], [0.2, 0.0, 0.0])
    assert env._fulfilled() == [True] and not env._info()["is_success"], "another block still moves"
    robot.hold_still(60)
    assert env._info()["is_success"]

    assert say(env, "put the green block in the yellow bowl") == [1, TABLE, 0]
    assert not env._info()["is_success"], "the named block carries another, as at a covered start"
    env.world.bullet.resetBasePositionAndOrientation(env.world.objects[0], (0.5, 0.15, BLOCK / 2), [0, 0, 0, 1])
    env.world.settle(60)
    assert not env._info()["is_success"], "the block is no longer in the bowl"


def test_a_fallen_block_spoils_a_picture(env: TabletopEnv) -> None:
    layout = [block("red", 0.46, -0.1), block("green", 0.46, 0.1), block("blue", 0.6, 0.0), EMPTY]
    goal = [layout[0], layout[1], block("blue", 0.46, 0.1, 1), EMPTY]
    observation, info = env.reset(options={"layout": layout, "goal_layout": goal[::-1]})
    assert observation["instruction"] == "rearrange the blocks as in the picture"
    assert info["goal_supports"] == (TABLE, TABLE, 1, TABLE) and not info["is_success"]
    assert say(env, "put the blue block on the green block") == [TABLE, TABLE, 1, TABLE]
    assert env._info()["is_success"]
    seen, picture = env._observe()["rgb"].astype(int), observation["goal_rgb"]
    assert (abs(seen - picture).max(-1) < 12).mean() > 0.99, "and it looks like the picture"
    env.world.bullet.resetBasePositionAndOrientation(env.world.objects[2], (0.6, 0.0, BLOCK / 2), [0, 0, 0, 1])
    env.world.settle(60)
    assert env._fulfilled() == [True, True, False] and not env._info()["is_success"]


# -- Families ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["simple", "cliport"])
@pytest.mark.parametrize("family", FAMILIES)
def test_starts_and_goals_of_the_families(make: Make, family: str, scene: str) -> None:
    env = make("RearrangeBlocks-v0", image_size=16, scene=scene).unwrapped
    lengths = set()
    for seed in range(30):
        observation, info = env.reset(seed=seed, options={"family": family})
        supports, goal = list(info["supports"]), info["goal"]
        assert env.observation_space.contains(observation)
        assert (info["family"], info["is_success"]) == (family, False)
        assert supports == [item.support for item in env.scene.objects], "the start is as it was drawn"
        assert observation["goal_rgb"].any() == (family == "picture")
        plan = env.task.solve(env.scene, tuple(supports))
        lengths.add(len(plan))
        if family == "plain":
            assert set(supports) == {TABLE} and [pair[0] for pair in goal] == ["in"]
        elif family == "occupied":
            _, thing, target = goal[0]
            assert supports.index(target) != thing and supports[thing] == TABLE
        elif family == "covered":
            _, thing, _ = goal[0]
            assert supports.count(thing) == 1 and supports[thing] == TABLE
        elif family == "swap":
            assert {supports[thing] for _, thing, _ in goal} == {target for *_, target in goal}
        elif family == "tower":
            assert set(supports) == {TABLE} and [pair[0] for pair in goal] == ["on", "on"]
            assert len({index for pair in goal for index in pair[1:]}) == 3
        else:
            assert goal == () and list(info["goal_supports"]) != supports
    assert lengths == FEWEST[family]


def test_a_seed_draws_a_family_and_is_a_scene(make: Make) -> None:
    env = make("RearrangeBlocks-v0", image_size=16)
    seen = {}
    for seed in range(24):
        observation, info = env.reset(seed=seed)
        seen[seed] = (info["family"], observation["instruction"], observation["goal_rgb"].tobytes(), observation["rgb"])
    assert {each[0] for each in seen.values()} == set(FAMILIES)
    for seed in (7, 3):
        observation, info = env.reset(seed=seed)
        again = info["family"], observation["instruction"], observation["goal_rgb"].tobytes()
        assert again == seen[seed][:3] and np.array_equal(observation["rgb"], seen[seed][3])


@pytest.mark.parametrize("scene", ["simple", "cliport"])
@pytest.mark.parametrize("family", FAMILIES)
def test_the_expert_reaches_every_goal(make: Make, family: str, scene: str) -> None:
    env = make("RearrangeBlocks-v0", image_size=16, scene=scene)
    for seed in (100, 101):
        env.reset(seed=seed, options={"family": family, "n_objects": 5 + seed % 3})
        for action in Expert(env).actions():
            *_, terminated, _, info = env.step(action)
        assert terminated and info["is_success"], seed


def test_a_copy_has_the_same_future(make: Make) -> None:
    env = make("RearrangeBlocks-v0").unwrapped
    env.reset(seed=5, options={"family": "swap", "arm_start": "random"})
    actions = list(Expert(env).actions())
    env.step(actions[0])
    twin = env.copy()
    for action in actions[1:]:
        ours, theirs = env.step(action)[4], twin.step(action)[4]
    for one, other in zip(ours["objects"], theirs["objects"], strict=True):
        assert np.array_equal(one["position"], other["position"])
    twin.close()


def test_the_expert_learns_from_a_surprise(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a wrong rule, by which a block fits into any bowl, it still finds what to do, by trying."""
    env = make("RearrangeBlocks-v0", image_size=16).unwrapped

    def wrong(state: Supports, pair: GoalPair) -> Supports:
        if pair.relation == "in":
            return (*state[: pair.thing], pair.target, *state[pair.thing + 1 :])
        return arrangement_after(state, pair)

    monkeypatch.setattr("envs.tasks.rearrange.arrangement_after", wrong)
    monkeypatch.setattr("envs.expert.arrangement_after", wrong)
    env.reset(seed=1, options={"family": "occupied"})
    assert env.task.solve(env.scene, env._info()["supports"]) == env.scene.goal, "what it believes"
    plan = Expert(env).search()
    assert len(plan) == 2 and plan[1] == env.scene.goal[0]
    for pair in plan:
        info = env.step(Expert(env).primitive(pair))[4]
    assert info["is_success"]


def test_no_way_out_is_found_soon() -> None:
    """Two blocks, two bowls: they cannot change places."""
    kinds = {"red": "block", "gray": "bowl", "green": "block", "yellow": "bowl"}
    objects = tuple(ObjectSpec(kind, color, 0.5, 0.0) for color, kind in kinds.items())
    scene = TASK.scene(objects, (GoalPair("in", 0, 3), GoalPair("in", 2, 1)))
    assert TASK.solve(scene, (1, TABLE, 3, TABLE)) is None
    assert len(TASK.solve(scene, (TABLE,) * 4) or ()) == 2


def test_questions_say_what_really_moves(env: TabletopEnv) -> None:
    env.reset(options={"layout": LAYOUT, "instruction": ANY_GOAL})
    asked = {each.text: (each.moves, each.ends_at) for each in env.task.questions(env.scene.objects)}
    assert asked["put the red block in the yellow bowl"] == (0, 6)
    assert asked["put the blue block in the yellow bowl"] == (7, 6)
    assert asked["put the red block in the gray bowl"] == (0, 5)
    assert "put the green block on the blue block" not in asked


# -- As a Gymnasium environment ------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["simple", "cliport"])
def test_the_environment_passes_the_check(scene: str) -> None:
    env = gym.make("RearrangeBlocks-v0", image_size=16, scene=scene)
    with pytest.warns(UserWarning):
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_environments_run_side_by_side() -> None:
    several = gym.make_vec("RearrangeBlocks-v0", 2, "sync", image_size=16)
    alone = gym.make("RearrangeBlocks-v0", image_size=16)
    observation, infos = several.reset(seed=11)
    for number in range(2):
        own, info = alone.reset(seed=11 + number)
        assert np.array_equal(observation["rgb"][number], own["rgb"])
        assert np.array_equal(observation["goal_rgb"][number], own["goal_rgb"])
        assert infos["family"][number] == info["family"]
    observation, *_ = several.step(np.array([[0.5, 0.0, 0.6, 0.1]] * 2, np.float32))
    assert observation["rgb"].shape == (2, 16, 16, 3)
    several.close()
    alone.close()


SWAP = [block("red", 0.46, -0.1, 0, True), bowl("gray", 0.46, -0.1), block("green", 0.6, 0.1, 0, True)]
SWAP += [bowl("yellow", 0.6, 0.1)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"family": "pyramid"}, "unknown family 'pyramid'; allowed: 'plain', 'occupied', 'covered', 'swap'"),
        ({"family": "swap", "n_objects": 4}, "n_objects must be 5 to 8 for the 5 things"),
        ({"family": "swap", "n_bowls": 2}, "n_bowls must be 3 to 4"),
        ({"n_bowls": 3}, "n_bowls needs a family"),
        ({"n_objects": 4}, "n_objects must be 5 to 8"),
        ({"blocks_in_bowls": 1}, "unknown reset option 'blocks_in_bowls'; allowed: .*family.*goal_layout"),
        ({"instruction": ANY_GOAL}, "an instruction needs a layout here"),
        ({"layout": LAYOUT, "family": "plain"}, "family describe a random scene"),
        ({"layout": LAYOUT, "instruction": "put the red block on the red block"}, "red block on itself"),
        ({"layout": SWAP, "instruction": "put the red block in the gray bowl"}, "already fulfils the instruction"),
        (
            {
                "layout": SWAP,
                "instruction": "put the red block in the yellow bowl and the green block in the gray bowl",
            },
            "no sentences lead from the layout to the goal 'put the red block in the yellow",
        ),
        (
            {
                "layout": LAYOUT,
                "instruction": "put the red block on the cyan block and the cyan block on the red block",
            },
            "no sentences lead",
        ),
        (
            {
                "layout": LAYOUT,
                "instruction": "put the red block on the cyan block and the blue block on the cyan block",
            },
            "must not name a block twice: a block has room for one block",
        ),
        ({"goal_layout": LAYOUT}, "a goal_layout needs a layout"),
        ({"layout": LAYOUT, "goal_layout": LAYOUT, "instruction": ANY_GOAL}, "stands instead of an instruction"),
        ({"layout": LAYOUT, "goal_layout": LAYOUT}, "already fulfils"),
        ({"layout": SWAP, "goal_layout": LAYOUT}, "is a picture of another scene; it must show: gray bowl, green bl"),
        (
            {"layout": SWAP, "goal_layout": [*SWAP[:2], block("green", 0.6, 0.15, 0, True), bowl("yellow", 0.6, 0.15)]},
            "another scene: in it the yellow bowl stands 0.05 m away",
        ),
        (
            {"layout": SWAP, "goal_layout": [block("red", 0.6, -0.05), *SWAP[1:]]},
            "no sentences lead from the layout to the goal 'rearrange",
        ),
    ],
)
def test_wrong_options_are_refused_before_anything_moves(
    env: TabletopEnv, options: dict[str, Any], message: str
) -> None:
    env.reset(seed=4)
    before, generator = env._info(), env.np_random.bit_generator.state
    with pytest.raises(ValueError, match=message):
        env.reset(seed=5, options=options)
    after = env._info()
    assert env.np_random.bit_generator.state == generator
    assert after["sim_step"] == before["sim_step"] and after["instruction"] == before["instruction"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"family": "plain"}, "unknown reset option 'family'"),
        ({"goal_layout": LAYOUT}, "unknown reset option 'goal_layout'"),
    ],
)
def test_other_tasks_have_no_families_and_pictures(make: Make, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make().reset(options=options)
