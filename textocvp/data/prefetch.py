"""Batches read ahead by worker processes, the same ones whatever their number."""

import signal
from collections.abc import Callable, Iterable
from typing import TypeVar

import torch
from torch.utils.data import DataLoader

Batch = TypeVar("Batch")


def _outlive_the_signal(worker: int) -> None:
    # Clusters send SIGTERM to whole groups of processes, and the training process still finishes its update.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def prefetch(read: Callable[[int], Batch], steps: range, workers: int) -> Iterable[Batch]:
    """The batches of these steps, in their order, read by `workers` processes beside this one (0: by this one).

    Args:
        read: makes the batch of a step, as a function of its number alone: then workers change only the speed.
    """
    if workers == 0:
        return map(read, steps)
    # The data set are the numbers of the steps, and each becomes its batch where others collate samples.
    return DataLoader(
        steps,  # type: ignore[arg-type]
        batch_size=None,
        collate_fn=read,
        num_workers=workers,
        worker_init_fn=_outlive_the_signal,
        generator=torch.Generator(),  # else it would draw from PyTorch's own, and so change what follows
    )
