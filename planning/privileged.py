"""Grounding with the simulator's segmentation: for the control column `privileged`, never for the planner proper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from planning.grounding import Grounding

if TYPE_CHECKING:
    from textocvp.rollout import Rollout


def ground_privileged(
    rollout: Rollout, segmentation: NDArray[np.integer[Any]], objects: Sequence[Mapping[str, Any]]
) -> list[Grounding]:
    """Ground the first frame of every rollout by mask overlap with the true segmentation (Hungarian): B groundings.

    Args:
        segmentation: (H, W) or (B, H, W): 0 background, 1 arm, 2 + i object i.
        objects: `info["objects"]`, each with `id`, `kind` and `color`; one scene for all B.
    """
    raise NotImplementedError


@dataclass(frozen=True, eq=False)
class PrivilegedGrounder:
    """`ground_privileged` for one scene whose truth is bound."""

    segmentation: NDArray[np.integer[Any]]
    objects: Sequence[Mapping[str, Any]]

    def __call__(self, parsed: Rollout) -> Grounding:
        return ground_privileged(parsed, self.segmentation, self.objects)[0]
