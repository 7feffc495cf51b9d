"""How a study is run: its command line, what it writes, and how one that was interrupted goes on."""

import hashlib
import json
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import tyro

from experiments.report.results import Results
from experiments.study import run as running
from experiments.study.kept import KeptWork, bare_code
from experiments.study.methods import BASELINES, METHODS
from experiments.study.pool import Pool, Worker
from experiments.study.run import FullArgs, Run, ScenesArgs, StudyArgs, UsageError, run, start
from tests.experiments.study.tiny import LoadNothing, study

REPO = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("bad", [{"workers": -1}, {"seed": -1}])
def test_numbers_out_of_range_are_refused(bad: dict) -> None:
    with pytest.raises(UsageError, match=r"must be .*, got -1"):
        StudyArgs(**bad)
    with pytest.raises(UsageError, match="--scenes must be at least 0, got -1"):
        ScenesArgs(scenes=-1)


def test_long_and_short_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="--quick and --full"):
        FullArgs(quick=True, full=True)


@pytest.mark.parametrize("bad", ["MAGE", "MAGE=", "expert=runs/x", "=runs/x"])
def test_a_model_is_named_by_its_row(bad: str) -> None:
    names = ", ".join(key for key, method in METHODS.items() if method.model)
    assert "savi, " in names and "expert" not in names
    with pytest.raises(UsageError, match=f"NAME of {names}; got"):
        StudyArgs(model=(bad,))


def test_the_command_names_what_changes_figures_and_nothing_else() -> None:
    assert ScenesArgs(out=Path("x"), workers=2).command("tiny") == "python experiments/tiny.py --seed 0"
    args = ScenesArgs(checkpoint="mine", quick=True, seed=3, scenes=7, model=("ours, 40 frames=a", "MAGE=b"))
    assert args.command("tiny") == (
        "python experiments/tiny.py --checkpoint mine --quick "
        "--model 'ours, 40 frames=a' --model MAGE=b --scenes 7 --seed 3"
    )


def test_a_first_look_has_a_folder_of_its_own() -> None:
    assert StudyArgs().folder("tiny") == Path("results/tiny")
    assert StudyArgs(quick=True).folder("tiny") == Path("results/quick/tiny")
    assert StudyArgs(quick=True, out=Path("x")).folder("tiny") == Path("x")


def test_mistakes_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(study: object, args: ScenesArgs) -> None:
        raise UsageError(f"{args.scenes} scenes are too few") if args.seed else KeyboardInterrupt

    monkeypatch.setattr(running, "run", fail)
    monkeypatch.setattr("sys.argv", ["tiny.py", "--seed", "1", "--scenes", "2"])
    with pytest.raises(SystemExit, match="error: 2 scenes are too few"):
        start(study(Path("log")))
    monkeypatch.setattr("sys.argv", ["tiny.py"])
    with pytest.raises(SystemExit, match="start it again to go on"):
        start(study(Path("log")))


def tiny(tmp_path: Path, log: str = "log", sha: str = "a" * 64, **args: object) -> tuple[Results, list[int]]:
    """Run it; its results, and the seeds of the units that ran."""
    where = tmp_path / log
    options = {"out": tmp_path / "out", "workers": 1, **args}
    results = run(study(where), ScenesArgs(**options), load=LoadNothing(sha))  # type: ignore[arg-type]
    return results, [int(line) for line in where.read_text().split()]


def test_everything_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results, ran = tiny(tmp_path)
    assert ran[:6] == list(range(6)) and len(ran) == 8
    assert results == Results.read(tmp_path / "out" / "results.json")
    assert results.seeds == {"slots": [0], "draws, test": list(range(6))}
    assert results.headline == {"value": round(results.rows[0].value, 4)}
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "identity.txt",
        "report.html",
        "results.json",
        "scenes.json",
    ]
    manifest = (tmp_path / "out" / "scenes.json").read_bytes()
    assert results.versions["scenes.json"] == hashlib.sha256(manifest).hexdigest()
    assert [scene["seed"] for scene in json.loads(manifest)] == list(range(6))
    shown = capsys.readouterr().out
    assert "draws: 6/6" in shown and "again: 2/2" in shown and f"{results.rows[0].value:.2f}" in shown
    assert tiny(tmp_path)[1] == ran * 2  # a study that is done runs again when it is asked to


KILLED = """
from pathlib import Path
from tests.experiments.study.test_run import tiny
tiny(Path({path!r}), workers={workers})
"""


