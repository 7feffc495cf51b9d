from pathlib import Path

import pytest

from experiments.study.run import OutputFolder


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def test_files_appear_together_and_others_stay(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    (tmp_path / "results.json").write_text("old")
    folder = OutputFolder(tmp_path)
    with folder.fill() as partial:
        (partial / "results.json").write_text("new")
        (partial / "plots").mkdir()
        (partial / "plots" / "a.png").write_bytes(b"png")
        assert (tmp_path / "results.json").read_text() == "old"
    assert files(tmp_path) == ["mine.txt", "plots", "plots/a.png", "results.json"]
    assert (tmp_path / "results.json").read_text() == "new"
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_an_error_leaves_nothing_half_written(tmp_path: Path) -> None:
    folder = OutputFolder(tmp_path / "deep" / "results")
    with pytest.raises(RuntimeError, match="stop"), folder.fill() as partial:
        (partial / "results.json").write_text("half")
        raise RuntimeError("stop")
    assert files(tmp_path / "deep" / "results") == []


def test_a_file_in_the_way_is_an_early_error(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("a file")
    for path in (tmp_path / "results", tmp_path / "results" / "below"):
        with pytest.raises(NotADirectoryError, match=r"cannot write to .*results"):
            OutputFolder(path)


def test_an_unwritable_folder_is_an_early_error() -> None:
    if not Path("/proc/self").is_dir():
        pytest.skip("needs a folder that nobody can write to")
    with pytest.raises(OSError, match="cannot write to /proc"):
        OutputFolder("/proc/textocvp-results")
