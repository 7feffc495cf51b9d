"""How well a parser finds the things of held-out episodes, measured against the simulator's segmentation.

The segmentation is used for measuring only; nothing here is ever trained on.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
import torch

from textocvp.data.episodes import EpisodeFile
from textocvp.metrics.frames import psnr
from textocvp.metrics.intervals import Interval, bootstrap_interval
from textocvp.metrics.masks import followed, foreground_ari, object_ious
from textocvp.model import TextOCVP
from textocvp.parsers.base import to_frames

GATES = {"object_miou": 0.80, "object_found": 0.93, "followed": 0.90}
"""What a parser of the tabletop must reach on held-out episodes before a predictor is worth training on its slots."""


@dataclass(frozen=True)
class ParserMetrics:
    """Figures over whole episodes, each a mean over episodes with its 95 % bootstrap interval.

    A model with one slot has one mask, in which no object can be found or followed: all but its PSNR is None.

    Attributes:
        object_miou: IoU of drawn masks with blocks and bowls, Hungarian matching a frame.
        object_found: share of blocks and bowls with an IoU above one half.
        followed: share of the first frame's things whose slot keeps them through the whole episode.
        foreground_ari: adjusted Rand index without the background's pixels, the arm included.
        psnr: of the redrawn frames, dB.
    """

    object_miou: Interval | None
    object_found: Interval | None
    followed: Interval | None
    foreground_ari: Interval | None
    psnr: Interval

    def __str__(self) -> str:
        text = ", ".join(f"{name} {interval}" for name, interval in self._measured().items())
        return text if self.object_miou is not None else f"{text} (one slot: there are no masks to measure)"

    def _measured(self) -> dict[str, Interval]:
        named = ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        return {name: interval for name, interval in named if interval is not None}

    def figures(self) -> dict[str, float]:
        """The values alone, named for a log."""
        return {f"quality/{name}": interval.value for name, interval in self._measured().items()}

    def missed_gates(self) -> list[str]:
        """A sentence for each figure below its gate; empty for a parser that is good enough.

        The gates are for slots that are things, so a model with one slot misses none.
        """
        measured = self._measured()
        return [
            f"{name} is {measured[name].value:.3f}, below its gate of {gate:.2f}"
            for name, gate in GATES.items()
            if name in measured and measured[name].value < gate
        ]

    def to_json(self) -> str:
        """Values, intervals and numbers of episodes."""
        return json.dumps(asdict(self), indent=2) + "\n"


@torch.no_grad()
def measure_parser(
    model: TextOCVP, episodes: EpisodeFile, chosen: Iterable[int], *, frame_step: int = 3
) -> ParserMetrics:
    """Parse whole episodes and compare the drawn masks with the simulator's.

    Args:
        model: its parser and renderer are measured.
        episodes: held-out episodes.
        chosen: their numbers.
        frame_step: IoU, ARI and PSNR are taken at every `frame_step`-th frame; following always at every frame.
    """
    ious, found, follows, aris, psnrs = [], [], [], [], []
    for index in chosen:
        episode = episodes.episode(index)
        frames = to_frames(episode.frames[None], model.device)[0]
        # Where first slots are drawn, an episode's are the same whenever it is measured.
        seeded = torch.Generator(model.device).manual_seed(index)
        slots = model.parser(frames[None], generator=seeded).slots_BTKD[0]
        rendered = model.renderer(slots)
        drawn = (rendered.frames_B3HW.clamp(-1, 1) + 1) / 2
        psnrs.append(psnr(drawn, (frames + 1) / 2).mean().item())
        if slots.shape[1] == 1:
            continue
        labels = rendered.masks_BKHW.argmax(1).cpu().numpy()
        truth, objects = episode.segmentation, range(2, 2 + len(episode.objects))
        times = range(0, len(labels), frame_step)
        matches = np.concatenate([object_ious(labels[t], truth[t], objects).ious for t in times])
        ious.append(matches.mean())
        found.append((matches > 0.5).mean())
        follows.append(followed(labels, truth, objects).mean())
        aris.append(np.mean([foreground_ari(labels[t], truth[t]) for t in times]))
    miou, share, kept, ari = (
        bootstrap_interval(values) if values else None for values in (ious, found, follows, aris)
    )
    return ParserMetrics(miou, share, kept, ari, bootstrap_interval(psnrs))
