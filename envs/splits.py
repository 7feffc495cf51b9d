"""The splits of the data set: which seeds, and what their scenes are like."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .colors import ColorSplit

SEEDS_PER_SPLIT = 10_000_000


@dataclass(frozen=True)
class Split:
    """One split. Episode i has seed ``first_seed + i``, and the splits' seeds are disjoint."""

    name: str
    number: int
    task: str = "put_block_in_bowl"  # a name of `envs.tasks.TASKS`
    n_objects: int = 6
    color_split: ColorSplit = "seen"
    bowls: tuple[int, int] = (1, 5)  # fewest and most bowls; the number is uniform
    mid_task: float = 0.38
    """Share of the episodes that shall start with 1 or 2 other blocks in bowls: what a second instruction
    finds. Two thirds of them have the bowls for it, which leaves about a quarter of all."""
    target_in_bowl: float = 0.13
    """Share of the episodes that shall name a block which lies in another bowl; a tenth of all remain."""
    moved_arm: float = 0.10  # share of the episodes that start with a perturbed arm

    @property
    def first_seed(self) -> int:
        return self.number * SEEDS_PER_SPLIT

    def seed(self, episode: int) -> int:
        """The seed of an episode; ValueError when the split has no such episode."""
        if not 0 <= episode < SEEDS_PER_SPLIT:
            raise ValueError(f"a split has episodes 0 to {SEEDS_PER_SPLIT - 1}, not {episode}")
        return self.first_seed + episode

    def options(self, seed: int) -> dict[str, Any]:
        """The `reset` options of the episode with this seed; a function of the seed alone."""
        # Another stream than the environment's own, which starts from the bare seed.
        rng = np.random.default_rng([seed, 1])
        target_in_bowl = bool(rng.random() < self.target_in_bowl)
        filled = int(rng.integers(1, 3)) if rng.random() < self.mid_task else 0
        low, high = self.bowls
        n_bowls = int(rng.integers(low, high + 1))
        # What does not fit beside the drawn number of bowls gives way: a named and an unnamed bowl are needed
        # for a block in a bowl, and every filled bowl needs its block.
        filled = max(0, min(filled, n_bowls - 1 - target_in_bowl, self.n_objects - n_bowls - 1))
        target_in_bowl = target_in_bowl and n_bowls >= 2 + filled
        return {
            "n_objects": self.n_objects,
            "n_bowls": n_bowls,
            "color_split": self.color_split,
            "blocks_in_bowls": filled,
            "target_in_bowl": target_in_bowl,
            "arm_start": "random" if rng.random() < self.moved_arm else "home",
        }


SPLITS: dict[str, Split] = {
    split.name: split
    for split in (
        Split("train", 0),
        Split("val", 1),
        Split("test", 2),
        Split("unseen_colors", 3, color_split="unseen"),
        Split("more_objects", 4, n_objects=8, bowls=(1, 5)),
        # At least 4 bowls, so that three other target bowls exist; a plain start, as in the paper's study.
        Split("controllability", 5, bowls=(4, 5), mid_task=0.0, target_in_bowl=0.0, moved_arm=0.0),
    )
}
