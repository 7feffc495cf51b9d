"""The study of CLIPort's episodes, on small made-up ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.tasks.base import CLIPORT_RADIUS
from experiments.cliport import STUDY, Args, Sizes
from experiments.report.results import Results
from experiments.study.any_size import fitted, mask_curves
from experiments.study.cliport import misses
from experiments.study.frame_metrics import Measures
from experiments.study.run import UsageError, run
from planning import Instruction, PinholeCamera
from tests.experiments.still import LoadStill
from tests.textocvp.data.test_cliport import write_episode
from textocvp.data.episodes import Episode, EpisodeObject
from textocvp.metrics import psnr
from textocvp.protocols import LoadCheckpoint

# One metre over the origin, looking down: a point (x, y) at height z shows at 32 + 64 x / (1 - z), 32 - 64 y / (1 - z).
INTRINSICS = np.array([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]])
EXTRINSICS = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
START, BOWL, OTHER = (-0.2, 0.1, 0.03), (0.25, -0.2, 0.02), (-0.2, -0.25, 0.02)
T = 12
ASKED, OTHER_BOWL = (Instruction.parse(f"put the red block in the {color} bowl") for color in ("blue", "gray"))


def made_up(end: tuple[float, float, float]) -> Episode:
    """A block (object 1) goes straight to `end`; two bowls stand still. Segmentation by geometry."""
    camera = PinholeCamera(INTRINSICS, EXTRINSICS)
    position = np.array(
        [[BOWL, np.array(START) + (np.array(end) - START) * t / (T - 4) if t < T - 3 else end, OTHER] for t in range(T)]
    )
    masks = np.zeros((T, 64, 64), np.uint8)
    rows, columns = np.mgrid[:64, :64] + 0.5
    for t in range(T):
        for i, radius in ((0, 7), (2, 7), (1, 2.5)):  # the block is in front
            x, y = camera.project(position[t, i])
            masks[t][(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = 2 + i
    colors = np.array([(40, 40, 40), (0, 0, 0), (20, 20, 240), (240, 20, 20), (150, 150, 150)], np.uint8)
    named = (("bowl", "blue"), ("block", "red"), ("bowl", "gray"))
    return Episode(
        frames=colors[masks], instruction="put the red block in the blue bowl", segmentation=masks,
        objects=tuple(EpisodeObject(i, 2 + i, *one) for i, one in enumerate(named)),
        position=position.astype(np.float32), intrinsics=INTRINSICS, extrinsics=EXTRINSICS,
    )  # fmt: skip


@pytest.mark.parametrize("off", [0.0, 0.03, 0.07, 0.2])
def test_success_is_5_cm_from_the_bowl_as_in_cliport(off: float) -> None:
    truth = made_up((BOWL[0] - off, BOWL[1], 0.06))
    masks = truth.segmentation
    assert masks is not None
    found = misses(masks, truth, ASKED)
    assert found == pytest.approx([off] * 3, abs=0.008)  # half a pixel
    assert CLIPORT_RADIUS == 0.05
    other, unmoved = misses(masks, truth, OTHER_BOWL), misses(masks[:3], truth, ASKED)
    assert other is not None and unmoved is not None and min(*other, *unmoved) > CLIPORT_RADIUS


def test_a_block_that_no_pixel_shows_is_nowhere() -> None:
    truth = made_up(BOWL)
    assert truth.segmentation is not None
    hidden = np.where(truth.segmentation == 3, 0, truth.segmentation)
    seen_first = np.concatenate([truth.segmentation[:1], hidden[1:]])
    assert misses(seen_first, truth, ASKED) == pytest.approx([np.inf] * 3)
    seen_last = np.concatenate([hidden[:1], truth.segmentation[1:]])
    found = misses(seen_last, truth, ASKED)
    assert found is not None and (found > CLIPORT_RADIUS).all()


def test_what_is_named_twice_or_not_known_is_not_judged() -> None:
    truth = made_up(BOWL)
    assert truth.segmentation is not None
    twice = replace(truth, objects=(*truth.objects, EpisodeObject(3, 5, "bowl", "blue")))
    for unknown in (twice, replace(truth, position=None), replace(truth, extrinsics=None)):
        assert misses(truth.segmentation, unknown, ASKED) is None
    assert misses(truth.segmentation, truth, Instruction.parse("put the red block in the green bowl")) is None


def test_masks_that_are_the_truth_score_1_and_no_object_is_left_out() -> None:
    truth = made_up(BOWL)
    assert truth.segmentation is not None
    assert all((curve == 1).all() and len(curve) == T - 1 for curve in mask_curves(truth.segmentation, truth).values())
    lost = np.where(truth.segmentation == 3, 0, truth.segmentation)
    assert mask_curves(lost, truth)["iou"][0] == pytest.approx(2 / 3, abs=0.01)  # the background is matched to it


def test_frames_are_reduced_by_area_only_where_a_model_needs_it() -> None:
    frames = np.zeros((2, 192, 192, 3), np.uint8)
    frames[:, ::3] = 240
    still, slots = LoadStill()(), LoadCheckpoint("tabletop-small")()
    assert fitted(frames, still).shape == (2, 64, 64, 3)
    assert (fitted(frames, still) == 80).all()
    assert fitted(frames[:, :64, :64], still).shape[1] == 64
    assert fitted(np.zeros((128, 128, 3), np.uint8), still).shape == (64, 64, 3)  # takes its own size only
    assert fitted(np.zeros((128, 128, 3), np.uint8), slots).shape == (128, 128, 3)


def test_cliports_own_wording_is_read() -> None:
    read = Instruction.parse("put the cyan blocks in a yellow bowl")
    assert read.text == "put the cyan block in the yellow bowl"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tmp_path_factory.mktemp("episodes")
    for name, caption in (("a", None), ("b", None), ("c", "do as you like")):
        truth = made_up(BOWL)
        meta = {
            "caption": caption or truth.instruction, "kinds": [o.kind for o in truth.objects], "task": "made-up",
            "colors": [o.color for o in truth.objects], "named_blocks": [1], "named_bowls": [0],
        }  # fmt: skip
        names = ("frames", "segmentation", "position", "intrinsics", "extrinsics")
        write_episode(data / f"{name}.npz", meta=json.dumps(meta), **{n: getattr(truth, n) for n in names})
    write_episode(data / "none.npz", T=0)
    return data


def test_the_study_measures_what_can_be_measured(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    args = Args(checkpoint="tabletop-small", episodes=folder, out=tmp_path / "out", quick=True, workers=1)
    parser = "slot attention on EfficientNet-Lite0"
    loads = {"MAGE": LoadStill(None), parser: LoadCheckpoint("tabletop-small")}
    run(STUDY, args, sizes=Sizes(None, 0, 0, 1), loads=loads, measures=Measures())
    results = Results.read(tmp_path / "out" / "results.json")
    assert results.headline["n"] == 2
    assert results.headline["success_original_copy"] == results.headline["success_variants_copy"] == 0
    frames = torch.from_numpy(made_up(BOWL).frames).permute(0, 3, 1, 2) / 255
    by_hand = psnr(frames[:1].expand(9, -1, -1, -1).contiguous(), frames[1:10]).mean()
    assert results.headline["psnr_9_copy"] == pytest.approx(float(by_hand), abs=1e-3)
    still = results.find("MAGE", "9 frames", "psnr")
    assert still is not None and still.value == pytest.approx(float(by_hand), abs=1e-3)
    for metric in ("psnr", "iou"):  # a parser is measured on the true frames: here it is ours
        one, ours = (results.find(key, "9 frames", metric) for key in (parser, "true frames"))
        assert one is not None and ours is not None and one.value == ours.value
    assert results.find(parser, "original", "success") is not None
    assert "psnr_19" not in results.headline and "iou_9_true" in results.headline
    assert {row.split for row in results.rows} == {"all", "made-up"}
    told, text = capsys.readouterr().err, (tmp_path / "out" / "report.html").read_text()
    for words in ("none.npz: it has no frames", "c.npz: its sentence cannot be read"):
        assert words in told and words in text


def test_without_an_episode_there_is_one_line(tmp_path: Path) -> None:
    write_episode(tmp_path / "none.npz", T=0)
    args = Args(checkpoint="tabletop-small", episodes=tmp_path, out=tmp_path / "out")
    with pytest.raises(UsageError, match=r"none\.npz: it has no frames"):
        run(STUDY, args, loads={}, measures=Measures())
