"""Pictures in another light, or grainy, as the model's own world would show them."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from textocvp.inputs import OwnFrames, canvas, from_hex

SAME_LIGHT = 0.1  # by what share the canvas may be brighter or darker: then nothing is put right
MOST_LIGHT = 3.0  # times; what is farther off is another scene
SAME_CANVAS = 12  # of 0..255 in each channel: a canvas in another light, not another canvas
STEPS = (2, 16)  # of 0..255: neighbouring pixels of a grainy surface differ by so much
MORE_GRAIN = 0.2  # share of the neighbours, beyond that of the model's own pictures
REACH, SPREAD = 8, 5.0  # pixels
LUMA, CHROMA = 10.0, 30.0  # of 0..255, standard deviations: what is farther off is another surface
WEIGHTS = (0.299, 0.587, 0.114)  # luma of RGB (ITU-R BT.601)


def grain(values_B3HW: Tensor) -> Tensor:
    """(B,) which share of the neighbours along a row differ a little, as they do in noise and around JPEG's blocks."""
    step_BHW = values_B3HW.diff(dim=-1).abs().amax(1)
    return ((step_BHW >= STEPS[0]) & (step_BHW <= STEPS[1])).float().mean((1, 2))


def put_right(
    frames_BT3HW: Tensor, own: OwnFrames, restorer: Callable[[Tensor], Tensor] | None = None
) -> tuple[Tensor, list[str]]:
    """Videos, -1..1, in the light of the model's own and without grain; and what was done to them, in words.

    What is done to a video is decided by its first frame. One on the model's own canvas, in its light and no grainier
    than its own, stays as it is to the last bit.

    Args:
        restorer: brings back what a factor does not (`Restorer`).
    """
    if not own.canvas:
        return frames_BT3HW, []
    values_BT3HW = (frames_BT3HW + 1) * 127.5
    own_3 = from_hex(own.canvas, values_BT3HW)
    first_B3HW = values_BT3HW[:, 0].clone()
    grainy_B = _gain(first_B3HW, own_3).isfinite() & (grain(first_B3HW) > own.grain + MORE_GRAIN)
    if grainy_B.any():  # the median of a grainy picture is not that of its canvas
        first_B3HW[grainy_B] = _smooth(first_B3HW[grainy_B])
    gain_B = _gain(first_B3HW, own_3)
    other_B = gain_B.isfinite() & ((gain_B - 1).abs() > SAME_LIGHT)
    changed_B = other_B | grainy_B
    if not changed_B.any():
        return frames_BT3HW, []
    right_BT3HW = in_light(values_BT3HW, torch.where(other_B, gain_B, 1.0)[:, None, None, None, None])
    lost_B = grainy_B | (other_B & (gain_B < 1))
    if lost_B.any():  # each video by itself: its place in a batch must not matter, nor the batch fill the memory
        right_BT3HW[lost_B] = torch.stack([_recover(video, restorer) for video in right_BT3HW[lost_B]])
    done = ["grainy, as noise and JPEG make it, and was smoothed"] * bool(grainy_B.any())
    done += [f"in about {1 / gain:.1f} times the light, which was put right" for gain in gain_B[other_B][:1].tolist()]
    right_BT3HW = right_BT3HW.clamp(0, 255).round() / 127.5 - 1
    return torch.where(changed_B[:, None, None, None, None], right_BT3HW, frames_BT3HW), done


def in_light(values: Tensor, gain: Tensor | float) -> Tensor:
    """Values 0..255 made `gain` times as bright.

    What is white may have been brighter still: halfway between the least and the most that it can have been.
    """
    gain = torch.as_tensor(gain, dtype=values.dtype, device=values.device)
    return torch.where((values >= 255) & (gain < 1), (1 + gain) / 2 * 255, values * gain).clamp(0, 255)


def _recover(values_T3HW: Tensor, restorer: Callable[[Tensor], Tensor] | None) -> Tensor:
    """A video without grain, in which what is of one colour is so again."""
    if restorer is not None:
        values_T3HW = (restorer(values_T3HW / 127.5 - 1) + 1) * 127.5
    return _smooth(values_T3HW)


def _gain(values_B3HW: Tensor, own_3: Tensor) -> Tensor:
    """(B,) how many times brighter pictures must become to have this canvas; NaN where they have another."""
    found_B3 = canvas(values_B3HW)
    gain_B = own_3.sum() / found_B3.sum(1).clamp_min(1)
    same_B = ((found_B3 * gain_B[:, None] - own_3).abs() <= SAME_CANVAS).all(1)
    return torch.where(same_B & (gain_B < MOST_LIGHT) & (gain_B > 1 / MOST_LIGHT), gain_B, torch.nan)


def _smooth(values_N3HW: Tensor) -> Tensor:
    """A bilateral filter (Tomasi & Manduchi 1998) wide enough for the 16x16 blocks in which JPEG keeps colour."""
    luma_N1HW = (values_N3HW * values_N3HW.new_tensor(WEIGHTS)[:, None, None]).sum(1, keepdim=True)
    points_N4HW = torch.cat([luma_N1HW, values_N3HW - luma_N1HW], 1)
    H, W = points_N4HW.shape[-2:]
    padded_N4HW = F.pad(points_N4HW, [REACH] * 4, mode="replicate")
    total_N4HW, weight_N1HW = torch.zeros_like(points_N4HW), torch.zeros_like(luma_N1HW)
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            near_N4HW = padded_N4HW[..., REACH + dy : REACH + dy + H, REACH + dx : REACH + dx + W]
            off_N4HW = (near_N4HW - points_N4HW).square()
            cost_N1HW = off_N4HW[:, :1] / LUMA**2 + off_N4HW[:, 1:].sum(1, keepdim=True) / CHROMA**2
            share_N1HW = torch.exp(-(cost_N1HW + (dx * dx + dy * dy) / SPREAD**2) / 2)
            total_N4HW += share_N1HW * near_N4HW
            weight_N1HW += share_N1HW
    mean_N4HW = total_N4HW / weight_N1HW
    return mean_N4HW[:, :1] + mean_N4HW[:, 1:]
