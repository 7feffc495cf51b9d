"""Every wrong input is one clear error that says what is allowed, and changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

Make = Callable[..., gym.Env[Any, Any]]
RED = {"kind": "block", "color": "red", "xy": (0.4, -0.1)}
BLUE = {"kind": "bowl", "color": "blue", "xy": (0.6, 0.1)}
GREEN = {"kind": "bowl", "color": "green", "xy": (0.6, -0.1)}


def layout(*items: dict[str, Any], **change: Any) -> dict[str, Any]:
    return {"layout": [*items[:-1], items[-1] | change]}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"colour": 1}, "unknown reset option 'colour'; allowed: layout, instruction, arm_start"),
        ([1], "options must be a mapping, not list"),
        ({"instruction": "put the mauve block in the blue bowl"}, "unknown colour 'mauve'; allowed: blue"),
        ({"instruction": "open the drawer"}, "the form is: put the"),
        ({"instruction": 5}, "an instruction is a string"),
        (
            layout(RED, BLUE) | {"instruction": "put the green block in the blue bowl"},
            "the scene has no green block; it has: red block, blue bowl",
        ),
        (layout(RED, BLUE) | {"instruction": "put the red block in the red bowl"}, "the scene has no red bowl; it has"),
        ({"instruction": "put the red block in the red bowl"}, "must not name a colour twice"),
        ({"instruction": "put the red block in the blue bowl and the green block in the gray bowl"}, "at most 1 "),
        (layout(RED, BLUE, color="red"), "no two objects may share a colour, but red"),
        (layout(RED, BLUE, xy=(0.42, -0.12)), "red block overlap; their centres must be at least 0.1"),
        (layout(BLUE, GREEN, RED, xy=(0.6, 0.14)), "overlap; .* within 0.019 m of a bowl's centre"),
        (layout(RED, BLUE, xy=(0.9, 0.1)), r"is out of the workspace: x in \[0.25, 0.75\]"),
        (layout(RED, BLUE, xy=(float("nan"), 0.1)), "is out of the workspace"),
        (layout(RED, BLUE, xy=()), "needs a place 'xy' in metres"),
        (layout(RED, BLUE, kind="cup"), "unknown kind 'cup' in a layout; allowed: block, bowl"),
        (layout(RED, BLUE, color="mauve"), "unknown colour 'mauve' in a layout; allowed"),
        ({"layout": "red block"}, "a layout is a list of objects such as"),
        ({"layout": [RED]}, "2 to 8 objects, not 1"),
        ({"layout": [BLUE, GREEN]}, "at least one block"),
        (layout(RED, BLUE) | {"n_objects": 6}, "n_objects describe a random scene"),
        (layout(BLUE, RED, xy=(0.6, 0.1)) | {"instruction": "put the red block in the blue bowl"}, "already fulfils"),
        ({"n_objects": 9}, "n_objects must be 2 to 8 .* so that all fit on the table; got 9"),
        ({"n_objects": 1}, "n_objects must be 2 to 8"),
        ({"n_objects": 2.5}, "n_objects must be a whole number"),
        ({"n_bowls": 6}, "n_bowls must be 1 to 5 for this scene; got 6"),
        ({"n_bowls": 0}, "n_bowls must be 1 to 5"),
        ({"n_objects": 3, "blocks_in_bowls": 1}, "3 objects are too few"),
        ({"blocks_in_bowls": -1}, "blocks_in_bowls must be a whole number of at least 0"),
        ({"target_in_bowl": 2}, "target_in_bowl must be True or False"),
        ({"color_split": "test"}, "unknown color_split 'test'; allowed: seen, unseen, all"),
        ({"arm_start": "up"}, "arm_start must be 'home', 'random' or 6 finite joint angles"),
        ({"arm_start": [0.0] * 6}, "arm_start must be"),
        ({"arm_start": [0.0] * 5}, "arm_start must be"),
    ],
)
def test_wrong_reset_options_are_refused_before_anything_changes(make: Make, options: Any, message: str) -> None:
    env = make(record_frames=True)
    env.reset(seed=4)
    before = env.unwrapped._info()
    generator = env.unwrapped.np_random.bit_generator.state
    with pytest.raises(ValueError, match=message):
        env.reset(seed=5, options=options)
    after = env.unwrapped._info()
    assert env.unwrapped.np_random.bit_generator.state == generator
    assert after["sim_step"] == before["sim_step"] and after["instruction"] == before["instruction"]
    assert np.array_equal(after["objects"][0]["position"], before["objects"][0]["position"])


@pytest.mark.parametrize(
    "action",
    [
        [0.5, 0.0, 0.5, float("nan")],
        [0.5, 0.0, 0.5, float("inf")],
        [0.9, 0.0, 0.5, 0.0],
        [0.5, 0.0, 0.5],
        [[0.5, 0.0, 0.5, 0.0]],
        "left",
        None,
    ],
)
def test_wrong_primitives_are_refused_before_anything_moves(make: Make, action: Any) -> None:
    env = make(record_frames=True).unwrapped
    env.reset(seed=4)
    steps = env.world.steps
    with pytest.raises(ValueError, match=r"\[pick_x, pick_y, place_x, place_y\], finite .* from \[0.25, -0.25"):
        env.step(action)
    assert env.world.steps == steps


@pytest.mark.parametrize("action", [[0, 0, 0, 0, 2], [0, 0, np.nan, 0, 0], [9, 0, 0, 0, 0], [0, 0, 0, 0]])
def test_wrong_tool_motions_are_refused_before_anything_moves(make: Make, action: Any) -> None:
    env = make(control="ee").unwrapped
    env.reset(seed=4)
    steps = env.world.steps
    with pytest.raises(ValueError, match=r"\[dx, dy, dz, dyaw, suction\], finite numbers from \[-0.2"):
        env.step(action)
    assert env.world.steps == steps


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "stack"}, "unknown task 'stack'; allowed: 'put_block_in_bowl'"),
        ({"control": "joints"}, "unknown control 'joints'; allowed: 'primitive', 'ee'"),
        ({"camera": "top"}, "unknown camera 'top'; allowed: 'paper', 'close'"),
        ({"render_mode": "ansi"}, "unknown render_mode 'ansi'"),
        ({"extras": "lidar"}, "unknown extras 'lidar'; allowed"),
        ({"extras": ("lidar",)}, "unknown extras 'lidar'; allowed: 'depth', 'segmentation', 'proprio'"),
        ({"image_size": 4}, "image_size must be a whole number of 16 to 2048, not 4"),
        ({"image_size": 64.5}, "image_size must be a whole number"),
        ({"object_scale": 3}, "object_scale must be a number of 0.5 to 1.0, not 3"),
        ({"physics_hz": 10}, "physics_hz must be a whole number of 120 to 2000"),
        ({"render_stride": 0}, "render_stride must be a whole number of 1 to 24"),
        ({"max_steps": 0}, "max_steps must be"),
    ],
)
def test_wrong_constructor_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make("PutBlockInBowl-v0", **arguments)


def test_wrong_number_of_pairs_is_refused() -> None:
    with pytest.raises(ValueError, match="n_pairs must be a whole number of 2 to 3, not 4"):
        gym.make("PutBlocksInBowls-v0", n_pairs=4)


def test_a_goal_with_one_bowl_twice_is_refused(make: Make) -> None:
    env = make("PutBlocksInBowls-v0")
    yellow = {"kind": "block", "color": "yellow", "xy": (0.4, 0.1)}
    text = "put the red block in the blue bowl and the yellow block in the blue bowl"
    with pytest.raises(ValueError, match="must not name a bowl twice"):
        env.reset(options={"layout": [RED, BLUE, yellow], "instruction": text})


def test_a_window_without_a_display_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.warns(UserWarning, match="needs a display"):
        env = gym.make("PutBlockInBowl-v0", render_mode="human")
    env.close()


def test_a_refused_first_reset_can_be_put_right() -> None:
    env = gym.make("PutBlockInBowl-v0", control="primitive")
    with pytest.raises(ValueError, match="n_blocks"):
        env.reset(seed=0, options={"n_blocks": -1})
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[4]["sim_step"] > 0
    env.close()
