"""The interpretability study: exact figures for attention that is known, and for models broken in a known way."""

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments.interpretability import (
    BY_APPEARANCE,
    COLOR_TERM,
    NO_COLOR_TERM,
    OURS,
    STUDY,
    WRONG,
    AttentionOutcome,
    AttentionScene,
    Sizes,
    extreme_cases,
    headline,
)
from experiments.report.rows import figure_rows, pick_figures
from experiments.study.attention import GROUPS, TEMPLATE, glow, lead, merge_tokens, read_attention, without_color_term
from experiments.study.pool import Worker
from experiments.study.run import Run, StudyArgs, UsageError, run
from experiments.study.scenes import study_scenes
from planning import Grounding, Instruction
from tests.experiments.attentive import HEADS, LAYERS, LoadAttentive
from tests.experiments.oracle import LoadOracle
from textocvp import WorldModel
from textocvp.model import TextOCVP
from textocvp.presets import PRESETS

TEXT = "put the red block in the blue bowl"
PRESENT = np.array([True, True, True, False])


# ---------------------------------------------------------------- words


@pytest.mark.parametrize(
    "tokens",
    [
        TEXT.split(),
        ["[CLS]", *TEXT.split(), "[SEP]"],
        ["\u2581put", "\u2581the", "\u2581", "r", "ed", "\u2581block", "\u2581in", "\u2581the", "\u2581blu", "e",
         "\u2581bowl", "</s>"],
        ["put", "the", "re", "##d", "block", "in", "the", "blue", "bo", "##wl"],
    ],
)  # fmt: skip
def test_tokens_are_summed_to_words(tokens: list[str]) -> None:
    values = np.full((2, len(tokens) + 3), 0.1)
    merged = merge_tokens(values, tokens, TEXT)
    assert merged.shape == (2, len(TEMPLATE))
    plain = [t for t in tokens if t[0] not in "<[" and t != "\u2581"]
    assert merged.sum() == pytest.approx(0.2 * len(plain))
    assert (merged >= 0.1 - 1e-9).all()


def test_a_colour_of_two_tokens_counts_whole() -> None:
    tokens = ["put", "the", "re", "##d", "block", "in", "the", "blue", "bowl"]
    merged = merge_tokens(np.arange(9.0), tokens, TEXT)
    assert merged.tolist() == [0, 1, 5, 4, 5, 6, 7, 8]


@pytest.mark.parametrize("tokens", [TEXT.split()[:-1], [*TEXT.split(), "now"], ["put", "a", "red"], []])
def test_tokens_of_another_text_are_refused(tokens: list[str]) -> None:
    with pytest.raises(UsageError, match="do not spell"):
        merge_tokens(np.ones(12), tokens, TEXT)


# ---------------------------------------------------------------- who attends most


def test_most_is_more_than_every_other_present_slot() -> None:
    shares = np.array([[0.2, 0.5, 0.1, 0.9], [0.5, 0.5, 0.1, 0.0], [0.6, 0.5, 0.1, 0.0]])
    # The absent slot is not asked; a tie is no lead.
    assert (lead(shares, [1], PRESENT) > 0).tolist() == [True, False, False]
    assert (lead(shares, [0], PRESENT) > 0).tolist() == [False, False, True]
    assert (lead(shares, [0, 2], PRESENT) > 0).tolist() == [False, False, True]
    assert not (lead(shares, [], PRESENT) > 0).any() and not (lead(shares, [3], PRESENT) > 0).any()


@lru_cache
def outcome(kind: str, split: str = "controllability", variants: int = 3) -> AttentionOutcome:
    (scene,) = study_scenes(split, 1, 0)
    return AttentionScene(scene, variants, 0).run(Worker(LoadAttentive(kind)()))  # type: ignore[arg-type]


def figures_of(kind: str, method: str) -> list[float]:
    """Every figure of a method on how often a named thing attends most."""
    found = outcome(kind).figures
    return np.concatenate(
        [np.ravel(v) for (m, _, metric), v in found.items() if m == method and "attends" in metric]
    ).tolist()


