"""Every study, in the order in which they are run and shown."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

from experiments.reporting.provenance import checkpoint_record
from experiments.reporting.summary import Pick
from textocvp.checkpoint import WEIGHTS_FILE
from textocvp.world_model import bundled_checkpoints


@dataclass(frozen=True)
class Study:
    """A study: `experiments/NAME.py`.

    Attributes:
        name: of its file and of its folder of results.
        title, question: for the index.
        reads: what it measures beside the checkpoint: the bundled `baselines`, the ablation `runs`, or `nothing` more.
        first: headline figures for the index, the most important first; others follow if there are fewer.
        picks: its tables in the summary.
    """

    name: str
    title: str
    question: str
    reads: Literal["nothing", "baselines", "runs"] = "nothing"
    first: tuple[str, ...] = ()
    picks: tuple[Pick, ...] = ()


_FRAMES = tuple(("test", f"{length} frames") for length in (9, 19, 24))
_MEANS = tuple(("test", f"frames 1-{length}") for length in (9, 19, 24))
_SPLITS = ("test", "unseen_colors", "more_objects")
_LONG = (
    ("test", "one step"),
    ("two_steps", "two steps"),
    ("three_steps", "three steps"),
    ("bowl_taken", "bowl taken"),
)
_BOWLS = (("controllability", "original"), ("controllability", "variants mean"))
_LOOP = (
    *_BOWLS,
    ("unseen_colors", "unseen colours"),
    ("more_objects", "8 objects"),
    ("two_steps", "two steps"),
    ("three_steps", "three steps"),
)

_HEARD = (
    ("test", "original"),
    ("controllability", "variants mean"),
    ("unseen_colors", "original"),
    ("unseen_colors", "new names"),
)
_LISTENERS = ("ours", "colour term off", "wrong sentence", "chance")

STUDIES = (
    Study(
        "controllability",
        "Controllability",
        "Change the sentence and nothing else: is it imagined, and can a robot do it?",
        first=(
            "predicted_original",
            "predicted_variants_mean",
            "closed_loop_original",
            "closed_loop_variants_mean",
        ),
        picks=(
            Pick("imagined", "predicted_success", (*_BOWLS, ("controllability", "all"))),
            Pick("carried out", "closed_loop_success", _LOOP),
        ),
    ),
    Study(
        "robustness",
        "Robustness",
        "Colours that no caption named, and eight objects instead of six.",
        reads="baselines",
        first=(
            "closed_loop_test",
            "closed_loop_unseen_colors",
            "closed_loop_more_objects",
            "lpips_drop_unseen_colors",
            "lpips_drop_more_objects",
        ),
        picks=(
            Pick("carried out", "closed_loop_success", tuple((split, "whole episode") for split in _SPLITS)),
            Pick("SSIM", "ssim", tuple((split, "9 frames") for split in _SPLITS), digits=3),
            Pick("LPIPS, relative drop", "lpips_drop", tuple((s, "9 frames") for s in _SPLITS[1:]), digits=3),
            Pick(
                "ST-LPIPS, relative drop",
                "st_lpips_drop",
                tuple((s, "9 frames") for s in _SPLITS[1:]),
                digits=3,
            ),
        ),
    ),
    Study(
        "prediction",
        "Prediction quality",
        "How much do imagined frames look like the real ones?",
        reads="baselines",
        picks=(
            Pick("SSIM", "ssim", _FRAMES, digits=3),
            Pick("LPIPS", "lpips", _FRAMES, digits=3),
            Pick("ST-LPIPS", "st_lpips", _FRAMES, digits=3),
            Pick("PSNR", "psnr", _FRAMES, digits=1),
        ),
    ),
    Study(
        "objects",
        "Objects",
        "Do imagined masks stay on their objects?",
        reads="baselines",
        first=("iou_9", "iou_copy_seed_9", "iou_true_frames_9", "iou_moving_9", "ari_9"),
        picks=(
            Pick("mask IoU", "iou", _MEANS, digits=3),
            Pick("mask IoU, what moves", "iou_moving", _MEANS, digits=3),
            Pick("foreground ARI", "foreground_ari", _MEANS, digits=3),
        ),
    ),
    Study(
        "ablations",
        "Ablations",
        "Which choices of architecture make the model follow instructions?",
        reads="runs",
        first=(
            "base_variants_mean",
            "layers_1_variants_mean",
            "residual_off_variants_mean",
            "lexicon_no_bias_variants_mean",
        ),
        picks=(
            Pick("block ends within 6 px", "ends_within_6_px", (*_BOWLS, ("unseen_colors", "original"))),
            Pick(
                "mIoU of parsed objects", "miou", (("test", "true frames"), ("more_objects", "true frames"))
            ),
        ),
    ),
    Study(
        "interpretability",
        "Interpretability",
        "Does the slot of the thing that a sentence names attend to the word that names it?",
        picks=(
            Pick("named block attends most to its colour word", "attends_block", _HEARD, _LISTENERS),
            Pick("named bowl attends most to its colour word", "attends_bowl", _HEARD, _LISTENERS),
        ),
    ),
    Study(
        "runtime",
        "Runtime",
        "How long does a thought take, and which part of it?",
        reads="baselines",
        first=(
            "window_over_cache_9_frames",
            "paper_window_over_cache_9_frames",
            "mage_over_textocvp_9_frames",
            "planning_queries_per_second",
        ),
    ),
    Study(
        "long_horizon",
        "Long goals",
        "Goals of several steps, with and without another look.",
        first=(
            "closed_loop_two_steps",
            "closed_loop_three_steps",
            "closed_loop_bowl_taken",
            "closed_loop_one_plan_three_steps",
        ),
        picks=(
            Pick("whole goal reached", "closed_loop_success", _LONG),
            Pick("share of sub-goals", "subgoals_reached", _LONG),
        ),
    ),
)


def study_named(name: str) -> Study:
    """The study of that name.

    Raises:
        KeyError: if there is none; the message lists those that exist.
    """
    for study in STUDIES:
        if study.name == name:
            return study
    raise KeyError(f"unknown study {name!r}; known: {', '.join(study.name for study in STUDIES)}")


def inputs_digest(study: Study, runs: Path) -> str:
    """A hash of the weights that a study reads beside its checkpoint; empty if it reads none."""
    if study.reads == "nothing":
        return ""
    if study.reads == "runs":
        return _digest(sorted(runs.glob(f"*/checkpoint/{WEIGHTS_FILE}")))
    with as_file(files("textocvp") / "checkpoints") as folder:
        return _digest(folder / name / WEIGHTS_FILE for name in bundled_checkpoints())


def _digest(weights: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in weights:
        # Named by its run or preset, so that two that change places are noticed.
        name = path.parent.parent.name if path.parent.name == "checkpoint" else path.parent.name
        if path.is_file():
            digest.update(f"{name} {checkpoint_record(name, path).sha256}\n".encode())
    return digest.hexdigest()
