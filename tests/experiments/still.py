"""A test double that sees no things and imagines that nothing happens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from textocvp.world_model import Checkpoint


@dataclass(frozen=True)
class LoadStill:
    """Makes the double, which looks at most `longest` frames ahead."""

    longest: int | None = 12

    def __call__(self) -> Still:
        return Still(self.longest)


@dataclass
class Still:
    """See the module."""

    longest_horizon: int | None
    checkpoint = Checkpoint("still", "1" * 64)
    image_size = (64, 64)

    def imagine(
        self, obs: Mapping[str, Any] | np.ndarray, text: str | Sequence[str], *, horizon: int, seed: int = 0
    ) -> Tensor:
        assert self.longest_horizon is None or horizon <= self.longest_horizon
        frame = torch.from_numpy(np.array(obs)).permute(2, 0, 1).float() / 255
        return frame.expand(1, horizon + 1, -1, -1, -1)