def test_who_attends_gets_full_marks_everywhere() -> None:
    readings = outcome("attends").readings[OURS]
    assert len(readings) == 4
    for one in readings:
        assert one.most_R.all() and one.most_Rnh.shape == (2, LAYERS, HEADS) and one.most_Rnh.all()
        assert one.most_RT.shape == (2, 24) and one.most_RT.all() and one.ends_in_bowl
        np.testing.assert_allclose(one.lead_R, 0.9 - 1 / 9, atol=1e-6)
        # 8 slots are present: table, arm and 6 objects, without the two spare ones.
        np.testing.assert_allclose(one.chance_R, 1 / 8)
        np.testing.assert_allclose(one.shares_RTG[0, :, GROUPS.index("named block")], 0.9, atol=1e-6)
        np.testing.assert_allclose(one.map_nhGW[0, 0, GROUPS.index("arm")], 1 / 9, atol=1e-6)
    assert figures_of("attends", BY_APPEARANCE) == [1.0] * 8
    # Under the wrong sentence other things attend.
    assert not any(figures_of("attends", WRONG))
    assert outcome("attends").figures[WRONG, "original", "ends_in_bowl"] == [False]


def test_the_uniform_and_the_confused_get_nothing() -> None:
    for kind in ("uniform", "swapped"):
        for one in outcome(kind).readings[OURS]:
            assert not one.most_R.any() and not one.most_Rnh.any() and not one.most_RT.any()
        assert figures_of(kind, BY_APPEARANCE) == [0.0] * 8
    np.testing.assert_allclose(outcome("uniform").readings[OURS][0].lead_R, 0, atol=1e-6)
    np.testing.assert_allclose(outcome("swapped").readings[OURS][0].lead_R, 0.1 / 8 - 0.9, atol=1e-6)


def test_heads_and_steps_are_told_apart() -> None:
    head = outcome("one head").readings[OURS][0]
    assert head.most_R.all() and head.most_Rnh[:, 1, 2].all() and head.most_Rnh.sum() == 2
    late = outcome("late").readings[OURS][0]
    assert late.most_R.all() and not late.most_RT[:, :12].any() and late.most_RT[:, 12:].all()


def test_rows_and_headline(tmp_path: Path) -> None:
    made = [outcome("attends"), outcome("attends", "unseen_colors", 0)]
    rows = figure_rows((one.scene.split, one.figures) for one in made)
    found = {(r.method, r.split, r.variant, r.metric): r for r in rows}
    assert found["ours", "controllability", "variants mean", "attends_bowl"].value == 1
    assert found["ours", "controllability", "variants mean", "attends_bowl"].n == 1  # three texts of one scene
    assert found["wrong sentence", "controllability", "original", "attends_bowl"].value == 0
    assert found["chance", "controllability", "original", "attends_block"].value == pytest.approx(1 / 8)
    assert ("wrong sentence", "controllability", "variants mean", "attends_bowl") not in found
    head = pick_figures(rows, headline(Run(STUDY, StudyArgs(out=tmp_path), load=LoadAttentive("attends"))))
    assert head["attends_block_controllability"] == head["attends_bowl_unseen_colors"] == 1
    assert head["attends_bowl_wrong_sentence"] == 0 and head["ends_in_bowl_controllability"] == 1


def test_the_best_and_the_worst_are_those_with_the_largest_and_smallest_lead() -> None:
    chosen = extreme_cases([outcome("swapped"), outcome("late", "unseen_colors", 0)], 0, 1)
    assert [(p.best, p.scene.split, p.success) for p in chosen] == [
        (True, "unseen_colors", True),
        (False, "controllability", False),
    ]
    assert [(p.variants, p.variant) for p in chosen] == [(0, 0), (3, 0)]


def test_a_slot_glows_with_its_share() -> None:
    masks = np.zeros((3, 2, 1, 2))
    masks[:, 0, 0, 0] = masks[:, 1, 0, 1] = 1
    film = glow(np.zeros((3, 1, 2, 3), np.uint8), masks, np.array([[0.4, 0.1], [0.0, 0.2]]))
    assert film[0].tolist() == film[1].tolist()  # nothing was imagined before the first step
    assert film[1, 0, 0].tolist() == [255, 138, 30]  # the brightest share of the film
    assert film[2, 0, 0].tolist() == [24, 24, 24]
    assert 24 < film[1, 0, 1, 0] < film[2, 0, 1, 0] < 255


