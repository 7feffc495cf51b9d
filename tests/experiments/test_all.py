"""All studies: what is run, what is kept, what a failure does, and the pages that link them."""

import os
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import pytest
import tyro

from experiments.all import NAMES, Args, main, run_program, to_markdown
from experiments.report.results import Results
from experiments.report.rows import Row
from experiments.report.tables import Line, TableSpec, columns
from experiments.study import kept
from experiments.study.run import Run, Study, StudyArgs, UsageError
from tests.experiments import examples
from tests.experiments.study.tiny import LoadNothing, study


@dataclass
class RunsArgs(StudyArgs):
    """Arguments of the study that reads runs."""

    runs: Path = Path("runs")


def tiny(name: str, title: str, question: str, **more: object) -> Study:
    return replace(study(Path("log")), name=name, title=title, question=question, args=StudyArgs, sizes=len_of, **more)  # type: ignore[arg-type]


def len_of(args: StudyArgs) -> int:
    return 1


TINY = (
    tiny("first", "First", "Is it?", first=("predicted_original",)),
    replace(
        tiny("second", "Second <b>", "And this?"),
        args=RunsArgs,
        inputs=lambda args: sorted(args.runs.glob("*/checkpoint/model.safetensors")),
    ),
    tiny("third", "Third", "And that?"),
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Studies:
    """Runs studies without work: writes their results, or fails."""

    def __init__(self, *failing: str) -> None:
        self.failing, self.ran = failing, []

    def __call__(self, study: Study, args: StudyArgs) -> str:
        self.ran.append(study.name)
        if study.name in self.failing:
            return "exit status 1\nerror: <no luck>"
        this = Run(study, args, load=LoadNothing())
        wanted = replace(examples.results(args.quick), study=study.name, checkpoint=this.checkpoint)
        (this.folder.path / "results.json").write_text(wanted.to_json())
        (this.folder.path / "report.html").write_text("page")
        (this.folder.path / "identity.txt").write_text(this.identity + "\n")
        return ""


@pytest.fixture
def args(tmp_path: Path) -> Args:
    return Args(out=tmp_path / "results", runs=tmp_path / "runs", quick=True)


def ran(args: Args, *failing: str) -> tuple[int, list[str]]:
    studies = Studies(*failing)
    return main(args, studies, TINY, LoadNothing()), studies.ran


def test_what_is_done_is_not_run_again(args: Args) -> None:
    assert ran(args) == (0, ["first", "second", "third"])
    assert ran(args) == (0, [])
    assert ran(replace(args, fresh=True)) == (0, ["first", "second", "third"])
    assert ran(replace(args, seed=1)) == (0, ["first", "second", "third"])
    assert ran(replace(args, seed=1, quick=False)) == (0, ["first", "second", "third"])


def test_results_of_other_code_or_of_unknown_options_are_not_kept(args: Args, monkeypatch) -> None:
    ran(args)
    monkeypatch.setattr(kept, "code_digest", lambda: "later")
    assert ran(args) == (0, ["first", "second", "third"])
    # Without its identity nothing says what the results depend on.
    (args.folder("") / "first" / "identity.txt").unlink()
    assert ran(args) == (0, ["first"])


def test_what_somebody_ran_alone_with_the_same_options_is_kept(args: Args) -> None:
    Studies()(TINY[0], StudyArgs(out=args.folder("") / "first", quick=True))
    Studies()(TINY[2], StudyArgs(out=args.folder("") / "third", quick=True, seed=1))
    assert ran(args) == (0, ["second", "third"])


def test_what_fails_when_it_is_run_again_does_not_count_as_done(args: Args) -> None:
    ran(args)
    assert ran(replace(args, fresh=True), "second") == (1, ["first", "second", "third"])
    assert ran(args) == (0, ["second"])


def test_a_failure_is_told_and_the_others_go_on(args: Args) -> None:
    assert ran(args, "second") == (1, ["first", "second", "third"])
    page = (args.folder("") / "index.html").read_text()
    assert "error: &lt;no luck&gt;" in page and "Second &lt;b&gt;" in page
    assert 'href="first/report.html"' in page and 'href="second/report.html"' not in page
    # It goes on where it stopped.
    assert ran(args) == (0, ["second"])
    assert 'href="second/report.html"' in (args.folder("") / "index.html").read_text()


def test_other_weights_make_a_study_stale(args: Args) -> None:
    assert ran(args) == (0, ["first", "second", "third"])
    weights = args.runs / "base" / "checkpoint" / "model.safetensors"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(b"trained")
    assert ran(args) == (0, ["second"])
    assert ran(args) == (0, [])
    weights.write_bytes(b"trained longer")
    assert ran(args) == (0, ["second"])


@pytest.mark.parametrize("damage", ["results.json", "report.html", "checkpoint"])
def test_what_is_damaged_is_run_again(args: Args, damage: str) -> None:
    ran(args)
    if damage == "checkpoint":
        path = args.folder("") / "first" / "results.json"
        read = Results.read(path)
        path.write_text(replace(read, checkpoint=replace(read.checkpoint, sha256="0" * 64)).to_json())
    else:
        (args.folder("") / "first" / damage).unlink()
    assert ran(args) == (0, ["first"])


def test_only_some(args: Args) -> None:
    args.only = ("third",)
    assert ran(args) == (0, ["third"])
    page = (args.folder("") / "index.html").read_text()
    assert page.count("not run") == 2 and "--only" not in page
    assert tyro.cli(Args, args=["--only", "third", "--only", "first"]).only == ("third", "first")
    args.only = ("forth",)
    with pytest.raises(UsageError, match="unknown study 'forth'; known: first, second, third"):
        ran(args)


def test_a_study_that_claims_success_without_results_has_failed(args: Args) -> None:
    assert main(args, lambda study, args: "", TINY[:1], LoadNothing()) == 1
    assert "results.json is not there" in (args.folder("") / "index.html").read_text()


def test_a_program_that_is_missing_or_fails_is_a_sentence(args: Args, tmp_path: Path) -> None:
    assert "No module named experiments.first" in run_program(TINY[0], args.of(TINY[0]))
    (tmp_path / "in the way").write_text("")
    longest = import_module("experiments.long_horizon").STUDY
    problem = run_program(longest, StudyArgs(out=tmp_path / "in the way", model=("MAGE=no such folder",)))
    assert problem.startswith("exit status 1\n") and "cannot write to" in problem


@pytest.mark.parametrize("name", NAMES)
def test_every_study_takes_what_it_is_told(name: str, args: Args) -> None:
    study = import_module(f"experiments.{name}").STUDY
    assert study.name == name and study.title and study.question
    told = replace(args, checkpoint="mine", seed=3).of(study)
    assert isinstance(told, study.args) and told.folder(name) == args.folder("") / name
    assert told.options()[:2] == ["--checkpoint mine", "--quick"] and told.options()[-1] == "--seed 3"
    assert getattr(told, "runs", args.runs) == args.runs


def test_the_summary_is_made_of_the_rows() -> None:
    rows = [
        Row("ours", "test", "9 frames", "ssim", 0.9512, 0.94, 0.96, 60),
        Row("MAGE", "test", "9 frames", "ssim", 0.9, 0.9, 0.9, 60),
        Row("ours", "test", "19 frames", "ssim", 0.93, 0.92, 0.94, 55),
    ]
    places = {f"{length} frames": ("test", f"{length} frames") for length in (9, 19, 24)}
    spec = TableSpec("SSIM", columns("ssim", places, 3), [Line(key="ours"), Line(key="MAGE")])
    shown = replace(TINY[0], title="Prediction", tables=[spec])
    text = to_markdown(shown, replace(examples.results(), rows=rows))
    assert text.splitlines()[:6] == [
        "### Prediction",
        "",
        "| SSIM | 9 frames | 19 frames |",
        "|---|---|---|",
        "| ours | 0.951 (0.940 to 0.960, n = 60) | 0.930 (0.920 to 0.940, n = 55) |",
        "| MAGE | 0.900 (0.900 to 0.900, n = 60) | \u2013 |",
    ]
    assert "Quick" not in text
    plain = to_markdown(shown, examples.results(quick=True))
    assert "| predicted original | 0.9 |" in plain and "**Quick run**" in plain


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_phone_shows_the_index(args: Args, tmp_path: Path) -> None:
    ran(args, "third")
    page = args.folder("") / "index.html"
    probe = (
        "<script>addEventListener('load', () => { document.body.dataset.probe = "
        "document.documentElement.scrollWidth - innerWidth; });</script>"
    )
    page.write_text(page.read_text().replace("</body>", probe + "</body>"))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--disable-background-networking"]
    assert CHROMIUM is not None
    command = [CHROMIUM, *flags, f"--user-data-dir={tmp_path / 'profile'}", "--window-size=500,900", "--dump-dom"]
    shown = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, timeout=120, env=os.environ)
    found = re.search(r'data-probe="(-?\d+)"', shown.stdout)
    assert found and int(found[1]) <= 0
    assert not re.search(r'(?:src|href)="(?:https?:)?//', page.read_text())
