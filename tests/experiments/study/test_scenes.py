import numpy as np
import pytest

from experiments.controllability import LOOP_PLACES
from experiments.study.scenes import play_expert, sample_scene, study_scenes
from planning import Goal


@pytest.fixture(scope="module")
def scene():
    return study_scenes("controllability", 1, seed=0)[0]


@pytest.fixture(scope="module")
def env(scene):
    env = scene.make()
    yield env
    env.close()


def test_scenes_of_different_seeds_differ_and_repeat() -> None:
    seeds = [[s.seed for s in study_scenes("controllability", 30, seed)] for seed in (0, 1)]
    assert not set(seeds[0]) & set(seeds[1])
    assert study_scenes("unseen_colors", 5, 3) == study_scenes("unseen_colors", 5, 3)


def test_columns_share_no_scene_but_for_their_variants() -> None:
    seeds = {
        split: {s.seed for s in study_scenes(split, 100, 0)} for split in {split for split, _ in LOOP_PLACES.values()}
    }
    assert sum(map(len, seeds.values())) == len(set().union(*seeds.values()))


def test_an_unknown_split_is_named() -> None:
    with pytest.raises(ValueError, match="unknown split 'cater'; known: train"):
        study_scenes("cater", 1, 0)


def test_variants_name_the_other_bowls(env, scene) -> None:
    sampled = sample_scene(env, scene, variants=3)
    pairs = [Goal.parse(text).instructions[0] for text in sampled.texts]
    bowls = {item["color"] for item in sampled.info["objects"] if item["kind"] == "bowl"}
    assert {pair.thing.color for pair in pairs} == {pairs[0].thing.color}
    assert len({pair.target.color for pair in pairs}) == 4 and {pair.target.color for pair in pairs} <= bowls
    assert sample_scene(env, scene, variants=3).texts == sampled.texts
    with pytest.raises(ValueError, match="other bowls, not 9"):
        sample_scene(env, scene, variants=9)


def test_a_variant_is_the_same_scene_with_another_goal(env, scene) -> None:
    sampled = sample_scene(env, scene, variants=3)
    observation, info = env.reset(seed=scene.seed, options=sampled.options(2))
    assert info["instruction"] == sampled.texts[2]
    assert np.abs(observation["rgb"].astype(int) - sampled.observation["rgb"]).mean() < 0.5
    assert [o["color"] for o in info["objects"]] == [o["color"] for o in sampled.info["objects"]]


def test_the_expert_plays_a_variant(env, scene) -> None:
    played = play_expert(env, sample_scene(env, scene, variants=1), 1)
    assert played.success and played.gained == 1.0
    assert played.frames.shape[1:] == (64, 64, 3) and 15 < len(played.frames) < 40
    assert played.segmentations.shape == played.frames.shape[:3]


def test_long_goals_have_as_many_pairs() -> None:
    (scene,) = study_scenes("three_steps", 1, 0)
    env = scene.make()
    assert len(Goal.parse(sample_scene(env, scene).texts[0]).instructions) == 3
    env.close()
