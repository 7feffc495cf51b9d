"""The estimate of the time that is left, with a clock that the tests turn."""

import io
from collections.abc import Iterator

import pytest
from rich.console import Console

from experiments.report.progress import Estimate, StudyProgress


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now

    def work(self, seconds: list[float]) -> Iterator[float]:
        for one in seconds:
            self.now += one
            yield one


def test_progress_in_a_file_is_plain_lines() -> None:
    console = Console(file=io.StringIO())
    with StudyProgress({"one": (5, 1.0), "two": (2, 3.0)}, console=console) as progress:
        assert list(progress.track("one", iter(range(5)))) == [0, 1, 2, 3, 4]
        progress.expect("two", 1)
        list(progress.track("two", ["unit"]))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert lines[-1].startswith("two: 1/1") and "about 0 s left" in lines[-1]
    assert not any("\x1b" in line for line in lines)


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_the_estimate_is_right_early_although_kinds_of_work_differ(speed: float) -> None:
    """Slow units first, quick ones later, twice as fast or slow as declared, after 20 s of starting up."""
    clock = Clock()
    costs = {"imagine": [4.0 * speed] * 15, "act": [0.5 * speed] * 100, "draw": [2.0 * speed] * 10}
    parts = {"imagine": (15, 4.0), "act": (100, 0.5), "draw": (10, 2.0)}
    costs["imagine"][0] += 20
    console = Console(file=io.StringIO())
    true, said = [], []
    with StudyProgress(parts, console=console, clock=clock) as progress:
        whole = sum(map(sum, costs.values()))
        for part, seconds in costs.items():
            for _ in progress.track(part, clock.work(seconds)):
                true.append(whole - clock.now)
                said.append(progress._estimate.seconds_left())
    # The first unit tells nothing yet; from the fourth on the estimate is good, as long as much is left.
    assert said[0] == pytest.approx(56 + 50 + 20)
    for t, s in list(zip(true, said, strict=True))[3:]:
        assert s == pytest.approx(t, rel=0.35, abs=3)
    assert said[-1] == pytest.approx(0, abs=0.01)


def test_what_an_earlier_run_did_takes_no_time() -> None:
    estimate = Estimate({"a": (10, 3.0)})
    for _ in range(4):
        estimate.finished("a", None)
    assert estimate.seconds_left() == pytest.approx(18) and estimate.share_done == pytest.approx(0.4)
    estimate.finished("a", 100.0)  # the first unit of this run: the process started
    assert estimate.seconds_left() == pytest.approx(15)


def test_more_processes_take_less_time() -> None:
    assert Estimate({"a": (10, 3.0)}, processes=2).seconds_left() == pytest.approx(15)
