from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import pytest

from envs import dataset
from envs.collect import Args, main
from envs.colors import SEEN
from envs.dataset import EpisodeConfig, collect, record_episode
from envs.splits import SPLITS
from envs.tabletop import TabletopEnv
from envs.tasks import TASKS
from textocvp.data.episodes import EpisodeFile

ROOT = Path(__file__).parents[2]
# Small enough for CI: 16x16 pixels at 8 frames a second, in pieces of 3 episodes.
SMALL = EpisodeConfig("val", image_size=16, render_stride=24)
SENTENCES = replace(SMALL, policy="any-sentence", sentences=3)
RUN = """
import sys
from pathlib import Path
from envs import dataset
dataset.EPISODES_PER_PIECE, dataset.EPISODES_PER_MERGE = 3, 6
config = dataset.EpisodeConfig("val", image_size=16, render_stride=24)
dataset.collect(config, 14, Path(sys.argv[1]), workers=1)
"""


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "EPISODES_PER_PIECE", 3)
    monkeypatch.setattr(dataset, "EPISODES_PER_MERGE", 6)


def contents(path: Path) -> dict[str, bytes]:
    """Every dataset and attribute of a file, as bytes."""
    found: dict[str, bytes] = {}
    with h5py.File(path) as file:
        file.visititems(
            lambda name, item: (
                found.__setitem__(name, np.asarray(item[()]).astype("S200").tobytes())
                if isinstance(item, h5py.Dataset) and item.dtype == object
                else found.__setitem__(name, item[()].tobytes() if isinstance(item, h5py.Dataset) else b"")
            )
        )
        found |= {f"@{name}": np.asarray(value).astype(str).tobytes() for name, value in file.attrs.items()}
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """14 episodes, collected in one undisturbed run."""
    path = tmp_path_factory.mktemp("whole") / "val.h5"
    collect(SMALL, 14, path)
    return path


@pytest.fixture(scope="module")
def env() -> Iterator[TabletopEnv]:
    env = SMALL.make()
    yield env
    env.close()


def test_the_file_holds_what_the_episodes_were(whole: Path, env: TabletopEnv) -> None:
    recorded = record_episode(env, SMALL, 5)
    with h5py.File(whole) as file:
        index = file["episode"]
        assert file.attrs["split"] == "val" and file.attrs["first_seed"] == SPLITS["val"].first_seed
        assert index["seed"][:].tolist() == [SPLITS["val"].seed(number) for number in range(14)]
        assert index["start"][:].tolist() == [0, *np.cumsum(index["length"])[:-1]]
        assert file["frames"].shape == (index["length"][:].sum(), 16, 16, 3)
        assert index["instruction"].asstr()[5] == recorded.instruction
        assert index["success"][5] == recorded.success and index["success"][:].mean() > 0.9
        start, length = index["start"][5], index["length"][5]
        span, count = slice(start, start + length), len(recorded.objects)
        for name in ("frames", "segmentation", "arm", "gripper"):
            assert np.array_equal(file[name][span], recorded.arrays[name]), name
        for name in ("object_position", "object_orientation"):
            assert np.array_equal(file[name][span, :count], recorded.arrays[name]), name
            assert np.isnan(file[name][span, count:]).all()
        _, info = env.reset(seed=0)
        assert np.allclose(file.attrs["camera_intrinsics"], info["camera"]["intrinsics"])
        assert np.allclose(file.attrs["camera_extrinsics"], info["camera"]["extrinsics"])
        assert '"pybullet"' in file.attrs["versions"]


