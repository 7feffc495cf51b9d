import json

import pytest

from experiments.report.results import Results
from experiments.report.rows import Row, mean_row, rate_row
from tests.experiments import examples


def test_the_file_has_exactly_the_agreed_fields() -> None:
    data = json.loads(examples.results().to_json())
    assert list(data) == [
        "study",
        "checkpoint",
        "versions",
        "seeds",
        "quick",
        "seconds",
        "rows",
        "headline",
        "episodes",
    ]
    assert set(data["episodes"][0]) >= {"method", "place", "scene", "success", "said", "error"}
    assert set(data["checkpoint"]) == {"name", "sha256"}
    assert set(data["rows"][0]) == {"method", "split", "variant", "metric", "value", "low", "high", "n"}
    assert data["headline"] == {"predicted_original": 0.9}


def test_results_survive_a_round_trip() -> None:
    written = examples.results()
    read = Results.from_json(written.to_json())
    assert read == written
    assert read.find("ours", "original", "predicted_success") == examples.row()
    assert read.find("ours", "variant 1", "predicted_success") is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("seeds"), "missing .* 'seeds'"),
        (lambda d: d.update(extra=1), "unexpected .* 'extra'"),
        (lambda d: d["rows"][0].pop("n"), "Row.* missing .* 'n'"),
        (lambda d: d["rows"][0].update(value="much"), "finite number"),
        (lambda d: d["checkpoint"].update(hash=""), "Checkpoint.* unexpected .* 'hash'"),
    ],
)
def test_a_damaged_file_is_named(change, message: str) -> None:
    data = json.loads(examples.results().to_json())
    change(data)
    with pytest.raises(ValueError, match=message):
        Results.from_json(json.dumps(data))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), True, "1"])
def test_a_figure_is_a_finite_number(bad) -> None:
    with pytest.raises(ValueError, match="finite number"):
        Row("ours", "test", "original", "success", bad, 0.0, 1.0, 3)


def test_a_figure_lies_in_its_interval() -> None:
    with pytest.raises(ValueError, match="outside its interval"):
        examples.row(value=0.5, low=0.6, high=0.7)


def test_rates_have_wilson_intervals() -> None:
    # 8 of 10: the textbook interval.
    row = rate_row("ours", "test", "original", "success", [True] * 8 + [False] * 2)
    assert (row.value, row.n) == (0.8, 10)
    assert (row.low, row.high) == (pytest.approx(0.4902, abs=1e-4), pytest.approx(0.9433, abs=1e-4))


def test_repeats_of_a_scene_are_not_independent() -> None:
    once = rate_row("ours", "test", "original", "success", [[True], [False], [True]])
    often = rate_row("ours", "test", "original", "success", [[True] * 50, [False] * 50, [True] * 50])
    assert (often.value, often.low, often.high, often.n) == (once.value, once.low, once.high, 3)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_certainty_is_never_claimed(value: float) -> None:
    row = rate_row("ours", "test", "original", "success", [bool(value)] * 30)
    assert row.value == value
    assert row.high - row.low > 0.05


def test_means_of_equal_values_are_inside_their_interval() -> None:
    row = mean_row("ours", "test", "original", "steps", [1.1] * 7)
    assert row.low <= row.value <= row.high
