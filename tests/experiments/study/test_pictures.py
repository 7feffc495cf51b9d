"""Other light: each change does what it says, and a model that knows what happens is not disturbed by it."""

from __future__ import annotations

import numpy as np
import pytest

from envs.colors import COLORS
from experiments.study.pictures import (
    CHANGES,
    UNCHANGED,
    WOOD,
    ChangedScene,
    change_picture,
    change_rows,
    change_tables,
)
from experiments.study.pool import Worker
from experiments.study.scenes import study_scenes
from experiments.study.wordings import paraphrase
from planning import Instruction
from tests.experiments.oracle import LoadOracle, StudyOracle
from textocvp.presets import SMALL_TEXT
from textocvp.text import build_text_encoder


def changed(name: str, rgb_HW3: np.ndarray, seed: int = 0, table_HW: np.ndarray | None = None) -> np.ndarray:
    table_HW = np.zeros(rgb_HW3.shape[:2], bool) if table_HW is None else table_HW
    before = rgb_HW3.copy()
    result = change_picture(name, rgb_HW3, table_HW, np.random.default_rng(seed))
    assert result.dtype == np.uint8 and result.shape == rgb_HW3.shape and np.array_equal(rgb_HW3, before)
    return result


@pytest.fixture
def flat() -> np.ndarray:
    return np.full((64, 64, 3), (100, 120, 80), np.uint8)


def test_light_is_as_strong_as_its_name_says(flat: np.ndarray) -> None:
    assert np.array_equal(changed(UNCHANGED, flat), flat)
    assert changed("light x 0.7", flat)[0, 0].tolist() == [70, 84, 56]
    assert changed("light x 1.25", flat)[0, 0].tolist() == [125, 150, 100]
    assert changed("light x 1.25", np.full_like(flat, 240)).min() == 255  # burnt out, not wrapped around


def test_a_gradient_goes_as_far_down_as_up(flat: np.ndarray) -> None:
    shaded = changed("light gradient 25 %", flat)[..., 0].astype(int)
    assert (shaded.min(), shaded.max()) == (75, 125) and abs(shaded.mean() - 100) < 0.5
    assert (shaded + shaded[::-1, ::-1] - 200).__abs__().max() <= 1  # even, whatever its direction
    assert not np.array_equal(shaded, changed("light gradient 25 %", flat, seed=1)[..., 0])


def test_noise_and_compression(flat: np.ndarray) -> None:
    off = changed("noise, sigma 8", flat).astype(float) - flat
    assert abs(off.mean()) < 0.3 and abs(off.std() - 8) < 0.3
    stripes = np.where(np.arange(64)[:, None, None] % 7 < 3, flat, 255 - flat).astype(np.uint8)
    packed = changed("JPEG, quality 75", stripes).astype(float)
    assert 0.5 < abs(packed - stripes).mean() < 20


def test_only_the_table_is_of_wood(flat: np.ndarray) -> None:
    table_HW = np.zeros((64, 64), bool)
    table_HW[20:, 10:] = True
    wooden = changed("wooden table", flat, table_HW=table_HW)
    assert np.array_equal(wooden[~table_HW], flat[~table_HW])
    assert abs(wooden[table_HW].mean(0) - WOOD).max() < 20 and wooden[table_HW].std(0).min() > 5
    along, across = (abs(np.diff(wooden[20:, 10:, 0].astype(int), axis=axis)).mean() for axis in (1, 0))
    assert across > 2 * along  # grain


@pytest.mark.parametrize("stubborn", [False, True])
def test_what_is_measured_is_where_the_block_ends(stubborn: bool) -> None:
    (scene,) = study_scenes("val", 1, 0)
    env = scene.make()
    _, info = env.reset(seed=scene.seed, options=dict(scene.options))
    env.close()
    color = Instruction.parse(info["instruction"]).thing.color
    worker = Worker(LoadOracle((color,) if stubborn else ())())
    outcomes = [ChangedScene(scene, change, 0).run(worker) for change in (UNCHANGED, "light x 0.7")]
    assert [one.reached for one in outcomes] == [not stubborn] * 2 and not any(one.warned for one in outcomes)
    rows = change_rows(outcomes)
    assert [(row.method, row.split, row.variant, row.metric, row.value, row.n) for row in rows] == [
        ("ours", "val", change, metric, float(metric == "reached" and not stubborn), 1)
        for change in (UNCHANGED, "light x 0.7")
        for metric in ("reached", "warned")
    ]
    table = change_tables("val")[0].table(rows)
    assert tuple(table.columns) == tuple(CHANGES)
    assert [cell.text for cell in table.rows[0].cells[:2]] == ["0.00" if stubborn else "1.00"] * 2


def test_other_words_are_imagined_and_judged_by_the_same_wish() -> None:
    (scene,) = study_scenes("val", 1, 0)
    heard: list[str] = []

    class Deaf(StudyOracle):
        """Understands no wording but the captions'."""

        def rollout(self, obs, text, **how):
            heard.extend(text)
            self._stubborn = () if text[0].startswith("put the ") else tuple(COLORS)
            return super().rollout(obs, text, **how)

    LoadOracle()()  # which listens to the environment
    worker = Worker(Deaf(()))
    outcomes = [ChangedScene(scene, UNCHANGED, 0, words, 2).run(worker) for words in ("ours", "ours, other words")]
    asked = Instruction.parse(heard[0])
    assert heard[1] == paraphrase(2, asked.thing.color, asked.target.color) != heard[0]
    assert [one.reached for one in outcomes] == [True, False]
    assert [row.method for row in change_rows(outcomes)] == ["ours"] * 2 + ["ours, other words"] * 2


def test_every_paraphrase_is_a_wording_of_its_own_and_read_as_what_it_means() -> None:
    encoder = build_text_encoder(SMALL_TEXT.for_captions(["put the gray block in the blue bowl"]))
    texts = [paraphrase(number, "gray", "light blue") for number in range(100)]
    assert len(set(texts)) > 90 and texts[3] == paraphrase(3, "gray", "light blue")
    assert {encoder.reads(text) for text in texts} == {"put the gray block in the light blue bowl"}


def test_scenes_may_be_of_another_world() -> None:
    plain, other = (study_scenes("val", 1, 0, *world)[0] for world in ((), ("cliport", 32)))
    worker = Worker(LoadOracle()())
    cliport = worker.environment(other)
    assert worker.environment(other) is cliport and worker.environment(plain) is not cliport
    observation, info = cliport.reset(seed=other.seed, options=dict(other.options))
    assert (
        observation["rgb"].shape == (32, 32, 3)
        and info["palette"]["robot"]
        != worker.environment(plain).reset(seed=plain.seed, options=dict(plain.options))[1]["palette"]["robot"]
    )
