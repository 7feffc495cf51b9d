"""Where mixed precision must not reach."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def full_precision(like: Tensor) -> AbstractContextManager[object]:
    """Autocast switched off on the device of a tensor; what is computed within is as precise as its inputs."""
    if like.device.type == "meta":  # for shapes only; it has no autocast to switch off
        return nullcontext()
    return torch.autocast(like.device.type, enabled=False)
