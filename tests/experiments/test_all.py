"""All studies: what is run, what is kept, what a failure does, and the pages that link them."""

import os
import re
import shutil
import subprocess
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path

import pytest

import experiments.all as everything
from experiments.all import Args, main, run_program, study_options
from experiments.protocol.arguments import UsageError
from experiments.protocol.studies import STUDIES, Study, inputs_digest, study_named
from experiments.reporting import Results, Row
from experiments.reporting.summary import Pick, study_markdown
from tests.experiments import examples
from textocvp.world_model import WorldModel

TINY = (
    Study("first", "First", "Is it?", first=("predicted_original",)),
    Study("second", "Second <b>", "And this?", reads="runs"),
    Study("third", "Third", "And that?"),
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Studies:
    """Runs studies without work: writes their results, or fails."""

    def __init__(self, *failing: str) -> None:
        self.failing, self.ran = failing, []
        self.sha = WorldModel.from_pretrained().checkpoint.sha256

    def __call__(self, study: Study, args: Args) -> str:
        self.ran.append(study.name)
        if study.name in self.failing:
            return "exit status 1\nerror: <no luck>"
        folder = args.out / study.name
        folder.mkdir(exist_ok=True)
        wanted = examples.results(args.quick)
        checkpoint = replace(wanted.checkpoint, sha256=self.sha)
        results = replace(wanted, study=study.name, checkpoint=checkpoint, seeds={"slots": [args.seed]})
        (folder / "results.json").write_text(results.to_json())
        (folder / "report.html").write_text("page")
        return ""


@pytest.fixture
def args(tmp_path: Path) -> Args:
    return Args(out=tmp_path / "results", runs=tmp_path / "runs", quick=True)


def ran(args: Args, *failing: str) -> tuple[int, list[str]]:
    studies = Studies(*failing)
    return main(args, studies, TINY), studies.ran


def test_what_is_done_is_not_run_again(args: Args) -> None:
    assert ran(args) == (0, ["first", "second", "third"])
    assert ran(args) == (0, [])
    assert ran(replace(args, fresh=True)) == (0, ["first", "second", "third"])
    assert ran(replace(args, seed=1)) == (0, ["first", "second", "third"])
    assert ran(replace(args, seed=1, quick=False)) == (0, ["first", "second", "third"])


def test_results_of_other_code_or_of_another_hand_are_not_kept(args: Args, monkeypatch) -> None:
    ran(args)
    monkeypatch.setattr(everything, "code_digest", lambda: "later")
    assert ran(args) == (0, ["first", "second", "third"])
    # What somebody ran on its own may have had other options: nothing says.
    (args.out / everything.RECORD).unlink()
    assert ran(args) == (0, ["first", "second", "third"])


def test_what_fails_when_it_is_run_again_does_not_count_as_done(args: Args) -> None:
    ran(args)
    assert ran(replace(args, fresh=True), "second") == (1, ["first", "second", "third"])
    assert ran(args) == (0, ["second"])


def test_a_failure_is_told_and_the_others_go_on(args: Args) -> None:
    assert ran(args, "second") == (1, ["first", "second", "third"])
    page = (args.out / "index.html").read_text()
    assert "error: &lt;no luck&gt;" in page and "Second &lt;b&gt;" in page
    assert 'href="first/report.html"' in page and 'href="second/report.html"' not in page
    # It goes on where it stopped.
    assert ran(args) == (0, ["second"])
    assert 'href="second/report.html"' in (args.out / "index.html").read_text()


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
        path = args.out / "first" / "results.json"
        read = Results.read(path)
        path.write_text(replace(read, checkpoint=replace(read.checkpoint, sha256="0" * 64)).to_json())
    else:
        (args.out / "first" / damage).unlink()
    assert ran(args) == (0, ["first"])


def test_only_some(args: Args) -> None:
    args.only = ("third",)
    assert ran(args) == (0, ["third"])
    page = (args.out / "index.html").read_text()
    assert page.count("not run") == 2 and "--only" not in page
    args.only = ("forth",)
    with pytest.raises(UsageError, match="unknown study 'forth'; known: first, second, third"):
        ran(args)


def test_a_study_that_claims_success_without_results_has_failed(args: Args) -> None:
    assert main(args, lambda study, args: "", TINY[:1]) == 1
    assert "results.json is not there" in (args.out / "index.html").read_text()


def test_a_program_that_is_missing_or_fails_is_a_sentence(args: Args, tmp_path: Path) -> None:
    assert run_program(TINY[0], args) == "there is no experiments/first.py"
    (tmp_path / "in the way").write_text("")
    blocked = replace(args, out=tmp_path / "in the way")
    problem = run_program(study_named("long_horizon"), blocked)
    assert problem.startswith("exit status 1\n") and "cannot write to" in problem


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_every_study_takes_what_it_is_told(study: Study, args: Args) -> None:
    if not (everything.ROOT / "experiments" / f"{study.name}.py").is_file():
        pytest.skip("not written yet")
    module = import_module(f"experiments.{study.name}")
    arguments = module.STUDY.args if hasattr(module, "STUDY") else module.Args
    known = {"--" + f.name.replace("_", "-") for f in fields(arguments)}
    assert {option for option in study_options(study, args) if option.startswith("--")} <= known


def test_inputs_are_hashed_by_name_and_content(tmp_path: Path) -> None:
    study = Study("s", "S", "?", reads="runs")
    empty = inputs_digest(study, tmp_path)
    for name in ("a", "b"):
        path = tmp_path / name / "checkpoint" / "model.safetensors"
        path.parent.mkdir(parents=True)
        path.write_bytes(name.encode())
    both = inputs_digest(study, tmp_path)
    for name, data in (("a", b"b"), ("b", b"a")):
        (tmp_path / name / "checkpoint" / "model.safetensors").write_bytes(data)
    assert len({empty, both, inputs_digest(study, tmp_path)}) == 3
    assert inputs_digest(Study("s", "S", "?"), tmp_path) == ""


def test_the_summary_is_made_of_the_rows() -> None:
    rows = [
        Row("ours", "test", "9 frames", "ssim", 0.9512, 0.94, 0.96, 60),
        Row("MAGE", "test", "9 frames", "ssim", 0.9, 0.9, 0.9, 60),
        Row("ours", "test", "19 frames", "ssim", 0.93, 0.92, 0.94, 55),
    ]
    columns = (("test", "9 frames"), ("test", "19 frames"), ("test", "24 frames"))
    text = study_markdown(
        "Prediction", replace(examples.results(), rows=rows), [Pick("SSIM", "ssim", columns, digits=3)]
    )
    assert text.splitlines()[:6] == [
        "### Prediction",
        "",
        "| SSIM | 9 frames | 19 frames |",
        "|---|---|---|",
        "| ours | 0.951 (0.940 to 0.960, n = 60) | 0.930 (0.920 to 0.940, n = 55) |",
        "| MAGE | 0.900 (0.900 to 0.900, n = 60) | \u2013 |",
    ]
    one = [Pick("SSIM", "ssim", columns[:1], digits=3)]
    assert "| SSIM, n = 60 | 9 frames |" in study_markdown("P", replace(examples.results(), rows=rows), one)
    assert "Quick" not in text
    plain = study_markdown("Prediction", examples.results(quick=True), [Pick("SSIM", "ssim", columns)])
    assert "| predicted original | 0.9 |" in plain and "**Quick run**" in plain


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_a_phone_shows_the_index(args: Args, tmp_path: Path) -> None:
    ran(args, "third")
    page = args.out / "index.html"
    probe = (
        "<script>addEventListener('load', () => { document.body.dataset.probe = "
        "document.documentElement.scrollWidth - innerWidth; });</script>"
    )
    page.write_text(page.read_text().replace("</body>", probe + "</body>"))
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        "--disable-background-networking",
    ]
    assert CHROMIUM is not None
    command = [
        CHROMIUM,
        *flags,
        f"--user-data-dir={tmp_path / 'profile'}",
        "--window-size=500,900",
        "--dump-dom",
    ]
    shown = subprocess.run(
        [*command, page.as_uri()], capture_output=True, text=True, timeout=120, env=os.environ
    )
    found = re.search(r'data-probe="(-?\d+)"', shown.stdout)
    assert found and int(found[1]) <= 0
    assert not re.search(r'(?:src|href)="(?:https?:)?//', page.read_text())
