"""What others do with an environment: copy it, film it, join several, drop it, and want a scene again."""

from __future__ import annotations

import copy
import gc
import json
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet as p
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import SyncVectorEnv

import envs
from envs import Expert, dataset
from envs.dataset import EpisodeConfig, collect
from envs.physics.simulation import _opens_windows
from textocvp.data.episodes import EpisodeFile

Make = Callable[..., gym.Env[Any, Any]]
tiny = partial(gym.make, "PutBlockInBowl-v0", image_size=16)
RED_TO_BLUE = "put the red block in the blue bowl"


def places(env: gym.Env[Any, Any]) -> np.ndarray:
    """Where all objects are (n, 3)."""
    return env.unwrapped.world.poses()[0]


# -- Wishes and lists of scenes ----------------------------------------------------------------------------


def test_wishes_hold_for_every_episode_of_a_vector_environment() -> None:
    wishes = {"n_objects": 8, "n_bowls": 3, "instruction": RED_TO_BLUE, "arm_start": "random"}
    many = gym.make_vec("PutBlockInBowl-v0", 2, "sync", max_steps=1, image_size=16, **wishes)
    infos = [many.reset(seed=[1, 2])[1]]
    many.action_space.seed(0)
    infos += [many.step(many.action_space.sample())[4] for _ in range(4)]  # two automatic resets
    for info in infos:
        assert [len(objects) for objects in info["objects"]] == [8, 8]
        assert list(info["instruction"]) == [RED_TO_BLUE] * 2
    many.close()


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_vector_environments_join_steps_of_other_lengths(control: str) -> None:
    many = SyncVectorEnv([partial(tiny, record_frames=True, control=control)] * 2)
    many.reset(seed=[1, 2])
    many.action_space.seed(0)
    lengths = []
    for _ in range(4):
        info = many.step(many.action_space.sample())[4]
        assert all(frame.shape == (16, 16, 3) for frames in info["frames"] for frame in frames)
        assert [len(tips) for tips in info["frame_states"]["gripper"]] == list(map(len, info["frames"]))
        lengths += map(len, info["frames"])
    assert len(set(lengths)) > 1 or control == "ee"
    many.close()


def test_an_argument_is_the_reset_option(make: Make) -> None:
    """Layout and values of factors together show a scene of "varied" again, whatever the seed."""
    varied = make(scene="varied", image_size=32)
    observation, info = varied.reset(seed=4, options={"n_objects": 4})
    again = gym.make(
        "PutBlockInBowl-v0", scene="varied", image_size=32, layout=info["objects"], factors=info["factors"]
    )
    assert np.array_equal(again.reset(seed=9)[0]["rgb"], observation["rgb"])
    # A layout of the reset stands instead of a random scene of the constructor.
    eight = tiny(n_objects=8)
    assert len(eight.reset(seed=1, options={"layout": LAYOUT})[1]["objects"]) == 2
    assert len(eight.reset(seed=1, options={"n_objects": 5})[1]["objects"]) == 5
    assert len(eight.reset(seed=1)[1]["objects"]) == 8
    again.close()
    eight.close()


LAYOUT = [{"kind": "block", "color": "red", "xy": (0.5, 0.1)}, {"kind": "bowl", "color": "blue", "xy": (0.5, -0.1)}]


def test_a_list_of_scenes_is_walked_through(make: Make, tmp_path: Path) -> None:
    scenes = [7, {"seed": 8, "n_objects": 4}, {"layout": LAYOUT}]
    plain = make(image_size=16)
    wanted = [plain.reset(seed=7)[0], plain.reset(seed=8, options={"n_objects": 4})[0]]
    wanted.append(plain.reset(seed=2, options={"layout": LAYOUT})[0])
    (tmp_path / "scenes.json").write_text(json.dumps(scenes))
    for given in (scenes, tmp_path / "scenes.json"):
        env = tiny(scenes=given, n_objects=8)
        env.unwrapped._wishes = {}  # of the list alone
        for number in (0, 1, 2, 0):
            observation, info = env.reset()
            assert info["scene_number"] == number
            assert np.array_equal(observation["rgb"], wanted[number]["rgb"])
            assert observation["instruction"] == wanted[number]["instruction"]
        numbers = [env.reset(seed=np.int64(4))[1]["scene_number"], env.reset()[1]["scene_number"]]
        assert numbers == [1, 2]
        env.close()


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"n_object": 8}, TypeError, "unexpected argument 'n_object'; reset options that are arguments: .*n_obj"),
        ({"n_objects": 9}, ValueError, "n_objects must be 2 to 8"),
        ({"layout": LAYOUT, "n_objects": 3}, ValueError, "cannot be given with a layout"),
        ({"scenes": []}, ValueError, "a list of at least one seed or mapping"),
        ({"scenes": 5}, ValueError, "a list of at least one seed or mapping"),
        ({"scenes": [1, "x"]}, ValueError, "scene 1 of scenes: seed must be a whole number of at least 0"),
        ({"scenes": [{"n_objects": 99}]}, ValueError, "scene 0 of scenes: n_objects must be"),
        ({"render_size": 8}, ValueError, "render_size must be a whole number of 16 to 2048"),
        ({"extras": None}, ValueError, "extras and observations are names, or lists of names"),
        ({"observations": 3}, ValueError, "extras and observations are names, or lists of names"),
        ({"task": None}, ValueError, "unknown task None; allowed: .*put_block_in_bowl"),
        ({"factors": "all"}, ValueError, "factors are Factors or a mapping of values, not 'all'"),
        ({"place_yaw": "yes"}, ValueError, "unknown place_yaw 'yes'; allowed: False, True"),
        ({"record_frames": "no"}, ValueError, "unknown record_frames 'no'; allowed: False, True"),
    ],
)
def test_wrong_wishes_are_refused_at_once(arguments: dict[str, Any], kind: Any, message: str) -> None:
    with pytest.raises(kind, match=message):
        tiny(**arguments)


