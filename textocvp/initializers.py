"""Where the first slots of a clip come from, for parsers with slot attention."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.clustering import ClusterInitializer


class GaussianInitializer(nn.Module):
    """First slots drawn from one learned Gaussian, the same for every slot: their number is free at test
    time."""

    def __init__(self, slot_dim: int) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.randn(slot_dim) * slot_dim**-0.5)
        self.log_deviation = nn.Parameter(torch.zeros(slot_dim))

    def forward(
        self,
        batch: int,
        num_slots: int,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> Tensor:
        """(batch, num_slots, D) slots."""
        if isinstance(generator, Sequence):
            noise_KD = [
                torch.randn(num_slots, self.mean.shape[0], generator=g, device=g.device) for g in generator
            ]
            return self.mean + self.log_deviation.exp() * torch.stack(noise_KD).to(self.mean)
        noise_BKD = torch.randn(
            batch,
            num_slots,
            self.mean.shape[0],
            generator=generator,
            device=self.mean.device,
            dtype=self.mean.dtype,
        )
        return self.mean + self.log_deviation.exp() * noise_BKD


class ClusterSlots(nn.Module):
    """First slots from clusters: the mean feature of each cluster, through a small MLP.

    A cluster that has no pixels gives a slot of the learned empty content, which takes part like any other: in this
    family a slot has no presence that could switch it off.

    Args:
        slot_dim: D.
        clusters: finds them in what `forward` is given.
    """

    def __init__(self, slot_dim: int, clusters: ClusterInitializer) -> None:
        super().__init__()
        self.clusters = clusters
        self.mlp = nn.Sequential(
            nn.LayerNorm(slot_dim), nn.Linear(slot_dim, slot_dim), nn.ReLU(), nn.Linear(slot_dim, slot_dim)
        )
        self.empty = nn.Parameter(torch.randn(slot_dim) * slot_dim**-0.5)

    def forward(self, seen_BCHW: Tensor, features_BDhw: Tensor, num_slots: int) -> tuple[Tensor, Tensor]:
        """(B, num_slots, D) slots, and the share of every location (B, num_slots, h * w) that each cluster covers.

        Args:
            seen_BCHW: what is divided into clusters: frames, or the features of a frozen encoder.
            features_BDhw: whose means the slots are made of.
        """
        found = self.clusters(seen_BCHW, num_slots)
        shares_BKL = F.adaptive_avg_pool2d(
            found.masks, (features_BDhw.shape[-2], features_BDhw.shape[-1])
        ).flatten(2)
        weights_BKL = shares_BKL / shares_BKL.sum(dim=-1, keepdim=True).clamp_min(1e-6)
        slots_BKD = self.mlp(weights_BKL @ features_BDhw.flatten(2).transpose(1, 2))
        return torch.where(found.presence[..., None] > 0, slots_BKD, self.empty), shares_BKL
