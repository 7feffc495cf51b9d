"""The object study: exact figures for masks drawn by hand, and for models that are broken in a known way."""

import html
import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from experiments.objects import STUDY, ObjectScene, Sizes, cases, method_rows
from experiments.study.mask_metrics import MaskScores, score_masks
from experiments.study.methods import METHODS, OURS_40, Model, find_models
from experiments.study.pool import Worker
from experiments.study.run import Run, StudyArgs, run
from experiments.study.scenes import sample_scene, study_scenes, wrong_text
from planning import Instruction
from tests.experiments.foresight import LoadForesight
from tests.experiments.oracle import LoadOracle
from textocvp.checkpoint import CheckpointError
from textocvp.protocols import LoadCheckpoint

FIELDS = list(MaskScores.__dataclass_fields__)


def table(frames: int = 2) -> np.ndarray:
    """A segmentation (T, 16, 16): the arm 1, block 2 of 4x4 pixels, block 3 of 4x4, on background."""
    truth = np.zeros((frames, 16, 16), np.uint8)
    truth[:, :4, :4], truth[:, 6:10, 6:10], truth[:, 12:, 12:] = 1, 2, 3
    return truth


def test_masks_equal_to_the_segmentation_score_one() -> None:
    truth = table()
    scores = score_masks(9 - truth.astype(int), truth, moved=2)  # other numbers, the same pixels
    for name in FIELDS:
        assert getattr(scores, name).tolist() == [1.0, 1.0], name


def test_every_figure_is_about_its_own_things() -> None:
    truth = table()
    labels = truth.astype(int)
    labels[1, 8:10, 6:10] = 0  # half of block 2 is lost in frame 1
    scores = score_masks(labels, truth, moved=2)
    assert scores.block.tolist() == [1, 0.5] and scores.arm.tolist() == [1, 1]
    assert scores.moving.tolist() == [1, 0.75] and scores.still.tolist() == [1, 1]
    assert scores.iou.tolist() == [1, 0.75] and scores.kept.tolist() == [1, 0.75]
    assert scores.ari[0] == 1 and scores.ari[1] < 1
    other = score_masks(labels, truth, moved=3)
    assert other.block.tolist() == [1, 1] and other.still.tolist() == [1, 0.5]


def test_slots_that_swap_their_objects_lose_only_what_is_kept() -> None:
    truth = table(3)
    labels = truth.astype(int)
    labels[2] = np.array([0, 1, 3, 2])[truth[2]]
    scores = score_masks(labels, truth, moved=2)
    assert scores.iou.tolist() == [1, 1, 1] and scores.ari.tolist() == [1, 1, 1]
    assert scores.kept.tolist() == [1, 1, 0]
    assert scores.kept_moving.tolist() == [1, 1, 0.5]  # the arm kept its slot


def test_what_is_hidden_does_not_count() -> None:
    truth = table()
    truth[1][truth[1] == 2] = 0
    scores = score_masks(truth.astype(int), truth, moved=2)
    assert np.isnan(scores.block[1]) and scores.moving[1] == 1 and scores.iou[1] == 1


def test_masks_must_fit_the_segmentation() -> None:
    with pytest.raises(ValueError, match=r"labels are \(1, 16, 16\), the segmentation \(2, 16, 16\)"):
        score_masks(table(1), table(2), moved=2)


@lru_cache
def outcome(kind: str, ahead: int | None = 24) -> Mapping[str, MaskScores]:
    (scene,) = study_scenes("test", 1, 0)
    copies = Model("OCVP-Seq", LoadForesight("copies"), True, "copies", "1" * 64, 24)
    return ObjectScene(scene, (copies,), 0).run(Worker(LoadForesight(kind, ahead)()))  # type: ignore[arg-type]


def assert_same(a: MaskScores, b: MaskScores) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_who_sees_the_future_reaches_the_ceiling_and_who_copies_is_copy_seed() -> None:
    sees = outcome("sees")
    assert_same(sees["ours"], sees["true frames"])
    assert_same(sees["wrong text"], sees["copy seed"])  # for another text it imagines a still picture
    assert_same(sees["OCVP-Seq"], sees["copy seed"])  # here a double that copies
    assert np.nanmean(sees["ours"].moving[1:]) > np.nanmean(sees["copy seed"].moving[1:]) + 0.2
    copies = outcome("copies")
    assert_same(copies["ours"], copies["copy seed"])
    assert len(copies["ours"].iou) == 25


def test_shuffled_slots_keep_their_overlap_and_lose_their_names() -> None:
    scores = outcome("shuffles")
    np.testing.assert_array_equal(scores["ours"].iou, scores["true frames"].iou)
    assert scores["ours"].kept[0] == scores["true frames"].kept[0] > 0.5
    assert scores["ours"].kept[1:].max() < 0.2 < scores["true frames"].kept[1:].min()


