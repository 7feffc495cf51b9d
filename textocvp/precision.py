"""Where mixed precision must not reach."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """Autocast switched off on a device; what is computed within is as precise as its inputs."""
    if device.type == "meta":  # for shapes only; it has no autocast to switch off
        return nullcontext()
    return torch.autocast(device.type, enabled=False)
