from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
import pytest

from envs import collection
from envs.collect import Args
from envs.collection import collect
from envs.episode import EpisodeConfig, record_episode
from envs.splits import SPLITS
from textocvp.data.episodes import EpisodeFile

ROOT = Path(__file__).parents[2]
# Small enough for CI: 16x16 pixels at 8 frames a second, in pieces of 3 episodes.
SMALL = EpisodeConfig("val", image_size=16, render_stride=24)
RUN = """
import sys
from pathlib import Path
from envs import collection
from envs.episode import EpisodeConfig
collection.EPISODES_PER_PIECE, collection.EPISODES_PER_MERGE = 3, 6
config = EpisodeConfig("val", image_size=16, render_stride=24)
collection.collect(config, 14, Path(sys.argv[1]), workers=1)
"""


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collection, "EPISODES_PER_PIECE", 3)
    monkeypatch.setattr(collection, "EPISODES_PER_MERGE", 6)


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


def test_the_file_holds_what_the_episodes_were(whole: Path) -> None:
    env = SMALL.make()
    with EpisodeFile(whole) as file, h5py.File(whole) as raw:
        assert len(file) == 14 and file.split == "val"
        assert file.seeds.tolist() == [SPLITS["val"].seed(number) for number in range(14)]
        recorded = record_episode(env, SMALL, 5)
        episode = file.episode(5)
        assert np.array_equal(episode.frames, recorded.frames)
        assert np.array_equal(episode.segmentation, recorded.segmentation)
        assert episode.instruction == recorded.instruction and episode.target == recorded.target
        assert tuple((item.kind, item.color) for item in episode.objects) == recorded.objects
        assert episode.success == recorded.success and file.success.mean() > 0.9
        start, length = raw["episode/start"][5], raw["episode/length"][5]
        span, count = slice(start, start + length), len(recorded.objects)
        assert np.array_equal(raw["arm"][span], recorded.arm)
        assert np.array_equal(raw["gripper"][span], recorded.gripper)
        assert np.array_equal(raw["object_position"][span, :count], recorded.position)
        assert np.isnan(raw["object_orientation"][span, count:]).all()
        _, info = env.reset(seed=0)
        assert np.allclose(file.attribute("camera_intrinsics"), info["camera"]["intrinsics"])
        assert np.allclose(file.attribute("camera_extrinsics"), info["camera"]["extrinsics"])
        assert '"pybullet"' in file.attribute("versions")
    env.close()


def test_two_workers_write_the_same_file(whole: Path, tmp_path: Path) -> None:
    collect(SMALL, 14, tmp_path / "two.h5", workers=2)
    assert contents(tmp_path / "two.h5") == contents(whole)
    assert not (tmp_path / "two.h5.parts").exists()


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


def test_killed_again_and_again_it_loses_and_doubles_nothing(whole: Path, tmp_path: Path) -> None:
    """SIGKILL to the whole process group, soon after each new sign of progress, until a run comes through."""
    path = tmp_path / "killed.h5"
    kills = 0
    for attempt in range(12):
        process = subprocess.Popen(
            [sys.executable, "-c", RUN, str(path)],
            cwd=ROOT,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
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
            with EpisodeFile(path) as file:  # opens, and is consistent, whenever the kill came
                assert file.seeds.tolist() == [SPLITS["val"].seed(number) for number in range(len(file))]
                assert len(file.episode(-1).frames) == file.lengths[-1]
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


@pytest.mark.parametrize(
    ("arguments", "message"), [({"episodes": 0}, "1 to 10000000"), ({"workers": 0}, "at least 1")]
)
def test_wrong_arguments_are_refused(arguments: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Args(**arguments)


def test_the_command_line_collects_and_previews(tmp_path: Path) -> None:
    def run(*arguments: str) -> str:
        command = [sys.executable, "-m", "envs.collect", "--split", "test", "--image-size", "32", *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    out = tmp_path / "test.h5"
    assert "2 episodes of split test" in run("--episodes", "2", "--out", str(out))
    with EpisodeFile(out) as file:
        assert len(file) == 2 and file.image_size == 32
    run("--preview", "--episodes", "2", "--out", str(tmp_path / "sheet.png"))
    sheet = iio.imread(tmp_path / "sheet.png")
    assert sheet.shape == (2 * 132, 9 * 132, 3)
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 20
