"""How well MAGE imagines held-out episodes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from textocvp.baselines.mage.model import Mage
from textocvp.data.episodes import Episodes
from textocvp.metrics.frames import psnr
from textocvp.model import evaluating
from textocvp.parsers.base import to_frames
from textocvp.training.run import Metrics


@dataclass(frozen=True)
class Imagined(Metrics):
    """Figures of rollouts from the first frame to the longest horizon.

    Attributes:
        psnr: mean peak signal-to-noise ratio of the imagined frames, in dB.
        still_psnr: what it would be if the first frame, redrawn, never changed.
        redrawn_psnr: what it would be if every code were right: the VQ-VAE's own.
        codes: share of the imagined codes that are right.
        changed_codes: the same over the codes that are not those of the first frame.
    """

    psnr: float
    still_psnr: float
    redrawn_psnr: float
    codes: float
    changed_codes: float

    def __str__(self) -> str:
        return (
            f"imagined at {self.psnr:.2f} dB (nothing moves {self.still_psnr:.2f}, all codes right "
            f"{self.redrawn_psnr:.2f}); {100 * self.codes:.1f} % of the codes right, "
            f"{100 * self.changed_codes:.1f} % of those that change"
        )


@torch.no_grad()
def measure(model: Mage, episodes: Episodes, chosen: Iterable[int], batch: int = 8) -> Imagined:
    """Figures over some episodes; frames after an episode's end are its last."""
    numbers = list(chosen)
    ratios: dict[str, list[torch.Tensor]] = {"psnr": [], "still_psnr": [], "redrawn_psnr": []}
    right, changed_right, changed_all = [], 0, 0
    times_T = np.arange(model.config.axial.frames)
    for first in range(0, len(numbers), batch):
        part = numbers[first : first + batch]
        clips = [clip[np.minimum(times_T, len(clip) - 1)] for clip in map(episodes.frames, part)]
        frames_BT3HW = to_frames(np.stack(clips), model.device)
        B, T = frames_BT3HW.shape[:2]
        true_BThw = model.vqvae.encode(frames_BT3HW.flatten(0, 1)).unflatten(0, (B, T))
        with evaluating(model):
            text = model.text([episodes.instructions[number] for number in part])
            imagined_BShw = model.axial.imagine(true_BThw[:, :1], text, T - 1)
        real = (frames_BT3HW[:, 1:] + 1) / 2
        for name, codes in (
            ("psnr", imagined_BShw),
            ("still_psnr", true_BThw[:, :1].expand_as(imagined_BShw)),
            ("redrawn_psnr", true_BThw[:, 1:]),
        ):
            drawn = model.vqvae.decode(codes.flatten(0, 1)).unflatten(0, (B, T - 1))
            ratios[name].append(psnr((drawn.clamp(-1, 1) + 1) / 2, real))
        hits, changed = imagined_BShw == true_BThw[:, 1:], true_BThw[:, 1:] != true_BThw[:, :1]
        right.append(hits.float().mean(dim=(1, 2, 3)))
        changed_right += int((hits & changed).sum())
        changed_all += int(changed.sum())
    return Imagined(
        **{name: float(torch.cat(values).mean()) for name, values in ratios.items()},
        codes=float(torch.cat(right).mean()),
        changed_codes=changed_right / max(1, changed_all),
    )
