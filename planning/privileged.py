"""Grounding with the simulator's segmentation: for the control column `privileged`, never for the planner
proper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from planning.goals import Thing
from planning.grounding import Grounding, hard_masks

if TYPE_CHECKING:
    from textocvp.rollout import Rollout

#: Labels of the environments' segmentation: table and floor, arm, and object i as FIRST_OBJECT + i.
BACKGROUND, ARM, FIRST_OBJECT = 0, 1, 2


def ground_privileged(
    rollout: Rollout, segmentation: NDArray[np.integer[Any]], objects: Sequence[Mapping[str, Any]]
) -> list[Grounding]:
    """Ground the first frame of every rollout by mask overlap with the true segmentation (Hungarian): B
    groundings.

    Args:
        segmentation: (H, W) or (B, H, W): 0 background, 1 arm, 2 + i object i.
        objects: `info["objects"]`, each with `id`, `kind` and `color`; one scene for all B.

    Raises:
        ValueError: if the segmentation does not have the rollout's size.
    """
    masks_BKHW = hard_masks(rollout.decode_masks([0])[:, 0]).cpu().numpy()
    truth_BHW = np.broadcast_to(segmentation, (len(masks_BKHW), *np.shape(segmentation)[-2:]))
    if truth_BHW.shape[1:] != masks_BKHW.shape[2:]:
        raise ValueError(
            f"segmentation is {truth_BHW.shape[1:]}, the rollout's masks are {masks_BKHW.shape[2:]}"
        )
    return [_ground_scene(masks, truth, objects) for masks, truth in zip(masks_BKHW, truth_BHW, strict=True)]


def _ground_scene(
    masks_KHW: NDArray[np.bool_], truth_HW: NDArray[np.integer[Any]], objects: Sequence[Mapping[str, Any]]
) -> Grounding:
    ids = [BACKGROUND, ARM, *(FIRST_OBJECT + i for i in range(len(objects)))]
    true_NHW = np.stack([truth_HW == i for i in ids])
    overlap_KN = np.einsum("khw,nhw->kn", masks_KHW.astype(np.float32), true_NHW.astype(np.float32))
    union_KN = masks_KHW.sum((1, 2))[:, None] + true_NHW.sum((1, 2)) - overlap_KN
    iou_KN = overlap_KN / np.maximum(union_KN, 1)
    chosen = {
        int(n): int(k) for k, n in zip(*linear_sum_assignment(-iou_KN), strict=True) if iou_KN[k, n] > 0
    }
    # Slots left over go to whatever covers most of them: the arm and the background may take several.
    slots: dict[int, list[int]] = {n: [k] for n, k in chosen.items()}
    for k in range(len(masks_KHW)):
        most = int(overlap_KN[k].argmax())
        if k not in chosen.values() and overlap_KN[k, most] > 0:
            slots.setdefault(most, []).append(k)
    things = {
        Thing(item["color"], item["kind"]): tuple(sorted(slots[FIRST_OBJECT + i]))
        for i, item in enumerate(objects)
        if FIRST_OBJECT + i in slots
    }
    return Grounding(tuple(sorted(slots.get(BACKGROUND, []))), tuple(sorted(slots.get(ARM, []))), things)


@dataclass(frozen=True, eq=False)
class PrivilegedGrounder:
    """`ground_privileged` for one scene whose truth is bound."""

    segmentation: NDArray[np.integer[Any]]
    objects: Sequence[Mapping[str, Any]]

    def __call__(self, parsed: Rollout) -> Grounding:
        return ground_privileged(parsed, self.segmentation, self.objects)[0]