# ---------------------------------------------------------------- the colour term


def test_the_colour_term_is_switched_off_in_a_copy_only() -> None:
    world_model = WorldModel.from_pretrained()
    without = without_color_term(world_model)
    assert without is not None
    gains = [layer.color_gain_h for layer in world_model.model.predictor.layers]
    assert all(gain.abs().min() > 1 for gain in gains)
    assert all(not layer.color_gain_h.any() for layer in without.model.predictor.layers)
    named = dict(without.model.named_parameters())
    for name, parameter in world_model.model.named_parameters():
        assert torch.equal(named[name], parameter) or name.endswith("color_gain_h")
    assert without_color_term(LoadOracle()()) is None


def test_the_term_changes_what_the_shipped_model_attends_to() -> None:
    (scene,) = study_scenes("controllability", 1, 0)
    found = AttentionScene(scene, 1, 0).run(Worker(WorldModel.from_pretrained()))
    assert len(found.figures[COLOR_TERM, "original", "attends_block"]) == 1
    assert len(found.figures[COLOR_TERM, "variants mean", "attends_bowl"]) == 1
    ours, without = found.readings[OURS], found.readings[NO_COLOR_TERM]
    assert len(ours) == len(without) == 2
    assert not np.allclose(without[0].map_nhGW, ours[0].map_nhGW, equal_nan=True)
    for one in (*ours, *without):  # every row of a map is a whole attention
        np.testing.assert_allclose(one.map_nhGW[:, :, 0].sum(-1), 1, atol=1e-4)


# ---------------------------------------------------------------- the study


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "results"
    args = StudyArgs(out=out, quick=True, workers=1)
    run(STUDY, args, load=LoadAttentive("attends"), sizes=Sizes(scenes=1, clips=1))
    return out


def test_the_folder_is_complete(folder: Path) -> None:
    data = json.loads((folder / "results.json").read_text())
    assert data["study"] == "interpretability" and data["quick"] is True
    assert data["headline"]["attends_block_test"] == 1 and "attends_bowl_colour_term_off" not in data["headline"]
    assert set(data["seeds"]) == {"slots", "scenes, test", "scenes, controllability", "scenes, unseen_colors"}
    assert any(row["method"] == "ours, layer 2 head 3" for row in data["rows"])
    names = {str(p.relative_to(folder)) for p in folder.rglob("*.*")}
    wanted = {"attention.png", "attention_heads.png", "heads_block.png", "shares_bowl.png", "most.png"}
    assert {f"plots/{name}" for name in wanted} <= names
    assert {"clips/attention-best-1.gif", "clips/attention-worst-1.gif"} <= names
    page = (folder / "report.html").read_text()
    assert "Quick run" in page and "should be near 0" in page
    assert "colour-matching term decide" not in page  # the double has none


def test_a_model_that_reads_no_text_is_refused(tmp_path: Path) -> None:
    textless = WorldModel(TextOCVP(PRESETS["ocvp-seq-small"]))
    with pytest.raises(UsageError, match="reads no text"):
        run(STUDY, StudyArgs(out=tmp_path / "r", checkpoint="mine", workers=1), load=lambda: textless)
    assert list((tmp_path / "r").iterdir()) == []


def test_a_thing_without_slot_is_a_miss() -> None:
    attention = np.zeros((2, 1, 1, 4, 8))
    attention[..., 1, 2] = 1.0
    asked = Instruction.parse(TEXT)
    reading = read_attention(attention, PRESENT, Grounding((0,), (2,), {asked.thing: (1,)}), asked, False)
    assert reading.most_R.tolist() == [True, False]
    assert reading.lead_R[0] == 1 and np.isneginf(reading.lead_R[1])
    assert reading.chance_R.tolist() == [pytest.approx(1 / 3), 0]
    assert np.isnan(reading.map_nhGW[0, 0, GROUPS.index("named bowl")]).all()
