from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.protocol.arguments import StudyArgs, UsageError, start


@dataclass
class Args(StudyArgs):
    """A study of nothing."""

    out: Path = Path("results/nothing")
    scenes: int = 5


@pytest.mark.parametrize("bad", [{"workers": -1}, {"seed": -1}])
def test_numbers_out_of_range_are_refused(bad: dict) -> None:
    with pytest.raises(UsageError, match=r"must be .*, got -1"):
        Args(**bad)


def test_the_command_names_what_changes_figures_and_nothing_else() -> None:
    assert Args(out=Path("x"), workers=2).command("nothing") == "python experiments/nothing.py --seed 0"
    told = Args(checkpoint="mine", quick=True, seed=3, scenes=7).command("nothing")
    assert told == "python experiments/nothing.py --checkpoint mine --quick --scenes 7 --seed 3"


def test_mistakes_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def study(args: Args) -> None:
        raise UsageError(f"{args.scenes} scenes are too few") if args.seed else KeyboardInterrupt

    monkeypatch.setattr("sys.argv", ["nothing.py", "--seed", "1", "--scenes", "2"])
    with pytest.raises(SystemExit, match="error: 2 scenes are too few"):
        start(study, Args)
    monkeypatch.setattr("sys.argv", ["nothing.py"])
    with pytest.raises(SystemExit, match="nothing was written"):
        start(study, Args)
