"""A renderer that remembers the first frame: what stands still keeps its pixels, what moves takes them along.

A camera that stands still shows the same table in every frame, and a thing that is carried looks as it did, only
elsewhere. So no network redraws either: that of a first frame which later frames show again is copied from it. What it
hid is filled in, the background from the pixels beside the gap, things from the canonical pictures that `glimpse`
draws. Only the robot, which changes its shape, is decoded from its slot.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.crop import NOTHING, paste
from textocvp.layers import init_relu_
from textocvp.renderers.base import Rendered, Seen
from textocvp.renderers.glimpse import GlimpseRenderer, PictureConfig
from textocvp.slots import ROBOT_SLOT, SlotLayout, SlotState

# A thing stands where it stood if its centre is nearer to that than this many standard deviations.
STILL = 0.75
BORDER = 2  # pixels around a thing, of the model's own size, whose colour may be mixed with that of the thing
FIRST_CELLS = 12  # side of the map that the robot's decoder starts from


@dataclass(frozen=True)
class CarryConfig(PictureConfig):
    """Options of `CarryRenderer`."""

    kind: Literal["carry"] = "carry"
    robot_cells: int = 96  # side of the robot's picture: 12 times a power of two
    robot_channels: int = 16  # of its decoder at that size; more below

    def __post_init__(self) -> None:
        if self.robot_cells % FIRST_CELLS or (n := self.robot_cells // FIRST_CELLS) & (n - 1):
            raise ValueError(
                f"renderer.robot_cells must be 12, 24, 48, 96 or a further doubling, not {self.robot_cells}"
            )


class RobotDecoder(nn.Sequential):
    """A robot's slot (N, C + 4) as a picture (N, 4, cells, cells): alpha logit, and RGB shading."""

    def __init__(self, inputs: int, cells: int, channels: int) -> None:
        doublings = (cells // FIRST_CELLS).bit_length() - 1
        widths = [min(channels * 2**i, 64) for i in range(doublings, -1, -1)]
        layers: list[nn.Module] = [
            nn.Linear(inputs, 256),
            nn.ReLU(),
            nn.Linear(256, widths[0] * FIRST_CELLS**2),
            nn.Unflatten(1, (widths[0], FIRST_CELLS, FIRST_CELLS)),
            nn.ReLU(),
        ]
        for wide, narrow in pairwise(widths):
            layers += [nn.Upsample(scale_factor=2.0), nn.Conv2d(wide, narrow, 3, padding=1), nn.ReLU()]
        last = nn.Conv2d(widths[-1], 4, 3, padding=1)
        super().__init__(*layers, last)
        init_relu_(self)
        nn.init.normal_(last.weight, std=0.01)  # begins as a faint gray


class CarryRenderer(GlimpseRenderer):
    """Draws with a first frame in mind, or without one like `GlimpseRenderer`, the robot by its own decoder.

    Slot `ROBOT_SLOT` is the robot. Training needs no first frame: only what no frame shows is learned.
    """

    Config = CarryConfig
    keeps_size = True

    def __init__(self, config: CarryConfig, layout: SlotLayout, image_size: int) -> None:
        super().__init__(config, layout, image_size)
        self.robot = RobotDecoder(layout.content + 4, config.robot_cells, config.robot_channels)

    def forward(self, slots: Tensor, seen: Seen | None = None) -> Rendered:
        """Draw one frame for each set of slots (B, K, D): of any sequences, or of the one that began as `seen`."""
        state = SlotState.split(slots, self.layout)
        return self._alone(state) if seen is None else self._onto(state, seen)

    def masks(self, slots: Tensor) -> Tensor:
        state = SlotState.split(slots, self.layout)
        logits_BKHW = self._pictures(state, self.image_size, channels=1)[:, :, 0]
        robot_B1HW = self._robot(state, self.image_size)[:, :1]
        return self._compete(_with_robot(logits_BKHW, robot_B1HW), state)

    def remember(self, frames_B3HW: Tensor, attention_BKhw: Tensor, slots_BKD: Tensor) -> tuple[Seen, ...]:
        """See `Renderer.remember`."""
        size = frames_B3HW.shape[-1]
        shares_BKHW = F.interpolate(attention_BKhw, size=(size, size), mode="bilinear")
        labels_BHW = shares_BKHW.argmax(1)
        known_BHW = ~_widened(labels_BHW > 0, self._border(size))
        clean_B3HW = [filled(frame, known) for frame, known in zip(frames_B3HW, known_BHW, strict=True)]
        return tuple(map(Seen, frames_B3HW, clean_B3HW, labels_BHW, slots_BKD))

    def _border(self, size: int) -> int:
        return BORDER * size // self.image_size

    def _alone(self, state: SlotState) -> Rendered:
        logits_BKHW, shading_BKHW = self._pictures(state, self.image_size).unbind(2)
        robot_B4HW = self._robot(state, self.image_size)
        masks_BKHW = self._compete(_with_robot(logits_BKHW, robot_B4HW[:, :1]), state)
        light_BKHW = 1 + torch.where(state.is_background[..., None], self.canvas, shading_BKHW)
        rgb_BK3 = (state.color + 1) / 2
        robot_B3HW = rgb_BK3[:, ROBOT_SLOT, :, None, None] * (1 + robot_B4HW[:, 1:])
        shares_BKHW = _with_robot(masks_BKHW * light_BKHW, torch.zeros_like(robot_B4HW[:, :1]))
        frames_B3HW = (rgb_BK3.transpose(1, 2) @ shares_BKHW.flatten(2)).unflatten(2, masks_BKHW.shape[2:])
        frames_B3HW = frames_B3HW + masks_BKHW[:, ROBOT_SLOT, None] * robot_B3HW

        def draw_objects() -> Tensor:
            objects_BK3HW = rgb_BK3[..., None, None] * light_BKHW[:, :, None]
            objects_BK3HW[:, ROBOT_SLOT] = robot_B3HW
            return 2 * objects_BK3HW - 1

        return Rendered(2 * frames_B3HW - 1, masks_BKHW, draw_objects)

    def _robot(self, state: SlotState, size: int) -> Tensor:
        """Alpha logit and shading (B, 4, size, size) of the robot where it is."""
        own = SlotState(*(part[:, ROBOT_SLOT : ROBOT_SLOT + 1] for part in vars(state).values()))
        cells_B4hw = self.robot(torch.cat([own.content, own.position, own.scale.log()], -1)[:, 0])
        offset = torch.tensor([NOTHING, 0.0, 0.0, 0.0], device=cells_B4hw.device)[:, None, None]
        cells_B14hw = (cells_B4hw.to(offset.dtype) - offset)[:, None]
        picture_B4HW = paste(cells_B14hw, own.position, own.scale, size, size, self.extent)[:, 0] + offset
        return torch.cat([picture_B4HW[:, :1].masked_fill(own.is_unused[..., None], NOTHING), picture_B4HW[:, 1:]], 1)

    def _onto(self, state: SlotState, seen: Seen) -> Rendered:
        """The frames of T sets of slots (T, K) that go on from one first frame."""
        size, K = seen.frame_3HW.shape[-1], len(seen.slots_KD)
        first = SlotState.split(seen.slots_KD, self.layout)
        shift_TK2 = state.position - first.position
        known_K = torch.bincount(seen.labels_HW.flatten(), minlength=K) > 0
        far_TK = (shift_TK2 / first.scale).norm(dim=-1) > STILL
        moved_TK = state.is_thing[..., 0] & (far_TK | ~known_K)
        moved_TK[:, ROBOT_SLOT] = True
        shift_TK2 = torch.where((moved_TK & known_K)[..., None], shift_TK2 * (size / 2), 0.0).round().long()

        # Where a thing stood that has moved, there is the background now, or what it hid.
        slots_K = torch.arange(K, device=moved_TK.device)
        own_KHW = seen.labels_HW == slots_K[:, None, None]
        near_KHW = _widened(own_KHW, self._border(size))
        left_THW = (moved_TK.float() @ near_KHW.flatten(1).float()).unflatten(1, (size, size)) > 0
        stays_TK = ~moved_TK
        stays_TK[:, 0] = False
        left_THW &= ~stays_TK[:, seen.labels_HW]
        frames_T3HW = torch.where(left_THW[:, None], seen.clean_3HW, seen.frame_3HW)
        slot_THW = torch.where(left_THW, 0, seen.labels_HW)

        things = [k for k in range(K) if k != ROBOT_SLOT and bool(state.is_thing[:, k].any())]
        for moving in (False, True):
            for k in things:
                drawn_T = state.is_thing[:, k, 0] & (moved_TK[:, k] == moving)
                if not drawn_T.any():
                    continue
                by_other = (seen.labels_HW > 0) & ~own_KHW[k] if known_K[k] else torch.ones_like(own_KHW[k])
                if (near_KHW[k] & by_other).any() or not known_K[k]:
                    part = SlotState(*(x[:, k : k + 1] for x in vars(state).values()))
                    logit_THW, shading_THW = self._pictures(part, size)[:, 0].unbind(1)
                    t, y, x, _, _ = _moved(by_other, shift_TK2[:, k], drawn_T)
                    there = (logit_THW[t, y, x] > 0) & (left_THW[t, y, x] | moving)
                    t, y, x = t[there], y[there], x[there]
                    light_P1 = 1 + shading_THW[t, y, x][:, None]
                    frames_T3HW[t, :, y, x] = (part.color[t, 0] + 1) * light_P1 - 1
                    slot_THW[t, y, x] = k
                if moving:
                    t, y, x, from_y, from_x = _moved(own_KHW[k], shift_TK2[:, k], drawn_T)
                    frames_T3HW[t, :, y, x] = seen.frame_3HW[:, from_y, from_x].T
                    slot_THW[t, y, x] = k

        robot_T4HW = self._robot(state, size)
        # Exactly 0 where there is no robot: what is copied is then copied exactly.
        share_T1HW = torch.where(robot_T4HW[:, :1] > NOTHING / 2, robot_T4HW[:, :1].sigmoid(), 0.0)
        robot_T3HW = (state.color[:, ROBOT_SLOT, :, None, None] + 1) * (1 + robot_T4HW[:, 1:]) - 1
        masks_TKHW = (slot_THW[:, None] == slots_K[:, None, None]) * (1 - share_T1HW)
        masks_TKHW[:, ROBOT_SLOT] += share_T1HW[:, 0]

        def draw_objects() -> Tensor:
            own_TKHW = slot_THW[:, None] == slots_K[:, None, None]
            objects_TK3HW = torch.where(own_TKHW[:, :, None], frames_T3HW[:, None], state.color[..., None, None])
            objects_TK3HW[:, ROBOT_SLOT] = robot_T3HW
            return objects_TK3HW

        return Rendered(frames_T3HW.lerp(robot_T3HW, share_T1HW), masks_TKHW, draw_objects)


def filled(frame_3HW: Tensor, known_HW: Tensor) -> Tensor:
    """The frame, what is not known filled in from the known pixels left and right of it, else above and below.

    The camera looks along the table, whose edges mostly lie along rows. A frame of which nothing is known stays.
    """
    for _ in range(2):
        frame_3HW = _filled_rows(frame_3HW, known_HW).transpose(1, 2)
        known_HW = known_HW.any(1, keepdim=True).expand_as(known_HW).T
    return frame_3HW


def _filled_rows(frame_3HW: Tensor, known_HW: Tensor) -> Tensor:
    """Each unknown pixel of a row as a blend of the nearest known ones on its two sides, the nearer the more."""
    W = known_HW.shape[1]
    column_W = torch.arange(W, device=known_HW.device)
    before_HW = torch.where(known_HW, column_W, -1).cummax(1).values
    after_HW = torch.where(known_HW, column_W, W).flip(1).cummin(1).values.flip(1)
    none_before, none_after = before_HW < 0, after_HW == W
    lost_HW = none_before & none_after
    left_HW = torch.where(none_before, after_HW, before_HW).masked_fill(lost_HW, 0)
    right_HW = torch.where(none_after, before_HW, after_HW).masked_fill(lost_HW, 0)
    share_HW = (column_W - left_HW) / (right_HW - left_HW).clamp_min(1)
    left_3HW, right_3HW = (frame_3HW.gather(2, x_HW.expand_as(frame_3HW)) for x_HW in (left_HW, right_HW))
    blend_3HW = left_3HW.lerp(right_3HW, share_HW.clamp(0, 1).to(frame_3HW.dtype))
    return torch.where(known_HW | lost_HW, frame_3HW, blend_3HW)


def _widened(masks_NHW: Tensor, pixels: int) -> Tensor:
    """Bool masks (N, H, W), so many pixels wider to each side."""
    return F.max_pool2d(masks_NHW.float(), 2 * pixels + 1, 1, pixels) > 0


def _moved(mask_HW: Tensor, shift_T2: Tensor, when_T: Tensor) -> tuple[Tensor, ...]:
    """Where the pixels of a mask are at T times: times, rows, columns, and the rows and columns where they were."""
    y_P, x_P = mask_HW.nonzero(as_tuple=True)
    x_TP, y_TP = x_P + shift_T2[:, :1], y_P + shift_T2[:, 1:]
    H, W = mask_HW.shape
    inside_TP = when_T[:, None] & (x_TP >= 0) & (x_TP < W) & (y_TP >= 0) & (y_TP < H)
    t, p = inside_TP.nonzero(as_tuple=True)
    return t, y_TP[t, p], x_TP[t, p], y_P[p], x_P[p]


def _with_robot(pictures_BKHW: Tensor, robot_B1HW: Tensor) -> Tensor:
    """One picture a slot, that of the robot replaced."""
    others = pictures_BKHW[:, :ROBOT_SLOT], pictures_BKHW[:, ROBOT_SLOT + 1 :]
    return torch.cat([others[0], robot_B1HW.to(pictures_BKHW.dtype), others[1]], 1)