def test_a_model_that_can_look_further_is_measured_further() -> None:
    far, near = outcome("sees", None), outcome("sees", 10)
    assert {len(far["ours"].iou), len(far["true frames"].iou)} == {41}
    rows = {(r.method, r.variant) for r in method_rows([far], ["iou"])}
    assert ("ours", "frames 1-40") in rows and ("OCVP-Seq", "frame 40") not in rows
    assert {r.variant for r in method_rows([near], ["iou"]) if r.method == "ours"} == {"frames 1-9", "frame 9"}
    assert near["copy seed"].iou.shape == (25,)  # as long as the longest of all methods
    # The scene rests in its last frame after the episode.
    assert len(set(far["true frames"].iou[24:].tolist())) == 1


def test_a_wrong_text_names_something_else() -> None:
    worker = Worker(LoadOracle()())
    for split in ("test", "controllability"):
        for scene in study_scenes(split, 6, 0):
            sampled = sample_scene(worker.environment(scene), scene)
            own, other = Instruction.parse(sampled.texts[0]), Instruction.parse(wrong_text(sampled))
            objects = [(item["kind"], item["color"]) for item in sampled.info["objects"]]
            for mine, named in zip(own.things, other.things, strict=True):
                others = [kind for kind, _ in objects].count(mine.kind) > 1
                assert (mine != named) == others and (named.kind, named.color) in objects
            assert wrong_text(sampled) == wrong_text(sampled)


def test_the_worst_and_the_best_are_those_with_the_least_and_most_overlap(tmp_path: Path) -> None:
    this = Run(STUDY, StudyArgs(out=tmp_path), load=LoadOracle(), sizes=Sizes(scenes=4, clips=2, apart=1), loads={})
    values = (0.5, 0.1, 0.9, 0.2)
    outcomes = [{"ours": MaskScores(**{name: np.full(25, value) for name in FIELDS})} for value in values]
    chosen = cases(this, {"scenes": outcomes})
    scenes = study_scenes("test", 4, 0)
    assert [(p.best, p.rank, p.caption[-4:], scenes.index(p.scene)) for p in chosen["clips"]] == [
        (True, 1, "0.90", 2),
        (True, 2, "0.50", 0),
        (False, 1, "0.10", 1),
        (False, 2, "0.20", 3),
    ]
    assert [strip.clip.place for strip in chosen["slots apart"]] == ["best 1", "worst 1"]


def not_there(name: str) -> None:
    raise CheckpointError(f"unknown checkpoint {name!r}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("textocvp.protocols.load_model", not_there)
        args = StudyArgs(out=out, quick=True, workers=1)
        run(STUDY, args, load=LoadForesight("sees"), sizes=Sizes(scenes=2, clips=1, apart=1))
    return out


def test_the_figures_are_there_with_intervals(folder: Path) -> None:
    data = json.loads((folder / "results.json").read_text())
    head = data["headline"]
    assert head["iou_9"] == head["iou_true_frames_9"] and head["iou_moving_19"] > head["iou_moving_copy_seed_19"]
    assert head["iou_wrong_text_24"] == head["iou_copy_seed_24"] and 0 < head["ari_19"] <= 1
    assert not any("ocvp" in name for name in head)
    assert data["study"] == "objects" and data["quick"] is True and len(data["seeds"]["scenes, test"]) == 2
    zero = [r for r in data["rows"] if r["method"] == "ours minus true frames"]
    assert zero and all((r["value"], r["low"], r["high"], r["n"]) == (0, 0, 0, 2) for r in zero)


def test_the_page_shows_what_is_absent_and_every_slot(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    for key in ("OCVP-Seq", OURS_40):
        assert f"{key} is absent: not trained: `{METHODS[key].train}`" in html.unescape(page)
    assert "Quick run" in page
    assert "paper, Copy-Seed" in page and "0.525" in page
    names = {str(p.relative_to(folder)) for p in folder.rglob("*.*")}
    assert {"plots/iou.png", "plots/iou_moving.png", "plots/objects-apart-worst-1.png"} <= names
    assert {"clips/objects-best-1.gif", "clips/objects-worst-1.gif"} <= names


def test_an_unknown_baseline_is_an_early_error(tmp_path: Path) -> None:
    for key in ("OCVP-Seq", OURS_40):
        args = StudyArgs(out=tmp_path / "r", model=(f"{key}=no-such-model",))
        with pytest.raises(CheckpointError, match="no-such-model"):
            run(STUDY, args, load=LoadForesight("sees"))
    assert list((tmp_path / "r").iterdir()) == []


def test_the_shipped_model_goes_on_with_the_one_for_40_frames() -> None:
    found, _ = find_models({key: LoadCheckpoint(METHODS[key].model) for key in STUDY.methods if METHODS[key].model})
    far, other = found
    assert far.key == OURS_40 and far.longest == 40
    assert other.key == "OCVP-Seq" and other.checkpoint == "ocvp-seq-small"
