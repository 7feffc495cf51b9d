"""How well a parser finds the objects of held-out episodes, measured against their true masks, if they have any.

Masks are used for measuring only; nothing here is ever trained on.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from textocvp.config import MOST
from textocvp.data.episodes import Episodes
from textocvp.inputs import DARK, HUE_REACH, HUE_SHARE, LEARNT_DB, OwnFrames, are_gray, canvas, hue_shares
from textocvp.metrics import Interval, bootstrap_interval, followed, foreground_ari, object_ious, psnr
from textocvp.metrics.masks import MIN_PIXELS
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames
from textocvp.pictures.put_right import grain
from textocvp.training.run import Metrics

THRESHOLDS = {"object_miou": 0.80, "object_found": 0.93, "followed": 0.90, "psnr": LEARNT_DB}
"""What a parser of the tabletop must reach on held-out episodes before a predictor is worth training on its slots."""

ONE_SLOT = "one slot: there are no masks to measure"
NO_MASKS = "the held-out episodes have no masks: only the redrawn frames are measured"


@dataclass(frozen=True)
class ParserMetrics(Metrics):
    """Figures over whole episodes, each a mean over episodes with its 95 % bootstrap interval."""

    group: ClassVar[str] = "quality"

    object_miou: Interval | None  # IoU of drawn masks with objects, Hungarian matching a frame
    object_found: Interval | None  # share of objects with an IoU above one half
    followed: Interval | None  # share of the first frame's objects whose slot keeps them through the whole episode
    foreground_ari: Interval | None  # adjusted Rand index without the background's pixels, the robot included
    psnr: Interval  # of the redrawn frames, dB
    robot: Interval | None = None  # IoU of the robot with the slot that covers it best
    left_out: str = ""  # why all but the PSNR are None; empty where they are not

    def __str__(self) -> str:
        text = ", ".join(f"{name} {interval}" for name, interval in self.measured().items())
        return f"{text} ({self.left_out})" if self.left_out else text

    def below_threshold(self) -> list[str]:
        """A sentence for each measured figure below its threshold; empty for a parser that is good enough."""
        measured = self.measured()
        return [
            f"{name} is {measured[name].value:.3f}, below its threshold of {threshold:.2f}"
            for name, threshold in THRESHOLDS.items()
            if name in measured and measured[name].value < threshold
        ]


@torch.no_grad()
def measure_parser(
    model: TextOCVP,
    episodes: Episodes,
    chosen: Iterable[int],
    *,
    frame_step: int = 3,
    min_pixels: int = MIN_PIXELS,
    drawn_masks: bool = True,
    change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] = lambda frames_THW3: frames_THW3,
) -> ParserMetrics:
    """Parse whole episodes and compare masks with the true ones.

    Args:
        chosen: numbers of held-out episodes.
        frame_step: IoU, ARI and PSNR are taken at every `frame_step`-th frame; following always at every frame.
        min_pixels: objects with fewer visible pixels are left out of IoUs.
        drawn_masks: compare the masks that the renderer draws, or those of a parser that attends to pixels.
        change: what is done to the frames (T, H, W, 3), for example other light.
    """
    ious, found, follows, aris, psnrs, robots = [], [], [], [], [], []
    left_out = NO_MASKS
    for index in chosen:
        frames = to_frames(change(episodes.frames(index))[None], model.device)[0]
        # Where first slots are drawn, an episode's are the same whenever it is measured.
        seeded = torch.Generator(model.device).manual_seed(index)
        parsed = model.parser(frames[None], generator=seeded)
        slots = parsed.slots_BTKD[0]
        rendered = model.renderer(slots)
        drawn = (rendered.frames_B3HW.clamp(-1, 1) + 1) / 2
        psnrs.append(psnr(drawn, (frames + 1) / 2).mean().item())
        if slots.shape[1] == 1:
            left_out = ONE_SLOT
            continue
        truth = episodes.truth(index)
        if truth is None or truth.segmentation is None:
            continue
        masks = rendered.masks_BKHW if drawn_masks else parsed.attention_BTKHW[0]
        labels = masks.argmax(1).cpu().numpy()
        segmentation = truth.segmentation
        # All that is neither background nor robot is an object.
        objects = [label for label in np.unique(segmentation).tolist() if label not in (0, truth.robot)]
        times = range(0, len(labels), frame_step)
        matches = _ious(labels[::frame_step], segmentation[::frame_step], objects, min_pixels)
        if len(matches) == 0:  # nothing but background
            continue
        ious.append(matches.mean())
        found.append((matches > 0.5).mean())
        follows.append(followed(labels, segmentation, objects).mean())
        robot_only = [] if truth.robot is None else [truth.robot]
        covered = _ious(labels[::frame_step], segmentation[::frame_step], robot_only, min_pixels)
        if len(covered):
            robots.append(covered.mean())
        aris.append(np.mean([foreground_ari(labels[t], segmentation[t]) for t in times]))
    miou, share, kept, ari, robot = (
        bootstrap_interval(values) if not np.isnan(values).all() else None
        for values in (ious, found, follows, aris, robots)
    )
    return ParserMetrics(miou, share, kept, ari, bootstrap_interval(psnrs), robot, "" if ious else left_out)


@torch.no_grad()
def measure_own_frames(model: TextOCVP, episodes: Episodes) -> OwnFrames:
    """How the model redraws the first frames of held-out episodes: what a checkpoint stores to tell others by."""
    psnrs, shares, canvases, grains, hues_C3, gray = [], [], [], [], None, False
    for at in range(0, len(episodes), 16):
        frames_B3HW = to_frames(episodes.clips(episodes.starts[at : at + 16], 1), model.device)[:, 0]
        values_B3HW = (frames_B3HW + 1) * 127.5
        if hues_C3 is None:
            hues_C3 = _hues(values_B3HW[0])  # what nearly all frames show, the first one does
        seeded = torch.Generator(model.device).manual_seed(0)
        slots_BKD = model.parser(frames_B3HW[:, None], generator=seeded).slots_BTKD[:, 0]
        drawn_B3HW = model.renderer(slots_BKD).frames_B3HW.clamp(-1, 1)
        psnrs.append(psnr((drawn_B3HW + 1) / 2, (frames_B3HW + 1) / 2).cpu())
        shares.append(hue_shares(values_B3HW, hues_C3).cpu())
        gray |= bool(are_gray(values_B3HW).any())
        canvases.append(canvas(values_B3HW).round().cpu())
        grains.append(grain(values_B3HW).cpu())
    psnr_E, low_C = torch.cat(psnrs), torch.cat(shares).quantile(0.01, 0)
    hue = ""
    if hues_C3 is not None and low_C.amax() >= HUE_SHARE:
        hue = bytes((255 * hues_C3[low_C.argmax()]).round().int().tolist()).hex()
    mean, low = psnr_E.mean().item(), psnr_E.quantile(0.01).item()
    canvas_E3, grain_high = torch.cat(canvases), torch.cat(grains).quantile(0.99).item()
    same = bool((canvas_E3 == canvas_E3[0]).all())
    its = bytes(canvas_E3[0].int().tolist()).hex() if same else ""
    return OwnFrames(min(len(psnr_E), MOST), round(mean, 2), round(low, 2), hue, gray, its, round(grain_high, 3))


def _hues(values_3HW: Tensor, most: int = 64) -> Tensor:
    """(C, 3) the commonest hues of a picture that are others where red and blue change places; pure blue at least."""
    pixels_N3 = values_3HW.flatten(1).T
    pixels_N3 = pixels_N3[pixels_N3.amax(1) >= DARK]
    hues_N3 = pixels_N3 / pixels_N3.amax(1, keepdim=True)
    hues_N3 = hues_N3[(hues_N3[:, 0] - hues_N3[:, 2]).abs() > 2 * HUE_REACH]
    hues_C3, count_C = (hues_N3 / HUE_REACH * 2).round().unique(dim=0, return_counts=True)
    commonest_C3 = hues_C3[count_C.argsort(descending=True)[:most]] * HUE_REACH / 2
    return torch.cat([commonest_C3, hues_N3.new_tensor([[0.0, 0.0, 1.0]])])


def _ious(
    labels_THW: NDArray[np.int64], segmentation_THW: NDArray[np.uint8], wanted: list[int], min_pixels: int
) -> NDArray[np.float64]:
    """IoUs of what has these labels in the segmentation, all frames' one after another."""
    pairs = zip(labels_THW, segmentation_THW, strict=True)
    return np.concatenate([object_ious(*pair, wanted, min_pixels=min_pixels).ious for pair in pairs])