@pytest.mark.parametrize(("died", "workers"), [(4, 1), (101, 1), (4, 2)])
def test_a_study_that_was_killed_goes_on_with_equal_results(tmp_path: Path, died: int, workers: int) -> None:
    whole, _ = tiny(tmp_path / "whole", log="../log")
    page = (tmp_path / "whole" / "out" / "report.html").read_text()
    (tmp_path / "log").unlink()
    again = json.loads(page.split("<p>[[")[1].split("]]</p>")[0].join(["[[", "]]"]))
    assert len(again) == 2
    for seed in (died, *range(100, 106)) if died > 100 else (died,):
        (tmp_path / f"die-{seed}").touch()
    code = KILLED.format(path=str(tmp_path), workers=workers)
    dead = subprocess.run(
        [sys.executable, "-c", code], cwd=REPO, env={**os.environ, "PYTHONPATH": str(REPO)}, timeout=120,
        capture_output=True,
    )  # fmt: skip
    assert dead.returncode != 0 and not (tmp_path / "out" / "results.json").exists()
    for trap in tmp_path.glob("die-*"):
        trap.unlink()
    before = [int(line) for line in (tmp_path / "log").read_text().split()]
    results, ran = tiny(tmp_path)
    after = ran[len(before) :]
    kept = [seed for seed in before if seed not in after]
    assert kept if workers == 1 else True
    assert (kept == before[:-1]) or workers > 1
    assert replace(results, seconds=0) == replace(whole, seconds=0)
    assert again_of(tmp_path / "out") == again_of(tmp_path / "whole" / "out")
    assert not (tmp_path / "out" / "unfinished.pickle").exists()


def again_of(folder: Path) -> str:
    """The section that is made of what followed from the results."""
    return (folder / "report.html").read_text().split("<h2>Again</h2>")[1].split("</section>")[0]


def test_what_was_measured_otherwise_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "unfinished.pickle"
    first = KeptWork(path, "one")
    first.add("a", 1.5, {"x": 1})
    first.add("b", 2.5, None)
    first.close(done=False)
    with path.open("ab") as file:
        file.write(b"\x80\x04cut off")
    again = KeptWork(path, "one")
    assert (again.of("a"), again.of("b"), again.of("c"), again.seconds) == ([{"x": 1}], [None], [], 2.5)
    again.add("b", 3.0, 7)
    again.close(done=False)
    assert KeptWork(path, "one").of("b") == [None, 7]
    other = KeptWork(path, "two")
    assert other.of("a") == [] and other.seconds == 0
    other.close(done=True)
    assert not path.exists()


def test_the_identity_is_what_figures_depend_on(tmp_path: Path) -> None:
    def identity(sha: str = "a" * 64, **args: object) -> str:
        options = {"out": tmp_path, **args}
        return Run(study(tmp_path / "log"), ScenesArgs(**options), load=LoadNothing(sha)).identity  # type: ignore[arg-type]

    assert identity() == identity(workers=2) == identity(out=tmp_path / "elsewhere")
    others = [identity(seed=1), identity(scenes=7), identity(quick=True), identity("b" * 64)]
    assert len({identity(), *others}) == 5
    inputs = replace(study(tmp_path / "log"), inputs=lambda args: [tmp_path / "weights"])
    seen = set()
    for content in ("trained", "trained longer"):
        (tmp_path / "weights").write_text(content)
        seen.add(Run(inputs, ScenesArgs(out=tmp_path), load=LoadNothing()).identity)
    assert len(seen) == 2 and identity() not in seen


def test_docstrings_comments_and_layout_are_no_code() -> None:
    code = 'def f(x: int) -> int:\n    """Twice."""\n    return 2 * x\n'
    same = '''"""A module."""
# Twice.
def f(x: int) -> int:
    """Two times x,
    at least."""

    return (2 * x)
'''
    assert bare_code(code) == bare_code(same) != bare_code(code.replace("2", "3"))
    assert bare_code('x = "a"\n') != bare_code('x = "b"\n')


def test_a_promised_figure_that_was_not_measured_is_an_error(tmp_path: Path) -> None:
    wanted = replace(study(tmp_path / "log"), headline={"value": ("MAGE", "test", "all", "value")})
    with pytest.raises(ValueError, match="headline 'value' was not measured"):
        run(wanted, ScenesArgs(out=tmp_path / "out", workers=1), load=LoadNothing())
    assert not (tmp_path / "out" / "results.json").exists()


def test_a_model_that_looks_less_far_than_the_study_needs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"imagines 24 frames at most .* needs 40"):
        Run(replace(study(tmp_path), horizon=40), ScenesArgs(out=tmp_path), load=LoadNothing())


def test_every_method_has_what_its_kind_needs() -> None:
    assert BASELINES == ("OCVP-Seq", "Non-OC", "MAGE")
    for key, method in METHODS.items():
        assert method.key == key and method.note
        assert bool(method.model) == bool(method.train)
        assert method.kind != "baseline" or method.model


def test_several_models_are_given_as_the_command_says() -> None:
    args = tyro.cli(StudyArgs, args=["--model", "MAGE=runs/mage", "--model", "OCVP-Seq=runs/seq"])
    assert args.model == ("MAGE=runs/mage", "OCVP-Seq=runs/seq")
    assert args.options() == ["--model MAGE=runs/mage", "--model OCVP-Seq=runs/seq", "--seed 0"]


@dataclass(frozen=True)
class Warns:
    """A unit that says something to a user who is not there."""

    def run(self, worker: Worker) -> int:
        warnings.warn("nothing seen is 'cyan'", UserWarning, stacklevel=1)
        return 1


def test_what_a_model_says_of_one_sentence_is_not_printed_for_hundreds(recwarn: pytest.WarningsRecorder) -> None:
    assert list(Pool(LoadNothing(), 1).run([Warns()] * 2)) == [1, 1]
    assert not [one for one in recwarn if "cyan" in str(one.message)]
