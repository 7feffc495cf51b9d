"""Batches read ahead by worker processes, the same ones whatever their number."""

import signal
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

Batch = TypeVar("Batch")


class _Steps(Dataset):
    """The batch of any step, for a DataLoader."""

    def __init__(self, read: Callable[[int], Any]) -> None:
        self.read = read

    def __getitem__(self, step: int) -> Any:
        return self.read(step)


def _outlive_the_signal(worker: int) -> None:
    # Clusters send SIGTERM to whole groups of processes, and the training process still finishes its update.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _as_read(batch: Batch) -> Batch:
    return batch


def prefetch(read: Callable[[int], Batch], steps: range, workers: int) -> Iterable[Batch]:
    """The batches of these steps, in their order, read by `workers` processes beside this one (0: by this one).

    Args:
        read: makes the batch of a step, as a function of its number alone: then workers change only the speed.
    """
    if workers == 0:
        return map(read, steps)
    return DataLoader(
        _Steps(read),
        sampler=steps,
        batch_size=None,
        collate_fn=_as_read,
        num_workers=workers,
        worker_init_fn=_outlive_the_signal,
        generator=torch.Generator(),  # else it would draw from PyTorch's own, and so change what follows
    )