def test_the_file_says_what_its_labels_words_and_questions_are(whole: Path, env: TabletopEnv) -> None:
    """Format version 2: a reader needs to know no task."""
    with h5py.File(whole) as file:
        assert (file.attrs["format"], file.attrs["format_version"]) == ("textocvp-episodes", 2)
        assert "target" not in file["episode"]
        labels = json.loads(file.attrs["labels"])
        vocabulary = json.loads(file.attrs["vocabulary"])
        assert labels == {"background": 0, "robot": 1}
        assert vocabulary == list(TASKS["put_block_in_bowl"].vocabulary)
        for number in range(14):
            seed = int(file["episode/seed"][number])
            _, info = env.reset(seed=seed, options=SPLITS["val"].options(seed))
            objects = json.loads(file["episode/objects"].asstr()[number])
            assert objects == [
                {name: item[name] for name in ("id", "label", "kind", "color")} for item in info["objects"]
            ]
            known = {*labels.values(), *(item["label"] for item in objects)}
            first = file["segmentation"][file["episode/start"][number]]
            assert set(np.unique(first)) <= known and len(known) == len(objects) + 2
            questions = json.loads(file["episode/questions"].asstr()[number])
            played = [q for q in questions if q["text"] == file["episode/instruction"].asstr()[number]]
            assert [(q["moves"], q["ends_at"]) for q in played] == [tuple(info["target"][0])]
            words = {word for question in questions for word in question["text"].split()}
            assert words <= set(vocabulary)
            kinds = [item["kind"] for item in objects]
            assert len(questions) == kinds.count("block") * kinds.count("bowl")


def test_the_page_names_every_field(whole: Path) -> None:
    page = (ROOT / "docs" / "data.md").read_text()
    fields = [name for name in contents(whole) if name != "episode"]
    assert len(fields) == 15 + 3 + 10
    for name in fields:
        assert f"| `{name.removeprefix('@')}` |" in page, name


def test_the_example_of_the_page_writes_what_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (ROOT / "docs" / "data.md").read_text()
    monkeypatch.chdir(tmp_path)
    exec(page.split("## A file of your own")[1].split("```python\n")[1].split("```")[0], {})
    needed = {line.split("`")[1] for line in page.splitlines() if line.startswith("| `") and "| yes |" in line}
    assert {name.removeprefix("@") for name in contents(tmp_path / "own.h5")} == {*needed, "episode"}
    with h5py.File("own.h5") as file:
        assert len(file["frames"]) == file["episode/length"][:].sum() == 51
        assert file["episode/start"][:].tolist() == [0, 20]
        assert file["episode/instruction"].asstr()[1] == "put the green block in the gray bowl"