def test_a_file_that_is_no_list_of_scenes_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scenes.json").write_text("[1,")
    with pytest.raises(ValueError, match=r"scenes\.json is not a JSON file with a list of scenes"):
        tiny(scenes=tmp_path / "scenes.json")


def test_seeds_may_be_numpys_and_large_but_nothing_else(make: Make) -> None:
    env = make(image_size=16)
    wanted = env.reset(seed=5)[0]["rgb"]
    for seed in (np.int64(5), np.uint8(5)):
        assert np.array_equal(env.reset(seed=seed)[0]["rgb"], wanted)
    env.reset(seed=2**64)
    for wrong in (-1, 1.0, "5", True):
        with pytest.raises(ValueError, match="seed must be a whole number of at least 0"):
            env.reset(seed=wrong)


# -- Copies ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clone", [copy.deepcopy, copy.copy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_a_copy_is_a_world_of_its_own_with_the_same_future(clone: Any, control: str) -> None:
    env = tiny(control=control, scene="varied", record_frames=True).unwrapped
    env.reset(seed=3, options={"arm_start": "random"})
    env.action_space.seed(0)
    actions = Expert(env).actions()
    for _ in range(12 if control == "ee" else 0):  # the block hangs at the arm
        env.step(next(actions))
    twin, before = clone(env), places(env)
    for key in ("frames", "frame_segmentations"):
        assert np.array_equal(twin._info()[key], env._info()[key])
    rest = [(action, twin.step(action)) for action in islice(Expert(twin).actions(), 3)]
    assert np.array_equal(places(env), before), "the original did not move"
    for action, (observation, *others) in rest:
        ours, *own = env.step(action)
        assert np.array_equal(ours["rgb"], observation["rgb"]) and own[:3] == others[:3]
    assert np.array_equal(places(env), places(twin))
    assert np.array_equal(env.action_space.sample(), twin.action_space.sample())
    assert np.array_equal(env.reset()[0]["rgb"], twin.reset()[0]["rgb"]), "the generators go on alike"
    twin.close()
    env.reset(seed=3)
    env.close()


def test_a_copy_before_the_first_reset_and_of_a_wrapped_environment() -> None:
    env = tiny(max_steps=1)
    twin = copy.deepcopy(env)
    assert np.array_equal(twin.reset(seed=1)[0]["rgb"], env.reset(seed=1)[0]["rgb"])
    assert twin.unwrapped.world.bullet.client != env.unwrapped.world.bullet.client
    with pytest.raises(TypeError, match="copy the environment"):
        copy.deepcopy(env.unwrapped.world)
    twin.close()
    env.close()


def test_reset_options_are_named_by_strings() -> None:
    env = tiny()
    with pytest.raises(ValueError, match="unknown reset option 3, 'x'; allowed: layout"):
        env.reset(seed=0, options={3: 4, "x": 1})
    env.close()


# -- The end -----------------------------------------------------------------------------------------------


def test_a_dropped_environment_is_freed() -> None:
    env = tiny()
    env.reset(seed=0)
    client = env.unwrapped.world.bullet.client
    assert p.isConnected(client)
    del env
    gc.collect()
    assert not p.isConnected(client)


def test_use_after_close_is_a_clear_error_and_touches_no_other_world() -> None:
    env = tiny()
    env.reset(seed=0)
    action = next(Expert(env).actions())
    env.close()
    other = tiny()  # PyBullet gives it the same number
    other.reset(seed=1)
    before = places(other)
    for use in (
        lambda: env.reset(seed=1),
        lambda: env.step(action),
        lambda: copy.deepcopy(env),
        lambda: pickle.dumps(env),
        lambda: env.unwrapped.world.pose(0),
    ):
        with pytest.raises(ClosedEnvironmentError, match="was closed; make a new one"):
            use()
    env.close()
    assert np.array_equal(places(other), before)
    other.close()


@pytest.mark.parametrize("scene", ["simple", "cliport"])
def test_a_swept_temporary_folder_is_filled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene: str) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "swept"))
    env = tiny(scene=scene)
    observation, _ = env.reset(seed=2)
    shutil.rmtree(tmp_path / "swept", ignore_errors=True)
    env.reset(seed=1)
    assert np.array_equal(env.reset(seed=2)[0]["rgb"], observation["rgb"])
    env.close()


