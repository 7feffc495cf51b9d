"""A test double for the world model: it imagines by geometry, from the simulator's own object poses.

It cheats on purpose (it is given the true scene), so that planners, controller and loop can be tested without
a trained checkpoint. Its rollouts are real `Rollout` objects whose masks are drawn from slots by
`ShapeRenderer`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from planning import Instruction, Palette, PinholeCamera
from planning.camera import CLOSE
from textocvp.renderers.base import Rendered, Renderer
from textocvp.rollout import Rollout
from textocvp.slots import SlotLayout

LAYOUT = SlotLayout(content=4)  # x, y, z in metres, and the layer that it is drawn in
BACKGROUND, BOWL, BLOCK, ARM = 0.0, 1.0, 2.0, 3.0
LAYERS = {"block": BLOCK, "bowl": BOWL}
BLOCK_SIZE, BOWL_RADIUS, BOWL_HEIGHT = 0.058, 0.069, 0.046
HOME = np.array([0.34, 0.0, 0.13])

# `info["camera"]` of the preset "close" with 64 pixels, and `info["palette"]`: constants, because without PyBullet
# there are no environments to ask. tests/planning/test_camera.py compares them with the real ones.
CAMERA_INFO = vars(CLOSE)
PALETTE_INFO = {
    "colors": {
        "blue": (78, 121, 167),
        "green": (89, 169, 79),
        "red": (255, 87, 89),
        "brown": (156, 117, 95),
        "cyan": (118, 183, 178),
        "gray": (186, 176, 172),
        "yellow": (237, 201, 72),
        "pink": (255, 157, 167),
        "purple": (176, 122, 161),
        "white": (255, 255, 255),
        "orange": (242, 142, 43),
    },
    "robot": (105, 72, 240),
    "table": (47, 47, 47),
}
PALETTE = Palette.from_info(PALETTE_INFO)
COLORS = PALETTE.colors


class ShapeRenderer(Renderer):
    """Draws blocks as boxes, bowls as ellipses and the arm as a thick line from the top edge to its tip."""

    def __init__(self, size: int = 64) -> None:
        super().__init__()
        self.size = size

    def forward(self, slots_BKD: Tensor) -> Rendered:
        masks_BKHW = self.masks(slots_BKD)
        colors_BK3 = slots_BKD[..., 4:7]
        frames_B3HW = torch.einsum("bkhw,bkc->bchw", masks_BKHW, colors_BK3)
        return Rendered(
            frames_B3HW, masks_BKHW, lambda: colors_BK3[..., None, None].expand(*colors_BK3.shape, self.size, self.size)
        )

    def masks(self, slots_BKD: Tensor) -> Tensor:
        layer_BK11 = slots_BKD[..., 3, None, None]
        center_BK2 = (slots_BKD[..., 7:9] + 1) / 2 * self.size
        spread_BK2 = slots_BKD[..., 9:11] / 2 * self.size
        line = torch.arange(self.size) + 0.5
        x_BK1W = line[None, :] - center_BK2[..., 0, None, None]
        y_BKH1 = line[:, None] - center_BK2[..., 1, None, None]
        sx, sy = spread_BK2[..., 0, None, None], spread_BK2[..., 1, None, None]
        # A disc's edge lies 2 deviations out, a box's sqrt(3).
        ellipse = (x_BK1W / (2 * sx)) ** 2 + (y_BKH1 / (2 * sy)) ** 2 <= 1
        box = (x_BK1W.abs() <= 3**0.5 * sx) & (y_BKH1.abs() <= 3**0.5 * sy)
        beam = (x_BK1W.abs() <= 2) & (y_BKH1 <= 0)
        inside = torch.where(layer_BK11 == BOWL, ellipse, torch.where(layer_BK11 == BLOCK, box, beam))
        inside = inside & (slots_BKD[..., -1, None, None] > 0.5) | (layer_BK11 == BACKGROUND)
        return torch.where(inside, 40 * layer_BK11, -200.0).softmax(1)


class OracleWorldModel:
    """Knows the scene (`objects` gives `info["objects"]` as they are now) and does exactly what it is told.

    Attributes:
        hands_off: colours of blocks that it wrongly imagines nobody can move.
        spare_slots: unused slots, with presence 0.
        offsets: relation -> where its thing ends, (x, y) in metres from its target; (0, 0) where none is given.
    """

    def __init__(
        self,
        objects: Callable[[], Sequence[Mapping[str, Any]]],
        camera: PinholeCamera,
        *,
        hands_off: Sequence[str] = (),
        spare_slots: int = 2,
        offsets: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        self.objects, self.camera, self.hands_off, self.spare_slots = objects, camera, hands_off, spare_slots
        self.offsets = offsets or {}
        self.renderer = ShapeRenderer()
        self.calls: list[int] = []  # batch size of each imagination

    def parse(self, video: np.ndarray, *, seed: int = 0) -> Rollout:
        slots = [self._slot(BACKGROUND, [0.5, 0, 0], PALETTE.table), self._slot(ARM, HOME, PALETTE.robot)]
        for item in self.objects():
            layer = LAYERS[item["kind"]]
            position = np.asarray(item["position"], dtype=float)
            middle = position if layer == BLOCK else position + np.array([0, 0, BOWL_HEIGHT / 2])
            slots.append(self._slot(layer, middle, 0.92 * np.array(COLORS[item["color"]])))
        slots += [self._slot(BLOCK, [0.5, 0, 0], (0.5, 0.5, 0.5), presence=0.0)] * self.spare_slots
        order = np.random.default_rng(seed).permutation(len(slots) - 1) + 1  # the slot's number must not matter
        slots_KD = torch.stack([slots[0], *(slots[i] for i in order)])
        return self._rollout(slots_KD[None, None], ())

    def rollout(self, obs: Rollout, text: Sequence[str], *, horizon: int = 24, seed: int = 0) -> Rollout:
        self.calls.append(len(text))
        starts_BKD = obs.slots[:, -1].expand(len(text), -1, -1)
        films = [self._imagine(start, Instruction.parse(t), horizon) for start, t in zip(starts_BKD, text, strict=True)]
        return self._rollout(torch.stack(films), tuple(text))

    def _imagine(self, start_KD: Tensor, instruction: Instruction, horizon: int) -> Tensor:
        arm = self._find(start_KD, ARM, None)
        color = instruction.thing.color
        block, target = (self._find(start_KD, LAYERS[one.kind], one.color) for one in instruction.things)
        pick, place = start_KD[block, :3].double().numpy(), start_KD[target, :3].double().numpy()
        offset_2 = self.offsets.get(instruction.relation, (0.0, 0.0))
        place = np.array([*(place[:2] + offset_2), 0.006 + BLOCK_SIZE / 2])
        up, top = np.array([0, 0, 0.15]), np.array([0, 0, BLOCK_SIZE / 2 + 0.01])
        tip_T3 = _path([HOME, pick + up, pick + top, pick + up, place + up, place + top, place + up, HOME], horizon + 1)
        film_TKD = start_KD[None].repeat(horizon + 1, 1, 1)
        film_TKD[1:, arm] = self._slots(ARM, tip_T3[1:], PALETTE.robot)
        if color not in self.hands_off:
            share_T1 = np.linspace(0, 1, horizon + 1)[:, None]
            at_T3 = np.where(share_T1 < 2 / 7, pick, np.where(share_T1 > 5 / 7, place, tip_T3 - top))
            film_TKD[1:, block] = self._slots(BLOCK, at_T3[1:], 0.92 * np.array(COLORS[color]))
        return film_TKD

    def _find(self, slots_KD: Tensor, layer: float, color: str | None) -> int:
        for k, slot in enumerate(slots_KD):
            if slot[3] == layer and slot[-1] > 0.5:
                shade = torch.tensor(COLORS[color]) * 0.92 if color else None
                if shade is None or torch.allclose(slot[4:7] * 0.5 + 0.5, shade, atol=1e-3):
                    return k
        raise AssertionError(f"the oracle's scene has no {color} thing of layer {layer}")

    def _slot(self, layer: float, position: Any, color: Any, presence: float = 1.0) -> Tensor:
        return self._slots(layer, np.asarray(position, dtype=float)[None], color, presence)[0]

    def _slots(self, layer: float, position_T3: np.ndarray, color: Any, presence: float = 1.0) -> Tensor:
        """The slots (T, D) of one thing along a path."""
        pixel_T2 = self.camera.project(position_T3)
        unit_T1 = self.camera.metres_per_pixel(pixel_T2, 0.03)[:, None] * 32
        spread_2 = {BLOCK: np.array([1, 1.2]) * BLOCK_SIZE / 12**0.5, BOWL: np.array([1, 0.85]) * BOWL_RADIUS / 2}.get(
            layer, np.array([0.05, 0.05])
        )
        same_TC = np.tile([layer, *(2 * np.asarray(color) - 1)], (len(position_T3), 1))
        presence_T1 = np.full((len(position_T3), 1), presence)
        parts = [position_T3, same_TC, pixel_T2 / 32 - 1, spread_2 / unit_T1, presence_T1]
        return torch.from_numpy(np.concatenate(parts, axis=1)).float()

    def _rollout(self, slots_BTKD: Tensor, texts: tuple[str, ...]) -> Rollout:
        return Rollout(slots_BTKD, texts, (64, 64), LAYOUT, self.renderer)


def _path(points: list[np.ndarray], frames: int) -> np.ndarray:
    """Straight lines through points, at even speed per leg: (frames, 3)."""
    legs = np.linspace(0, len(points) - 1, frames)
    return np.stack([np.interp(legs, range(len(points)), axis) for axis in np.array(points).T], axis=1)
