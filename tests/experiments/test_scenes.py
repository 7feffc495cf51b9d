import numpy as np
import pytest

from envs import parse_instruction
from experiments.protocol.scenes import LOOP_COLUMNS, draw, play, test_scenes


@pytest.fixture(scope="module")
def scene():
    return test_scenes("controllability", 1, seed=0)[0]


@pytest.fixture(scope="module")
def env(scene):
    env = scene.make()
    yield env
    env.close()


def test_scenes_of_different_seeds_differ_and_repeat() -> None:
    seeds = [[s.seed for s in test_scenes("controllability", 30, seed)] for seed in (0, 1)]
    assert not set(seeds[0]) & set(seeds[1])
    assert test_scenes("unseen_colors", 5, 3) == test_scenes("unseen_colors", 5, 3)


def test_columns_share_no_scene_but_for_their_variants() -> None:
    seeds = {split: {s.seed for s in test_scenes(split, 100, 0)} for split in {c.split for c in LOOP_COLUMNS}}
    assert sum(map(len, seeds.values())) == len(set().union(*seeds.values()))


def test_an_unknown_split_is_named() -> None:
    with pytest.raises(ValueError, match="unknown split 'cater'; known: train"):
        test_scenes("cater", 1, 0)


def test_variants_name_the_other_bowls(env, scene) -> None:
    drawn = draw(env, scene, variants=3)
    pairs = [parse_instruction(text)[0] for text in drawn.texts]
    bowls = {item["color"] for item in drawn.info["objects"] if item["kind"] == "bowl"}
    assert {pair.block for pair in pairs} == {pairs[0].block}
    assert len({pair.bowl for pair in pairs}) == 4 and {pair.bowl for pair in pairs} <= bowls
    assert draw(env, scene, variants=3).texts == drawn.texts
    with pytest.raises(ValueError, match="other bowls, not 9"):
        draw(env, scene, variants=9)


def test_a_variant_is_the_same_scene_with_another_goal(env, scene) -> None:
    drawn = draw(env, scene, variants=3)
    observation, info = env.reset(seed=scene.seed, options=drawn.options(2))
    assert info["instruction"] == drawn.texts[2]
    assert np.abs(observation["rgb"].astype(int) - drawn.observation["rgb"]).mean() < 0.5
    assert [o["color"] for o in info["objects"]] == [o["color"] for o in drawn.info["objects"]]


def test_the_expert_plays_a_variant(env, scene) -> None:
    played = play(env, draw(env, scene, variants=1), 1)
    assert played.success and played.steps == 1
    assert played.frames.shape[1:] == (64, 64, 3) and 15 < len(played.frames) < 40
    assert played.segmentations.shape == played.frames.shape[:3]


def test_long_goals_have_as_many_pairs() -> None:
    (scene,) = test_scenes("three_steps", 1, 0)
    env = scene.make()
    assert len(parse_instruction(draw(env, scene).texts[0])) == 3
    env.close()
