"""The relation `on`, from pictures: the masks of real stacks show it, and others do not."""

from __future__ import annotations

from itertools import permutations

import gymnasium as gym
import numpy as np
import pytest
import torch

from envs import Expert
from envs.splits import SPLITS
from envs.tasks.rearrange import FAMILIES
from planning import RELATIONS, Goal, Instruction, SegmentationGrounder, Thing, seen_supports
from planning.masks import centroids

RED, GREEN = Thing("red", "block"), Thing("green", "block")
ON = RELATIONS["on"]


def test_both_kinds_of_sentences_are_parsed() -> None:
    assert Instruction.parse("put the red block on the green block") == Instruction("on", RED, GREEN)
    goal = Goal.parse("put the red block on the green block and the green block in the blue bowl")
    assert [one.relation for one in goal.instructions] == ["on", "in"]


def test_nothing_is_put_on_itself() -> None:
    with pytest.raises(ValueError, match="the red block cannot be on itself"):
        Instruction.parse("put the red block on the red block")
    with pytest.raises(ValueError, match="'on' joins block and block"):
        Instruction("on", RED, Thing("blue", "bowl"))


def test_masks_show_what_stands_on_what() -> None:
    """In 40 scenes of the simulator: pairs of blocks in start states with stacks."""
    env = gym.make("RearrangeBlocks-v0")
    right, pairs, stacked = 0, 0, 0
    for seed in range(40):
        _, info = env.reset(seed=seed, options={"family": ("picture", "covered")[seed % 2]})
        masks = {
            item["id"]: info["segmentation"] == item["label"] for item in info["objects"] if item["kind"] == "block"
        }
        for thing, target in permutations(masks, 2):
            truth = bool(info["supports"][thing] == target)
            shown = ON.shown(masks[thing], masks[target])
            right, pairs, stacked = right + (shown == truth), pairs + 1, stacked + truth
    env.close()
    assert stacked > 20 and right / pairs > 0.98, (right, pairs, stacked)


def test_what_is_not_seen_is_infinitely_far() -> None:
    masks_BHW = torch.zeros(2, 64, 64, dtype=torch.bool)
    masks_BHW[0, 20:26, 30:36] = True
    target_HW = torch.zeros(64, 64, dtype=torch.bool)
    target_HW[27:32, 30:36] = True
    distance_B = ON.distance(masks_BHW, target_HW)
    assert float(distance_B[0]) == pytest.approx(0.4, abs=0.1) and distance_B[1] == np.inf


@pytest.mark.parametrize("size", [336, 168])
def test_supports_are_seen_on_the_table_of_cliport(size: int) -> None:
    """In pictures of the whole table: at the start of scenes of all families, and after random sentences."""
    env = gym.make("RearrangeBlocks-v0", control="primitive", scene="cliport", image_size=size)
    right, stacked, families = [], 0, list(FAMILIES)
    for number in range(12):
        seed = SPLITS["val"].seed(4_000 + number)
        rng = np.random.default_rng(seed)
        _, info = env.reset(seed=seed, options={"family": families[number % len(families)]})
        base = env.unwrapped
        said = base.task.sentences(base.scene.objects, "all")
        for _ in range(3):
            named = [Thing(one["color"], one["kind"]) for one in info["objects"]]
            truth = {one: None if at < 0 else named[at] for one, at in zip(named, info["supports"], strict=True)
                     if one.kind == "block"}  # fmt: skip
            labels_NHW = torch.as_tensor(np.stack([info["segmentation"] == one["label"] for one in info["objects"]]))
            view = SegmentationGrounder.from_info(info).view
            right.append(seen_supports(centroids(labels_NHW)[None], named, view)[0] == truth)
            stacked += sum(at is not None for at in truth.values())
            info = env.step(Expert(env).primitive(said[int(rng.integers(len(said)))]))[4]
    env.close()
    assert stacked > 40 and np.mean(right) >= 0.94, (stacked, np.mean(right))
