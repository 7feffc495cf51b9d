"""Slots that start from clusters of colour and place, without labels and without learned weights.

The published parser samples its first slots from one learned Gaussian. In a few hours of two CPU cores such slots tile
the image by region and bind to nothing. With clusters (the idea of clustering-based slot initialisation, 2023) every
object has a slot from the first step of training. Slots stay exchangeable, and their number stays free at test time.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import full_precision, pixel_grid

CHROMA_WEIGHT = 2.0
PLACE_WEIGHT = 0.7


@dataclass
class Clusters:
    """Disjoint regions of a batch of images."""

    masks: Tensor  # (B, K, H, W) float, one-hot over K; region 0 is the background, the others are sorted by area
    presence: Tensor  # (B, K) 1 where the region has pixels, 0 where it is unused


def color_features(colors: Tensor) -> Tensor:
    """Features (..., 4) of RGB in -1..1, in which the shading of one object matters little.

    Twice the chroma `(rgb - L) / (L + .2)`, then the luminance L = mean(rgb) in 0..1. A permutation of the colour
    channels permutes the chroma and leaves all distances between features as they are.
    """
    rgb = (colors + 1) / 2
    luminance = rgb.mean(-1, keepdim=True)
    return torch.cat([CHROMA_WEIGHT * (rgb - luminance) / (luminance + 0.2), luminance], dim=-1)


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """(B, N, M) squared Euclidean distances between a (B, N, C) and b (B, M, C)."""
    with full_precision(a.device):
        a, b = a.float(), b.float()
        cross = a @ b.transpose(1, 2)
    return (a.square().sum(-1, keepdim=True) + b.square().sum(-1)[:, None] - 2 * cross).clamp_min(0)


class ClusterInitializer(nn.Module):
    """Farthest-point seeds, a few k-means rounds, then touching clusters of one colour united."""

    seeds = 16  # clusters to start from, the background not counted; more where more slots are asked for
    rounds = 4  # of k-means
    background_distance = 0.03  # squared feature distance from the median colour above which a pixel can seed
    # Touching clusters that are closer than this in chroma (sum over channels) and luminance are one thing.
    same_chroma, same_luminance = 0.1, 0.15
    min_pixels = 4  # smaller regions go back to the background

    @torch.no_grad()
    def forward(self, frames: Tensor, num_slots: int) -> Clusters:
        """Divide frames (B, 3, H, W) in -1..1 into a background and at most `num_slots - 1` regions.

        Raises:
            ValueError: if `num_slots` is below 2.
        """
        _check_slots(num_slots)
        B, _, H, W = frames.shape
        colors_BNC = color_features(frames.flatten(2).transpose(1, 2).float())
        place_BNC = (PLACE_WEIGHT * pixel_grid(H, W, device=frames.device).flatten(0, 1)).expand(B, -1, -1)
        points_BNC = torch.cat([colors_BNC, place_BNC], dim=-1)
        background_B1C = colors_BNC.median(dim=1, keepdim=True).values
        to_background_BN = (colors_BNC - background_B1C).square().sum(-1)

        # A thing may take two seeds, so where more slots are asked for there are more seeds, too.
        seeds = max(self.seeds, num_slots + 2)
        centers_BSC, used_BS = self._seed(points_BNC, to_background_BN, H, W, seeds)
        onehot_BNS = self._k_means(points_BNC, to_background_BN, centers_BSC, used_BS)
        onehot_BSN = self._unite(onehot_BNS.transpose(1, 2), colors_BNC, H, W)
        return self._largest(onehot_BSN, num_slots, H, W)

    def _seed(self, points_BNC: Tensor, to_background_BN: Tensor, H: int, W: int, seeds: int) -> tuple[Tensor, Tensor]:
        B, _, C = points_BNC.shape
        nearest_BN = to_background_BN.clone()
        centers, used = [], []
        for _ in range(seeds):
            # Blurred, so that a seed lies inside a region and not on an odd pixel of its edge.
            smooth_BN = F.avg_pool2d(nearest_BN.view(B, 1, H, W), 3, 1, 1, count_include_pad=False).flatten(1)
            smooth_BN = smooth_BN.masked_fill(nearest_BN <= self.background_distance, 0.0)
            value_B1, index_B1 = smooth_BN.max(dim=1, keepdim=True)
            center_B1C = points_BNC.gather(1, index_B1[..., None].expand(-1, -1, C))
            centers.append(center_B1C)
            used.append(value_B1 > 0)
            nearest_BN = torch.minimum(nearest_BN, (points_BNC - center_B1C).square().sum(-1))
        return torch.cat(centers, 1), torch.cat(used, 1)

    def _k_means(self, points_BNC: Tensor, to_background_BN: Tensor, centers_BSC: Tensor, used_BS: Tensor) -> Tensor:
        S = centers_BSC.shape[1]
        for last in [False] * self.rounds + [True]:
            distance_BNS = squared_distances(points_BNC, centers_BSC)
            distance_BNS = distance_BNS.masked_fill(~used_BS[:, None], float("inf"))
            all_BNS = torch.cat([to_background_BN[..., None], distance_BNS], dim=-1)
            onehot_BNS = F.one_hot(all_BNS.argmin(-1), S + 1).to(points_BNC.dtype)[..., 1:]
            if last:
                break
            mass_BS1 = onehot_BNS.sum(1)[..., None]
            mean_BSC = onehot_BNS.transpose(1, 2) @ points_BNC / mass_BS1.clamp_min(1)
            centers_BSC = torch.where(mass_BS1 > 0, mean_BSC, centers_BSC)
        return onehot_BNS

    def _unite(self, onehot_BSN: Tensor, colors_BNC: Tensor, H: int, W: int) -> Tensor:
        B, S, _ = onehot_BSN.shape
        mass_BS1 = onehot_BSN.sum(-1, keepdim=True)
        mean_BSC = onehot_BSN @ colors_BNC / mass_BS1.clamp_min(1)
        chroma_BSS = torch.cdist(mean_BSC[..., :3] / CHROMA_WEIGHT, mean_BSC[..., :3] / CHROMA_WEIGHT, p=1)
        luminance_BSS = torch.cdist(mean_BSC[..., 3:], mean_BSC[..., 3:], p=1)
        grown_BSN = F.max_pool2d(onehot_BSN.view(B, S, H, W), 3, 1, 1).flatten(2)
        touching_BSS = grown_BSN @ onehot_BSN.transpose(1, 2) > 0
        linked_BSS = touching_BSS & (chroma_BSS < self.same_chroma) & (luminance_BSS < self.same_luminance)
        reach_BSS = (linked_BSS | torch.eye(S, dtype=torch.bool, device=linked_BSS.device)).float()
        for _ in range((S - 1).bit_length()):  # transitive closure by repeated squaring
            reach_BSS = (reach_BSS @ reach_BSS > 0).float()
        leader_BS = reach_BSS.argmax(-1)  # the first cluster that can be reached
        return F.one_hot(leader_BS, S).to(onehot_BSN.dtype).transpose(1, 2) @ onehot_BSN

    def _largest(self, onehot_BSN: Tensor, num_slots: int, H: int, W: int) -> Clusters:
        B, S, N = onehot_BSN.shape
        keep = min(num_slots - 1, S)
        area_BS, order_BS = onehot_BSN.sum(-1).topk(keep, dim=1)
        regions_BSN = onehot_BSN.gather(1, order_BS[..., None].expand(-1, -1, N))
        regions_BSN = regions_BSN * (area_BS >= self.min_pixels)[..., None]
        if keep < num_slots - 1:
            regions_BSN = F.pad(regions_BSN, (0, 0, 0, num_slots - 1 - keep))
        background_B1N = 1 - regions_BSN.sum(1, keepdim=True)
        masks_BKN = torch.cat([background_B1N, regions_BSN], dim=1)
        return Clusters(masks_BKN.view(B, num_slots, H, W), (masks_BKN.sum(-1) > 0).to(masks_BKN.dtype))


class FeatureClusters(ClusterInitializer):
    """The same on the features of a frozen image encoder, which tell things apart without regard to their colour.

    Features are compared by their direction (each is normalised to mean 0 and length 1), and their distances from the
    image's median feature, the background, are scaled so that the largest is 1. Clusters are not united: what makes two
    of them one thing is known for colours only.
    """

    background_distance = 0.3  # share of the largest squared distance above which a location can seed
    min_pixels = 1
    place_weight = 0.3  # length of the image's half side, in units of the largest distance

    @torch.no_grad()
    def forward(self, features: Tensor, num_slots: int) -> Clusters:
        """Divide the locations of features (B, F, h, w); errors as the base class."""
        _check_slots(num_slots)
        B, C, H, W = features.shape
        points_BNC = F.layer_norm(features.flatten(2).transpose(1, 2).float(), (C,)) * C**-0.5
        points_BNC = points_BNC - points_BNC.median(dim=1, keepdim=True).values
        to_background_BN = points_BNC.square().sum(-1)
        largest_B1 = to_background_BN.amax(dim=1, keepdim=True).clamp_min(1e-6)
        to_background_BN = to_background_BN / largest_B1
        place_N2 = self.place_weight * pixel_grid(H, W, device=features.device).flatten(0, 1)
        points_BNC = points_BNC / largest_B1[..., None].sqrt()
        points_BNC = torch.cat([points_BNC, place_N2.expand(B, -1, -1)], dim=-1)
        # As many as there are slots for them: none is united with another, and none should be left over.
        centers_BSC, used_BS = self._seed(points_BNC, to_background_BN, H, W, num_slots - 1)
        onehot_BNS = self._k_means(points_BNC, to_background_BN, centers_BSC, used_BS)
        return self._largest(onehot_BNS.transpose(1, 2), num_slots, H, W)


def _check_slots(num_slots: int) -> None:
    if num_slots < 2:
        raise ValueError(f"num_slots must be at least 2 (a background and one region), not {num_slots}")