def test_a_display_that_nobody_serves_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":77")
    assert not _opens_windows(":77")
    with pytest.warns(UserWarning, match="needs a display and DISPLAY ':77' shows no window"):
        env = tiny(render_mode="human")
    env.reset(seed=0)
    env.close()


# -- Films -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_a_film_has_every_frame_in_its_own_size(make: Make, control: str) -> None:
    env = tiny(control=control, render_mode="rgb_array_list", render_size=48)
    recorded = make(control=control, image_size=48, record_frames=True)
    frames = list(recorded.reset(seed=0)[1]["frames"])
    observation, _ = env.reset(seed=0)
    for action in Expert(env).actions():
        observation = env.step(action)[0]
    for action in Expert(recorded).actions():
        frames += recorded.step(action)[4]["frames"]
    film = env.render()
    assert observation["rgb"].shape == (16, 16, 3)
    assert len(film) > 20 and np.array_equal(film, frames)
    assert env.render() == [], "what was seen is gone"
    env.reset(seed=0)
    assert len(env.render()) == 1
    env.close()


def test_render_before_a_reset_is_an_error() -> None:
    env = tiny(render_mode="rgb_array", render_size=32).unwrapped
    with pytest.raises(ResetNeeded, match="call reset"):
        env.render()
    env.reset(seed=0)
    assert env.render().shape == (32, 32, 3)
    env.close()


@pytest.mark.parametrize("control", ["primitive", "ee"])
def test_a_video_of_both_controls_has_every_frame(
    tmp_path: Path, control: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []

    class Clip:  # in the place of moviepy's, which need not be installed
        def __init__(self, frames: list[np.ndarray], fps: int) -> None:
            written.extend([len(frames), fps, *frames[0].shape])

        def write_videofile(self, path: str, **options: Any) -> None:
            Path(path).touch()

    for name in ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip"):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(ImageSequenceClip=Clip))
    env = tiny(control=control, render_mode="rgb_array_list", render_size=32)
    video = envs.RecordVideo(env, str(tmp_path / "film"), episode_trigger=lambda episode: True)
    video.reset(seed=0)
    for action in Expert(video).actions():
        video.step(action)
    video.close()
    assert written == [25, 15, 32, 32, 3]
    assert [path.suffix for path in (tmp_path / "film").iterdir()].count(".mp4") == 1
    with pytest.raises(ValueError, match='render_mode must be "rgb_array_list"'):
        envs.RecordVideo(tiny(render_mode="rgb_array"), str(tmp_path))


# -- Scenes of a file --------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["expert", "any-sentence"])
def test_a_files_scenes_come_back(tmp_path: Path, policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    sentences = 1 if policy == "expert" else 2
    config = EpisodeConfig("val", "varied", 16, policy=policy, sentences=sentences)
    path = tmp_path / "val.h5"
    collect(config, 4, path)
    with EpisodeFile(path) as file:
        for index in (0, 3):
            episode = file.episode(index)
            env, observation, info = envs.scene_of(path, index)
            assert np.array_equal(observation["rgb"], episode.frames[0])
            assert [item["color"] for item in info["objects"]] == [item.color for item in episode.objects]
            if policy == "expert":
                assert observation["instruction"] == episode.instruction
                again = env.reset(seed=file.seeds[index], options=episode.reset_options)[0]
                assert np.array_equal(again["rgb"], episode.frames[0])
            env.close()
    with pytest.raises(IndexError, match="has episodes 0 to 3, not 4"):
        envs.scene_of(path, 4)


def test_a_file_without_options_goes_on_without(tmp_path: Path) -> None:
    config, path = EpisodeConfig("val", image_size=16), tmp_path / "val.h5"
    collect(config, 2, path)
    with dataset.h5py.File(path, "a") as file:
        del file["episode/options"]
    collect(config, 3, path)
    with EpisodeFile(path) as file:
        assert len(file) == 3 and file.episode(2).reset_options is None
        env, observation, _ = envs.scene_of(path, -1)
        assert np.array_equal(observation["rgb"], file.episode(2).frames[0])
        env.close()


def test_a_foreign_file_has_no_scene(tmp_path: Path) -> None:
    with dataset.h5py.File(tmp_path / "own.h5", "w") as file:
        file.attrs.update(format=dataset.FORMAT, format_version=dataset.FORMAT_VERSION)
    for name in ("own.h5", "none.h5"):
        with pytest.raises(ValueError, match=r"was not written by envs\.collect"):
            envs.scene_of(tmp_path / name, 0)
