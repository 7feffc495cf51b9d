"""The relation `on`, from pictures: the masks of real stacks show it, and others do not."""

from __future__ import annotations

from itertools import permutations

import gymnasium as gym
import numpy as np
import pytest
import torch

import envs  # noqa: F401  (registers the environments)
from planning import RELATIONS, Goal, Instruction, Thing

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
            item["id"]: info["segmentation"] == item["label"]
            for item in info["objects"]
            if item["kind"] == "block"
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