@pytest.fixture(scope="module")
def sentences(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """7 random sentences in 3 scenes, collected in one undisturbed run."""
    path = tmp_path_factory.mktemp("sentences") / "val.h5"
    collect(SENTENCES, 7, path)
    return path


def test_sentences_follow_each_other_in_a_scene(sentences: Path) -> None:
    with h5py.File(sentences) as file:
        index, task = file["episode"], TASKS["rearrange_blocks"]
        assert index["sentence"][:].tolist() == [0, 1, 2, 0, 1, 2, 0]
        assert index["seed"][:].tolist() == [SPLITS["val"].seed(n // 3) for n in range(7)]
        assert json.loads(file.attrs["vocabulary"]) == list(task.vocabulary)
        config = json.loads(file.attrs["config"])
        assert (config["policy"], config["sentences"]) == ("any-sentence", 3)
        before, after = index["supports_before"][:], index["supports_after"][:]
        ends = index["start"][:] + index["length"][:]
        for number in range(7):
            objects = json.loads(index["objects"].asstr()[number])
            count = len(objects)
            assert (before[number, count:] == -3).all() and (before[number, :count] >= -2).all()
            (step,) = task.parse(index["instruction"].asstr()[number])
            thing, target = (
                next(item["id"] for item in objects if (item["color"], item["kind"]) == tuple(named))
                for named in (step.thing, step.target)
            )
            assert {step.thing.color, step.target.color} <= set(SEEN)
            assert index["success"][number] == (after[number, thing] == target)
            asked = json.loads(index["questions"].asstr()[number])
            played = [each for each in asked if each["text"] == index["instruction"].asstr()[number]]
            moved = np.flatnonzero(before[number] != after[number]).tolist()
            assert moved == [each["moves"] for each in played], "the rule holds here, as nothing falls"
            assert [after[number, each["moves"]] for each in played] == [each["ends_at"] for each in played]
            if index["sentence"][number]:
                assert np.array_equal(before[number], after[number - 1])
                for name in ("frames", "segmentation", "object_position"):
                    first, last = file[name][index["start"][number]], file[name][ends[number - 1] - 1]
                    assert np.array_equal(first, last, equal_nan=name == "object_position"), name


def test_the_page_names_the_fields_of_sentences(sentences: Path) -> None:
    page = (ROOT / "docs" / "data.md").read_text()
    fields = [name for name in contents(sentences) if name != "episode"]
    assert len(fields) == 15 + 3 + 3 + 10
    assert all(f"| `{name.removeprefix('@')}` |" in page for name in fields)


def test_sentences_are_the_same_from_two_workers_and_in_two_runs(sentences: Path, tmp_path: Path) -> None:
    """The first run stops in the middle of a scene."""
    collect(SENTENCES, 4, tmp_path / "two.h5", workers=2)
    collect(SENTENCES, 7, tmp_path / "two.h5", workers=2)
    assert contents(tmp_path / "two.h5") == contents(sentences)


def test_files_of_other_policies_are_not_mixed(whole: Path, sentences: Path) -> None:
    for path, config in ((whole, SENTENCES), (sentences, SMALL), (sentences, replace(SENTENCES, sentences=2))):
        with pytest.raises(ValueError, match=r"was collected with .* differs from"):
            collect(config, 20, path)
    with h5py.File(whole) as file:
        assert "policy" not in json.loads(file.attrs["config"]), "as in files that are older than policies"


def test_a_reader_finds_the_supports(whole: Path, sentences: Path) -> None:
    with EpisodeFile(sentences) as episodes, h5py.File(sentences) as file:
        for number, episode in enumerate(episodes):
            count = len(episode.objects)
            assert episode.supports is not None and len(episode.supports[0]) == count
            assert episode.supports[1] == tuple(file["episode/supports_after"][number, :count].tolist())
    with EpisodeFile(whole) as episodes:
        assert episodes.episode(0).supports is None


def test_two_workers_write_the_same_file(whole: Path, tmp_path: Path) -> None:
    collect(SMALL, 14, tmp_path / "two.h5", workers=2)
    assert contents(tmp_path / "two.h5") == contents(whole)
    assert not (tmp_path / "two.h5.parts").exists()


def test_a_dask_cluster_writes_the_same_file_and_a_worker_that_dies_is_replaced(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)  # the cluster's processes are elsewhere
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        victim = next(iter(cluster.workers.values())).pid
        parts = tmp_path / "cluster.h5.parts"

        def kill_when_it_works() -> None:
            while not any(parts.glob("*.h5")):
                time.sleep(0.01)
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill_when_it_works, daemon=True)
        killer.start()
        monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", cluster.scheduler_address)
        collect(SMALL, 14, Path("cluster.h5"), backend="dask")
        killer.join(timeout=1)
        assert not killer.is_alive(), "a worker was killed"
    assert contents(tmp_path / "cluster.h5") == contents(whole)
    assert [item.name for item in tmp_path.iterdir()] == ["cluster.h5"]


def test_ray_writes_the_same_file(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)  # a cluster of two processes here
    collect(SMALL, 14, tmp_path / "ray.h5", workers=2, backend="ray")
    assert contents(tmp_path / "ray.h5") == contents(whole)


def test_a_backend_that_is_not_installed_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"dask is not installed: pip install 'textocvp\[dask\]'"):
        collect(SMALL, 3, tmp_path / "none.h5", backend="dask")
    assert not list(tmp_path.iterdir())


def test_a_finished_file_is_left_alone(whole: Path) -> None:
    before = whole.stat()
    collect(SMALL, 14, whole)
    collect(SMALL, 3, whole)
    assert whole.stat().st_mtime_ns == before.st_mtime_ns and whole.stat().st_ino == before.st_ino


def test_a_file_can_be_extended(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "growing.h5"
    collect(SMALL, 4, path)
    collect(SMALL, 14, path)
    assert contents(path) == contents(whole)


def test_what_was_done_shows_the_same_frames_again(whole: Path) -> None:
    ee = TabletopEnv("put_block_in_bowl", control="ee", image_size=16, render_stride=24, max_steps=99)
    env = SMALL.make()
    with EpisodeFile(whole) as file:
        for index in (0, 5):
            one = file.episode(index)
            assert one.action is not None and one.reward is not None and one.state is not None
            assert not one.action[-1].any() and one.action.dtype == np.float32
            shown = [ee.reset(seed=one.seed, options=one.reset_options)[0]["rgb"]]
            shown += [ee.step(action)[0]["rgb"] for action in one.action[:-1]]
            assert np.array_equal(np.stack(shown), one.frames)
            (primitive,) = one.primitives
            env.reset(seed=one.seed, options=one.reset_options)
            _, reward, _, _, info = env.step(np.array(primitive["action"], np.float32))
            assert primitive["frame"] == 0 and np.array_equal(info["frames"], one.frames[1:])
            assert np.flatnonzero(one.reward).tolist() == [len(one.frames) - 2] and one.reward[-2] == reward
            assert one.state.shape == (len(one.frames), 11)
    ee.close()
    env.close()


def test_actions_of_sentences(sentences: Path) -> None:
    """Each from its own first frame, rewarded for what the sentence itself brings about."""
    with EpisodeFile(sentences) as file, h5py.File(sentences) as stored:
        for index, one in enumerate(file):
            assert one.action is not None and one.reward is not None
            assert one.action[0].any() and not one.action[-1].any(), "no motion of the sentence before"
            assert [item["frame"] for item in one.primitives] == [0]
            assert one.reward.sum() in ((0, 1) if one.success else (-1, 0)), index
        assert np.array_equal(file.episode(0).action, stored["action"][: len(file.frames(0))])


def test_a_file_from_before_there_were_actions_goes_on_without(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "old.h5"
    collect(SMALL, 4, path)
    with h5py.File(path, "r+") as file:
        for name in ("action", "reward", "episode/primitives"):
            del file[name]
    with EpisodeFile(path) as file:
        one = file.episode(0)
        assert one.action is None and one.reward is None and one.primitives == ()
    collect(SMALL, 14, path)
    wanted = {n: v for n, v in contents(whole).items() if n not in ("action", "reward", "episode/primitives")}
    assert contents(path) == wanted


def test_killed_again_and_again_it_loses_and_doubles_nothing(whole: Path, tmp_path: Path) -> None:
    """SIGKILL to the whole process group, soon after each new sign of progress, until a run comes through."""
    path = tmp_path / "killed.h5"
    kills = 0
    for attempt in range(12):
        process = subprocess.Popen(
            [sys.executable, "-c", RUN, str(path)], cwd=ROOT, stderr=subprocess.DEVNULL, start_new_session=True
        )
        before = progress(path)
        while process.poll() is None and (attempt >= 8 or progress(path) == before):
            time.sleep(0.002)
        if process.poll() is None:
            time.sleep(0.02 * (attempt % 4))
            os.killpg(process.pid, signal.SIGKILL)
            kills += 1
        code = process.wait()
        if path.exists():
            with h5py.File(path) as file:  # opens, and is consistent, whenever the kill came
                seeds = file["episode/seed"][:].tolist()
                assert seeds == [SPLITS["val"].seed(number) for number in range(len(seeds))]
                assert len(file["frames"][:]) == file["episode/length"][:].sum()
        if code == 0:
            break
    assert code == 0 and kills >= 3
    assert contents(path) == contents(whole)
    assert [item.name for item in tmp_path.iterdir()] == ["killed.h5"]  # no leftovers


def progress(path: Path) -> tuple[str, ...]:
    """Names of all that is on disk."""
    return tuple(sorted(item.name for item in path.parent.rglob("*")))


def test_another_configuration_is_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r'was collected with .*"split": "val".* differs from .*"test"'):
        collect(EpisodeConfig("test", image_size=16, render_stride=24), 20, whole)
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(ValueError, match="is not an episode file"):
        collect(SMALL, 2, tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ValueError, match="not an episode file; choose another --out"):
        collect(SMALL, 2, tmp_path / "other.h5")


def test_a_file_of_version_1_is_not_appended_to(whole: Path, tmp_path: Path) -> None:
    old = shutil.copy(whole, tmp_path / "old.h5")
    with h5py.File(old, "a") as file:
        file.attrs["format_version"] = 1
    with pytest.raises(ValueError, match="has format version 1, and version 2 cannot be appended"):
        collect(SMALL, 20, old)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "1 to 10000000"),
        ({"workers": 0}, "at least 1"),
        ({"without": ("tint",)}, "--without leaves out nothing of --scene simple; --scene varied has"),
        ({"policy": "any-sentence", "sentences_per_scene": 0}, "--sentences-per-scene must be .* at least 1"),
        ({"sentences_per_scene": 3}, "--sentences-per-scene needs --policy any-sentence"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Args(**arguments)


def test_the_command_line_collects_and_previews(tmp_path: Path) -> None:
    def run(*arguments: str) -> str:
        command = [sys.executable, "-m", "envs.collect", "--split", "test", "--image-size", "32", *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    out = tmp_path / "test.h5"
    with pytest.raises(subprocess.CalledProcessError) as twice:
        run("--scene", "varied", "--without", "tint", "--without", "block", "--out", str(out))
    assert "error: give --without once" in twice.value.stderr and not out.exists()
    assert "2 episodes of split test" in run("--episodes", "2", "--out", str(out))
    with h5py.File(out) as file:
        assert len(file["episode/seed"]) == 2 and file["frames"].shape[1:] == (32, 32, 3)
    run("--preview", "--episodes", "2", "--out", str(tmp_path / "sheet.png"))
    sheet = iio.imread(tmp_path / "sheet.png")
    assert sheet.shape == (2 * 132, 9 * 132, 3)
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 20


def test_two_collectors_of_one_file_do_not_meet(tmp_path: Path) -> None:
    """The second is refused while the first is at work, and not afterwards."""
    out, config = tmp_path / "one.h5", EpisodeConfig("train", image_size=16)
    with dataset._only_collector(out), pytest.raises(ValueError, match="being collected by another process"):
        collect(config, 1, out)
    assert not out.exists()
    collect(config, 1, out)
    assert dataset.episode_count(out, config) == 1 and [path.name for path in tmp_path.iterdir()] == ["one.h5"]


def test_fresh_throws_the_episodes_away_and_nothing_else(tmp_path: Path) -> None:
    path, other = tmp_path / "a.h5", tmp_path / "notes.txt"
    collect(EpisodeConfig("val"), 2, path)
    with pytest.raises(ValueError, match="choose another --out"):
        collect(EpisodeConfig("test"), 1, path)
    collect(EpisodeConfig("test"), 1, path, fresh=True)
    with h5py.File(path) as file:
        assert file.attrs["split"] == "test" and len(file["episode/length"]) == 1
    other.write_text("mine")
    with pytest.raises(ValueError, match="is not thrown away"):
        collect(EpisodeConfig("test"), 1, other, fresh=True)
    assert other.read_text() == "mine"


def test_a_piece_that_lacks_a_column_is_collected_again(tmp_path: Path) -> None:
    config, whole, path = EpisodeConfig("val"), tmp_path / "whole.h5", tmp_path / "a.h5"
    collect(config, 2, whole)
    parts = tmp_path / "a.h5.parts"
    parts.mkdir()
    piece = parts / "0000000-0000002.h5"
    piece.write_bytes(whole.read_bytes())
    with h5py.File(piece, "r+") as file:  # as an older version wrote it
        del file["episode/options"]
    collect(config, 2, path)
    with h5py.File(whole) as one, h5py.File(path) as two:
        assert np.array_equal(one["episode/options"][:], two["episode/options"][:])
        assert np.array_equal(one["frames"][:], two["frames"][:])


@pytest.mark.parametrize(("scene", "told"), [("simple", False), ("cliport", True)])
def test_an_arm_of_another_shape_is_told_at_the_end(
    scene: str, told: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("envs.scenes.find_package", lambda: None)
    main(Args(split="val", episodes=1, scene=scene, image_size=32, out=tmp_path / "a.h5"))
    assert ("arm is drawn with cylinders" in capsys.readouterr().out) == told
