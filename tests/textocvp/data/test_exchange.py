"""Sets of other projects: what goes out and comes back is the same, byte for byte; their own libraries open it."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import imageio.v3 as iio
import numpy as np
import pytest

from textocvp.cli import main
from textocvp.data.cliport import CliportEpisodes
from textocvp.data.episodes import Episode, EpisodeFile
from textocvp.data.exchange import _new_folder, export, import_set, kind_of
from textocvp.data.own_videos import OwnVideosError, write_episodes

SENTENCES = ("put the red block in the blue bowl", "lege den grünen Block in die Schüssel")
PRIMITIVE = {"frame": 0, "action": [0.5, float(np.float32(0.1)), 0.4, -0.2]}


def episodes(count: int = 3, side: int = 16) -> list[Episode]:
    """Of noise, which nothing lossy survives; of different lengths."""
    rng = np.random.default_rng(0)
    made = []
    for number in range(count):
        T = 5 + number
        action = rng.normal(size=(T, 5)).astype(np.float32)
        action[-1] = 0
        made.append(
            Episode(
                frames=rng.integers(0, 256, (T, side, side, 3), np.uint8), instruction=SENTENCES[number % 2],
                seed=2**40 + number, success=number != 1, action=action,
                reward=np.append(rng.normal(size=T - 1), 0).astype(np.float32),
                state=rng.normal(size=(T, 11)).astype(np.float32), primitives=(PRIMITIVE,),
            )
        )  # fmt: skip
    return made


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_episodes(tmp_path / "own.h5", episodes())
    return tmp_path / "own.h5"


def needs(to: str) -> None:
    pytest.importorskip("pyarrow" if to == "lerobot" else "minari")


def assert_same(path: Path, wanted: list[Episode]) -> None:
    with EpisodeFile(path) as found:
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            for name in ("frames", "action", "reward", "state"):
                a, b = getattr(one, name), getattr(other, name)
                assert (a is None) == (b is None), name
                if a is not None:
                    assert a.dtype == b.dtype and a.tobytes() == b.tobytes() and a.shape == b.shape, name
            for name in ("instruction", "seed", "success", "primitives"):
                assert getattr(one, name) == getattr(other, name), name


@pytest.mark.parametrize("to", ["lerobot", "minari"])
def test_out_and_back_every_byte_is_the_same(file: Path, to: str, capsys) -> None:
    needs(to)
    out, back = file.parent / "tabletop-v0", file.parent / "back.h5"
    assert main(["data", "export", str(file), "--to", to, "--out", str(out)]) == 0, capsys.readouterr().err
    assert kind_of(out) == to
    assert main(["data", "import", str(out), "--out", str(back)]) == 0, capsys.readouterr().err
    assert "3 episodes, 18 frames" in capsys.readouterr().out
    assert_same(back, episodes())
    assert {p.name for p in file.parent.iterdir()} == {"own.h5", "back.h5", "tabletop-v0"}


def test_episodes_without_actions_go_to_lerobot_alone(tmp_path: Path) -> None:
    needs("lerobot")
    bare = [
        replace(e, action=None, reward=None, state=None, seed=None, success=None, primitives=()) for e in episodes()
    ]
    write_episodes(tmp_path / "own.h5", bare)
    export(tmp_path / "own.h5", "lerobot", tmp_path / "set")
    import_set(tmp_path / "set", tmp_path / "back.h5")
    assert_same(tmp_path / "back.h5", bare)
    needs("minari")
    with pytest.raises(OwnVideosError, match=r"own\.h5 has no actions, and Minari's episodes are of steps"):
        export(tmp_path / "own.h5", "minari", tmp_path / "own-v0")
    assert not (tmp_path / "own-v0").exists() and not (tmp_path / ".new-own-v0").exists()


def test_minaris_files_are_begun_only_where_there_is_room(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """HDF5 ends the process when it finds none."""
    pytest.importorskip("minari", reason="minari is not installed")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(OSError, match=r"need about .* MB, of which 0 are free: .*tabletop-v0") as refused:
        export(file, "minari", file.parent / "tabletop-v0")
    assert refused.value.errno == errno.ENOSPC
    assert not list(file.parent.glob("*tabletop-v0*"))


def test_minaris_own_library_opens_it(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari", reason="minari is not installed")
    export(file, "minari", file.parent / "tabletop-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(file.parent))
    found = minari.load_dataset("tabletop-v0")
    assert found.total_episodes == 3 and found.total_steps == 15
    for one, wanted in zip(found.iterate_episodes(), episodes(), strict=True):
        assert one.observations["rgb"].tobytes() == wanted.frames.tobytes()
        assert one.observations["instruction"] == [wanted.instruction] * len(wanted.frames)
        assert one.actions.tobytes() == wanted.action[:-1].tobytes()
        assert one.rewards.tobytes() == wanted.reward[:-1].tobytes()
        assert bool(one.terminations[-1]) == wanted.success != bool(one.truncations[-1])
        assert found.observation_space.contains({name: values[0] for name, values in one.observations.items()})
        assert found.action_space.contains(one.actions[0])


def test_lerobots_own_library_opens_it(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("lerobot", reason="lerobot is not installed")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(file.parent / "cache"))
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    export(file, "lerobot", file.parent / "set")
    found = LeRobotDataset(repo_id="own/set", root=file.parent / "set")
    assert found.num_episodes == 3 and len(found) == 18 and found.fps == 15
    steps = [(e, t) for e in episodes() for t in range(len(e.frames))]
    for index, (wanted, t) in enumerate(steps):
        item = found[index]
        frame = (item["observation.images.rgb"].permute(1, 2, 0) * 255).round().byte().numpy()
        assert frame.tobytes() == wanted.frames[t].tobytes()
        assert item["action"].numpy().tobytes() == wanted.action[t].tobytes()
        assert item["observation.state"].numpy().tobytes() == wanted.state[t].tobytes()
        assert float(item["next.reward"]) == wanted.reward[t] and item["task"] == wanted.instruction
    mean = np.concatenate([e.frames for e in episodes()]).mean((0, 1, 2)) / 255
    np.testing.assert_allclose(np.ravel(found.meta.stats["observation.images.rgb"]["mean"]), mean, atol=1e-6)


def test_lerobots_older_layout_with_videos_is_read(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    source, T = tmp_path / "old", 8
    for name in ("meta", "data/chunk-000", "videos/chunk-000/front"):
        (source / name).mkdir(parents=True)
    frames = np.stack([np.full((32, 32, 3), 20 * t, np.uint8) for t in range(T)])
    iio.imwrite(source / "videos/chunk-000/front/episode_000000.mp4", frames, plugin="FFMPEG", fps=10)
    table = {"action": [[float(t)] for t in range(T)], "episode_index": [0] * T, "task_index": [0] * T}
    parquet.write_table(pa.table(table), source / "data/chunk-000/episode_000000.parquet")
    info = {
        "codebase_version": "v2.1", "fps": 10, "total_episodes": 1, "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {"front": {"dtype": "video"}, "side": {"dtype": "video"}, "action": {"dtype": "float32"}},
    }  # fmt: skip
    (source / "meta/info.json").write_text(json.dumps(info))
    (source / "meta/episodes.jsonl").write_text('{"episode_index": 0, "tasks": ["lift it"], "length": 8}\n')
    done = import_set(source, tmp_path / "back.h5")
    assert done.lines == ["this set: took the pictures of front, and not of the other cameras"]
    with EpisodeFile(tmp_path / "back.h5") as found:
        one = found.episode(0)
        assert one.instruction == "lift it" and one.action is not None and one.action[:, 0].tolist() == list(range(T))
        assert np.abs(one.frames.astype(int) - frames).max() < 6, "lossy"
    with pytest.raises(OwnVideosError, match=r"it has no camera top; its cameras: front, side"):
        import_set(source, tmp_path / "other.h5", camera="top")
    (source / "meta/episodes.jsonl").write_text('{"episode_index": 0, "tasks": ["lift it"], "length": 9}\n')
    with pytest.raises(OwnVideosError, match=r"episode_000000\.parquet: 8 frames of episode 0, and 9 are listed"):
        import_set(source, tmp_path / "other.h5")
    info["codebase_version"] = "v1.6"
    (source / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(OwnVideosError, match=r"version v1\.6, and v2\.0, v2\.1 and v3\.0 are read"):
        import_set(source, tmp_path / "other.h5")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["back.h5", "old"]


def test_lerobots_present_layout_with_two_episodes_in_one_video_is_read(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    source, lengths, fps = tmp_path / "new", (5, 7), 10
    for name in ("meta/episodes/chunk-000", "data/chunk-000", "videos/front/chunk-000"):
        (source / name).mkdir(parents=True)
    frames = np.stack([np.full((32, 32, 3), 20 * t, np.uint8) for t in range(sum(lengths))])
    video = source / "videos/front/chunk-000/file-000.mp4"
    iio.imwrite(video, frames, plugin="FFMPEG", fps=fps)
    data = {"episode_index": [0] * lengths[0] + [1] * lengths[1]}
    parquet.write_table(pa.table(data), source / "data/chunk-000/file-000.parquet")
    rows = [
        {
            "episode_index": number, "tasks": [SENTENCES[number]], "length": lengths[number],
            "data/chunk_index": 0, "data/file_index": 0, "videos/front/chunk_index": 0, "videos/front/file_index": 0,
            "videos/front/from_timestamp": sum(lengths[:number]) / fps,
        }
        for number in range(2)
    ]  # fmt: skip
    parquet.write_table(pa.Table.from_pylist(rows), source / "meta/episodes/chunk-000/file-000.parquet")
    info = {
        "codebase_version": "v3.0", "fps": fps, "total_episodes": 2, "chunks_size": 1000,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {"front": {"dtype": "video"}},
    }  # fmt: skip
    (source / "meta/info.json").write_text(json.dumps(info))
    import_set(source, tmp_path / "back.h5")
    with EpisodeFile(tmp_path / "back.h5") as found:
        assert found.lengths.tolist() == list(lengths) and found.instructions == SENTENCES
        both = np.concatenate([found.frames(0), found.frames(1)]).astype(int)
    assert np.abs(both - frames).max() < 6, "lossy, and no frame off by one"
    iio.imwrite(video, frames[:-1], plugin="FFMPEG", fps=fps)
    with pytest.raises(OwnVideosError, match=r"file-000\.mp4 ends before frame 12, to which its episodes reach"):
        import_set(source, tmp_path / "other.h5")


@pytest.mark.parametrize("to", ["lerobot", "minari"])
def test_damaged_sets_are_named_and_an_old_file_stays(file: Path, to: str) -> None:
    needs(to)
    out = file.parent / "own-v0"
    export(file, to, out)
    before = file.read_bytes()
    for path in sorted(p for p in out.rglob("*") if p.is_file() and p.name not in ("stats.json", "tasks.parquet")):
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        with pytest.raises(OwnVideosError, match=str(out)):
            import_set(out, file)
        path.write_bytes(content)
    assert file.read_bytes() == before
    with pytest.raises(OwnVideosError, match=r"own-v0 exists already: choose another --out"):
        export(file, to, out)


def test_what_is_not_allowed_is_said(file: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    with pytest.raises(OwnVideosError, match=r"--fps must be at least 1 frame a second, not 0"):
        export(file, "lerobot", file.parent / "set", fps=0)
    with pytest.raises(OwnVideosError, match=r"must end in the set's name, such as tabletop-v0, and not in 'set'"):
        export(file, "minari", file.parent / "set")
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    assert main(["data", "export", str(file), "--to", "lerobot", "--out", str(file.parent / "set")]) == 1
    assert "this needs pyarrow: pip install 'textocvp[lerobot]'" in capsys.readouterr().err
    (file.parent / "rlds").mkdir()
    (file.parent / "rlds/set-train.tfrecord-00000-of-00001").write_bytes(b"")
    assert main(["data", "import", str(file.parent / "rlds"), "--out", str(file.parent / "x.h5")]) == 1
    assert "holds TFRecords (RLDS, TFDS), which are not read" in capsys.readouterr().err
    assert main(["data", "import", str(file.parent / "none"), "--out", str(file.parent / "x.h5")]) == 1
    assert f"there is no folder {file.parent / 'none'}" in capsys.readouterr().err
    assert sorted(p.name for p in file.parent.iterdir()) == ["own.h5", "rlds"]
    different = [*episodes(2), replace(episodes(1)[0], action=None)]
    with pytest.raises(OwnVideosError, match=r"episode 2 has no action, and the first has: all must be alike"):
        write_episodes(file.parent / "mixed.h5", different)
    assert not (file.parent / "mixed.h5").exists()


def test_cliports_folders_become_files_with_their_masks(tmp_path: Path) -> None:
    folder, frames = tmp_path / "npz", np.random.default_rng(0).integers(0, 256, (4, 16, 16, 3), np.uint8)
    folder.mkdir()
    meta = {"caption": "put the red block in the blue bowl", "kinds": ["block", "bowl"], "colors": ["red", "blue"]}
    meta |= {"named_blocks": [0], "named_bowls": [1], "task": "x"}
    np.savez(
        folder / "a.npz", frames=frames, segmentation=frames[..., 0] % 4, position=np.zeros((4, 2, 3)),
        intrinsics=np.eye(3), extrinsics=np.eye(4), meta=json.dumps(meta),
    )  # fmt: skip
    import_set(folder, tmp_path / "own.h5")
    with EpisodeFile(tmp_path / "own.h5") as found:
        one, wanted = found.episode(0), CliportEpisodes(folder).episode(0)
        assert one.frames.tobytes() == frames.tobytes() and one.questions == wanted.questions
        assert one.segmentation.tobytes() == wanted.segmentation.tobytes() and one.objects == wanted.objects
    done = import_set(folder, tmp_path / "half.h5", size=8, every=2)
    assert done.frames == 2 and "brought it from 16x16 to 8x8 pixels" in done.lines[0]
    assert "this set: left out its masks, objects, positions and questions, which are of the frames as they were" in (
        done.lines
    )
    with h5py.File(tmp_path / "half.h5") as file:
        assert file["frames"].shape == (2, 8, 8, 3) and "segmentation" not in file
    for option, said in ({"camera": "top"}, "only LeRobot sets have"), ({"fps": 5}, "take --every, not --fps"):
        with pytest.raises(OwnVideosError, match=rf"npz is of the kind npz, .*{said}"):
            import_set(folder, tmp_path / "half.h5", **option)
    shutil.copy(folder / "a.npz", folder / "b.npz")
    (folder / "b.npz").write_bytes((folder / "a.npz").read_bytes()[:500])
    with pytest.warns(UserWarning, match=r"left out: .*b\.npz"):
        assert import_set(folder, tmp_path / "own.h5").episodes == 1


def test_sets_longer_than_the_predictor_looks_are_named(tmp_path: Path) -> None:
    needs("lerobot")
    frames = np.random.default_rng(0).integers(0, 256, (51, 16, 16, 3), np.uint8)
    of_lengths = [Episode(frames=frames[:T], instruction=SENTENCES[0]) for T in (25, 26, 51)]
    write_episodes(tmp_path / "own.h5", of_lengths)
    export(tmp_path / "own.h5", "lerobot", tmp_path / "set")
    (line,) = import_set(tmp_path / "set", tmp_path / "back.h5").lines
    assert line.startswith("episode 1 and 1 more: longer than 25 frames, after which the predictor stops looking")
    lines = import_set(tmp_path / "set", tmp_path / "half.h5", every=2).lines
    assert any(line.startswith("episode 2: longer than 25 frames") for line in lines), "26 of 51, and 13 of 26"


def test_two_exports_at_once_do_not_mix(file: Path) -> None:
    needs("lerobot")
    out = file.parent / "set"
    with pytest.raises(OwnVideosError, match="was written by another process meanwhile"), _new_folder(out):
        export(file, "lerobot", out)
    import_set(out, file.parent / "back.h5")
    assert_same(file.parent / "back.h5", episodes())
    assert {p.name for p in file.parent.iterdir()} == {"own.h5", "back.h5", "set"}
