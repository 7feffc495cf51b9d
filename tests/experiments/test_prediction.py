"""The prediction study as a whole, with doubles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.prediction import STUDY, Args, PredictionScene, Sizes, frame_rows, jedi_rows
from experiments.report.results import Results
from experiments.study.frame_metrics import FrameScores, Measures, available_measures
from experiments.study.pool import Worker
from experiments.study.run import UsageError, run
from experiments.study.scenes import study_scenes
from tests.experiments.oracle import LoadOracle
from tests.experiments.still import LoadStill
from textocvp.metrics.jedi import jedi

MEASURES = Measures(("st_lpips",), reasons=(("lpips", "no weights here"), ("jedi", "none there")))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "results"
    run(
        STUDY,
        Args(out=out, quick=True, workers=1),
        load=LoadOracle(),
        sizes=Sizes(scenes=2, clips=1),
        loads={"MAGE": LoadStill(12)},
        measures=MEASURES,
    )
    return out


def test_results_have_every_method_length_and_view(folder: Path) -> None:
    results = Results.read(folder / "results.json")
    found = {(row.method, row.variant, row.metric) for row in results.rows}
    for method in ("ours", "true frames", "wrong text", "copy frame"):
        for length in (9, 19, 24):
            for metric in ("psnr", "ssim", "st_lpips", "ssim_without_bottom_rows"):
                assert (method, f"{length} frames", metric) in found
        assert (method, "frame 24", "st_lpips") in found
    assert ("copy frame", "frame 40", "psnr") in found and ("ours", "frame 25", "psnr") not in found
    assert ("MAGE", "9 frames", "ssim") in found and ("MAGE", "frame 12", "ssim") in found
    assert ("MAGE", "19 frames", "ssim") not in found and ("MAGE", "frame 13", "ssim") not in found
    assert all(row.n == 2 for row in results.rows)
    assert results.headline["st_lpips_24"] < results.headline["st_lpips_24_copy_frame"]
    assert "ssim_9_mage" in results.headline and "ssim_19_mage" not in results.headline
    assert results.quick and results.study == "prediction"
    assert results.versions["checkpoint of MAGE"] == "1" * 64
    # The double without movement and the control without movement are equal.
    mage, copy = (results.find(m, "9 frames", "psnr") for m in ("MAGE", "copy frame"))
    assert mage is not None and copy is not None and mage.value == pytest.approx(copy.value)


def test_the_page_says_what_is_absent_and_shows_both_ends(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    for words in ("LPIPS is absent: no weights here", "JEDi is absent: none there", "SEER is absent", "Quick run"):
        assert words in page
    assert "paper, MAGE-DINO" in page and "0.940" in page and "2.59" in page
    files = {str(path.relative_to(folder)) for path in folder.rglob("*.*")}
    assert {"clips/prediction-best-1.gif", "clips/prediction-worst-1.gif"} <= files
    assert {"plots/psnr.png", "plots/ssim.png", "plots/st_lpips.png", "plots/lengths.png"} <= files


def test_a_unit_of_work_depends_on_nothing_but_itself() -> None:
    """In whatever order units are run, and beside whatever others, figures stay the same."""
    first, second = (PredictionScene(scene, (), Measures(), 0) for scene in study_scenes("test", 2, 3))
    worker, other = Worker(LoadOracle()()), Worker(LoadOracle()())
    alone = second.run(other)
    first.run(worker)
    after = second.run(worker)
    for a, b in zip(alone, after, strict=True):
        assert a.method == b.method and all(np.array_equal(a.curves[m], b.curves[m]) for m in a.curves)


def test_jedi_is_taken_over_scenes() -> None:
    rng = np.random.default_rng(0)
    real, imagined = rng.normal(size=(6, 4)), rng.normal(size=(6, 4))
    outcomes = [
        (FrameScores("ours", {"ssim": np.full(10, i / 10)}, {9: imagined[i]}), FrameScores("truth", {}, {9: real[i]}))
        for i in range(6)
    ]
    (row,) = jedi_rows(outcomes)
    expected = jedi(imagined, real)
    assert (row.method, row.variant, row.metric, row.n) == ("ours", "9 frames", "jedi", 6)
    assert (row.value, row.low, row.high) == (expected.value, expected.low, expected.high)
    mean, *alone = frame_rows(outcomes)  # no prediction has 19 frames
    assert mean.variant == "9 frames" and mean.value == pytest.approx(0.25)
    assert [row.variant for row in alone] == [f"frame {t}" for t in range(1, 11)]


def test_what_cannot_be_measured_has_a_reason(tmp_path: Path) -> None:
    found = available_measures(jedi=str(tmp_path), jedi_lengths=(9,))
    assert found.jedi is None and dict(found.reasons)["jedi"].startswith("JEDi needs weights of V-JEPA 2")
    assert "st_lpips" in found.metrics
    assert "JEDi is absent: a reason." in available_measures(jedi_lengths=(9,), without_jedi="a reason").absent


def test_a_number_of_scenes_below_0_is_refused() -> None:
    with pytest.raises(UsageError, match="--scenes must be at least 0, got -1"):
        Args(scenes=-1)
