"""Batches read ahead by worker processes, the same ones whatever their number."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

Batch = TypeVar("Batch")


class _Steps(Dataset):
    """The batches of some steps, for a DataLoader."""

    def __init__(self, read: Callable[[int], Any], steps: range) -> None:
        self.read, self.steps = read, steps

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> Any:
        return self.read(self.steps[index])


def _outlive_the_signal(worker: int) -> None:
    # Clusters send SIGTERM to whole groups of processes, and the training process still finishes its update.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _as_read(batch: Batch) -> Batch:
    return batch


def prefetch(read: Callable[[int], Batch], steps: range, workers: int) -> Iterable[Batch]:
    """The batches of these steps, in their order, read by `workers` processes beside this one (0: by this one).

    Args:
        read: makes the batch of a step, as a function of its number alone: then workers change nothing but the speed.
            Tensors in a batch travel through shared memory.
    """
    if workers == 0:
        return map(read, steps)
    return DataLoader(
        _Steps(read, steps),
        batch_size=None,
        collate_fn=_as_read,
        num_workers=workers,
        worker_init_fn=_outlive_the_signal,
        generator=torch.Generator(),  # else it would draw from PyTorch's own, and so change what follows
    )
