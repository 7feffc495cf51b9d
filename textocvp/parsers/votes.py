"""A parser that has learned to see: pixels say what they are and vote for the centre and size of their object.

A small U-Net says of every pixel whether it shows background, an object or the robot, and where the centre of its
object lies and how large it is: a block in the middle of a bowl has the bowl's centre, but not its size. Where votes
are densest are objects, and each object pixel goes to the one nearest to its vote (Hough voting; as in VoteNet, Qi et
al. 2019, and Panoptic-DeepLab, Cheng et al. 2020). Later frames are divided
in the same way, and their objects handed to the slots by place, size and colour. So nothing needs colours that differ,
one background, or even light. Place, size and colour of a slot are explicit, its content is read as in `placed`.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy  # its parts are loaded when they are first used
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import full_precision, init_relu_
from textocvp.parsers.base import Generators, Parsed, SceneParser
from textocvp.parsers.clustering import color_features
from textocvp.parsers.placed import CropConfig, PlacedCorrector
from textocvp.slots import PRESENCE_BACKGROUND, PRESENCE_THING, ROBOT_SLOT, SlotState, moments

BACKGROUND, OBJECT, ROBOT = 0, 1, 2  # classes of pixels
REACH = 8.0  # pixels in which votes are written: an object's radius or so
SIZE_UNIT = 12.0  # of the logarithm of an object's radius, in pixels: a bowl and the block in it must lie apart
SMALLEST = 14.3  # in that unit: smaller radii are alike, for a half hidden block is one block, not two
VOTE_SPREAD = 1.2  # pixels by which votes of one object may differ
LEAST_EXPONENT = -40.0  # of how near two votes are
MIN_SHARE = 0.12  # of the votes that a square of an object's size would have, at least
MOST_VOTES = 1000  # of a frame that are compared with each other
MIN_AREA = 4  # pixels of an object, at least
LATE_AREA = 20  # and of one that comes into sight later, or beside the robot: what is smaller is part of something else
TOOL_AREA = 45  # and of both: a tool that comes near the camera is seen to be larger
TOUCHES = 2  # pixels between two things that touch, at most
FIRST_THING = ROBOT_SLOT + 1  # the slots of objects are from here on
UNSEEN = 0.0  # colour of a slot that holds nothing yet

# What it costs to take a thing for that of a slot: log(1 + d^2), d its distance in units of three times the slot's size
# and SEARCH together, and its differences in colour and log-size.
SEARCH = 0.08
COLOR_COST, SIZE_COST = 4.0, 0.7
BACK_COST = 2.0  # of colour alone, up to which what is new is a thing that was lost
MOST_COST, PIECE_COST = 2.5, 1.2  # up to which a thing is that of a slot, and what nobody has is a piece of it


@dataclass(frozen=True)
class VotesConfig(CropConfig):
    """Options of `VotesParser`; `num_slots` includes the background and the robot."""

    kind: Literal["votes"] = "votes"
    channels: int = 24  # of the network at half resolution; below there are 2, 3 and 4 times as many
    channels_full: int = 16  # at full resolution
    min_votes: float = 4.0  # a smaller peak of the votes is no object
    peak_radius: float = 5.0  # pixels of votes within which there is no second object

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_slots(3, "background, robot and a thing")
        if self.image_size % 2:
            raise ValueError(f"parser.image_size is {self.image_size}: the network reads squares of 2x2 pixels")


class Residual(nn.Module):
    """Two 3x3 convolutions beside a straight way; starts as the straight way alone, so it needs no norm."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.straight = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        init_relu_(self)
        nn.init.zeros_(self.second.weight)

    def forward(self, x_NCHW: Tensor) -> Tensor:
        return F.relu(self.straight(x_NCHW) + self.second(F.relu(self.first(x_NCHW))))


class VoteNetwork(nn.Module):
    """Frames (N, 3, H, W) to class logits and votes (N, 3, H, W); see `VoteTargets`.

    Most of it works at half resolution and below; two thin convolutions at full resolution draw the borders.

    Args:
        channels: at half resolution; at the three below it twice, three and four times as many.
        full: channels at full resolution.
    """

    def __init__(self, channels: int, full: int) -> None:
        super().__init__()
        widths = [channels * times for times in (1, 2, 3, 4)]
        self.fine = nn.Conv2d(3, full, 3, padding=1)
        self.stem = nn.Conv2d(12, channels, 3, padding=1)
        pairs = list(zip(widths[:1] + widths[:-1], widths, strict=True))
        self.down = nn.ModuleList([Residual(a, b) for a, b in pairs])
        self.up = nn.ModuleList([Residual(a + b, a) for a, b in pairs[:0:-1]])
        self.widen = nn.Conv2d(channels, 4 * full, 3, padding=1)
        self.border = nn.Conv2d(2 * full, full, 3, padding=1)
        self.out = nn.Conv2d(full, 6, 3, padding=1)
        for layer in (self.fine, self.stem, self.widen, self.border):
            init_relu_(layer)

    def forward(self, frames_N3HW: Tensor) -> tuple[Tensor, Tensor]:
        # Exposure and white balance are taken out, so that only uneven light is left to learn.
        mean, std = frames_N3HW.mean((2, 3), keepdim=True), frames_N3HW.std((2, 3), keepdim=True)
        x = ((frames_N3HW - mean) / (std + 0.05)).contiguous(memory_format=torch.channels_last)
        fine = F.relu(self.fine(x))
        x = F.relu(self.stem(F.pixel_unshuffle(x, 2)))
        levels: list[Tensor] = []
        for block in self.down:
            x = block(F.max_pool2d(x, 2, ceil_mode=True) if levels else x)
            levels.append(x)
        for block, level in zip(self.up, levels[-2::-1], strict=True):
            x = F.interpolate(x, scale_factor=2.0)[:, :, : level.shape[2], : level.shape[3]]
            x = block(torch.cat([x, level], 1))
        x = F.relu(F.pixel_shuffle(self.widen(x), 2))
        # Channels lie last in memory: along that axis `cat` is several times faster.
        x = torch.cat([x.permute(0, 2, 3, 1), fine.permute(0, 2, 3, 1)], 3).permute(0, 3, 1, 2)
        x = self.out(F.relu(self.border(x))).float()
        return x[:, :3], REACH * x[:, 3:]


@dataclass
class VoteTargets:
    """What the network should say of frames with known masks."""

    classes_NHW: Tensor  # `BACKGROUND`, `OBJECT` or `ROBOT`
    # From each pixel to the mean of the pixels with its label, (x, y) in pixels, and the logarithm of their root
    # mean square distance from it, in units of `SIZE_UNIT`. Hiding the middle of a thing changes both little.
    votes_N3HW: Tensor
    area_NHW: Tensor  # number of pixels with its label


def vote_targets(labels_NHW: Tensor) -> VoteTargets:
    """Targets from labels: 0 background, 1 robot, any other (to 255) one object each."""
    N, H, W = labels_NHW.shape
    y_HW, x_HW = torch.meshgrid(
        torch.arange(H, dtype=torch.float32), torch.arange(W, dtype=torch.float32), indexing="ij"
    )
    grid_4L = torch.stack([torch.ones(H, W), x_HW, y_HW, x_HW.square() + y_HW.square()]).flatten(1)
    grid_4L = grid_4L.to(labels_NHW.device)
    index_N4L = labels_NHW.long().flatten(1)[:, None].expand(-1, 4, -1)
    sums_N4V = grid_4L.new_zeros(N, 4, 256).scatter_add_(2, index_N4L, grid_4L.expand(N, -1, -1))
    area_NV, mean_N3V = sums_N4V[:, 0], sums_N4V[:, 1:] / sums_N4V[:, :1].clamp_min(1)
    spread_NV = (mean_N3V[:, 2] - mean_N3V[:, :2].square().sum(1)).clamp_min(0.25).sqrt()
    own_N4L = torch.stack([mean_N3V[:, 0], mean_N3V[:, 1], SIZE_UNIT * spread_NV.log(), area_NV], 1).gather(
        2, index_N4L
    )
    offsets_N2L = own_N4L[:, :2] - grid_4L[1:3]
    votes_N3L, area_NL = torch.cat([offsets_N2L, own_N4L[:, 2:3]], 1), own_N4L[:, 3]
    classes_NHW = torch.where(labels_NHW == 0, BACKGROUND, torch.where(labels_NHW == 1, ROBOT, OBJECT))
    return VoteTargets(classes_NHW, votes_N3L.unflatten(2, (H, W)), area_NL.unflatten(1, (H, W)))


def vote_loss(logits_N3HW: Tensor, votes_N3HW: Tensor, targets: VoteTargets) -> Tensor:
    """Cross-entropy and Dice error of the classes, and Huber error of the votes; a mean over frames."""
    with full_precision(logits_N3HW.device):
        objects_NHW = (targets.classes_NHW == OBJECT).float()
        # Small objects count as much as large ones, and the pixels around an object as much as its own: where it
        # ends is as important as where it is.
        weight_NHW = objects_NHW * (100 / targets.area_NHW).sqrt().clamp(0.5, 4)
        around_NHW = 1 + 3 * F.max_pool2d(weight_NHW, 7, 1, 3)
        cross_N = (F.cross_entropy(logits_N3HW, targets.classes_NHW, reduction="none") * around_NHW).mean((1, 2))
        share_NHW = logits_N3HW.softmax(1)[:, OBJECT]
        both, either = (share_NHW * objects_NHW).sum((1, 2)), (share_NHW + objects_NHW).sum((1, 2))
        dice_N = 1 - (2 * both + 10) / (either + 10)
        apart_NHW = F.smooth_l1_loss(votes_N3HW / REACH, targets.votes_N3HW / REACH, reduction="none", beta=0.1).sum(1)
        place_N = (apart_NHW * weight_NHW).sum((1, 2)) / weight_NHW.sum((1, 2)).clamp_min(1)
        return (cross_N + 0.3 * dice_N + 2 * place_N).mean()


@dataclass
class Ballot:
    """The votes of one frame's object pixels, and the objects that they elect."""

    y_L: Tensor  # rows and columns of the pixels
    x_L: Tensor
    votes_L3: Tensor  # where they say that their object's centre is, (x, y) in pixels and its size
    peaks_P3: Tensor  # where these are densest, the densest first

    def elect(self, candidates_C3: Tensor) -> Tensor:
        """To which of some candidates each pixel goes (L,): the one nearest to its vote."""
        return _apart(self.votes_L3, candidates_C3).argmin(1)


def count_votes(
    logits_3HW: Tensor, votes_3HW: Tensor, most: int, min_votes: float = 4.0, peak_radius: float = 5.0
) -> Ballot:
    """Find where the votes of object pixels are densest.

    Args:
        most: how many objects a frame can have at most.
        min_votes: an object has at least so many votes within `VOTE_SPREAD` or so.
        peak_radius: as in `VotesConfig`.
    """
    y_L, x_L = (logits_3HW.argmax(0) == OBJECT).nonzero(as_tuple=True)
    votes_L3 = votes_3HW[:, y_L, x_L].T + torch.stack([x_L, y_L, 0 * x_L], 1)
    some_S3 = votes_L3[:: 1 + len(votes_L3) // MOST_VOTES]
    near_SS = _apart(some_S3, some_S3)
    # What is farther apart adds nothing, and CPUs are slow where `exp` all but vanishes.
    kernel_SS = (-near_SS.square() / (2 * VOTE_SPREAD**2)).clamp_min(LEAST_EXPONENT).exp()
    density_S = kernel_SS.sum(1) * len(votes_L3) / max(1, len(some_S3))
    # Large objects need more votes: else the stray ones of their borders would be objects of their own.
    enough_S = (MIN_SHARE * _pixels_of(some_S3)).clamp_min(min_votes)
    density_S = density_S.masked_fill(density_S < enough_S, 0.0)
    peaks: list[int] = []
    while len(peaks) < most and len(some_S3) and density_S.max() > 0:
        peaks.append(int(density_S.argmax()))
        density_S = density_S.masked_fill(near_SS[peaks[-1]] < peak_radius, 0.0)
    return Ballot(y_L, x_L, votes_L3, some_S3[peaks])


def _apart(votes_N3: Tensor, others_M3: Tensor) -> Tensor:
    """(N, M) how far votes are apart."""
    lowest_3 = votes_N3.new_tensor([-math.inf, -math.inf, SMALLEST])
    return torch.cdist(votes_N3.maximum(lowest_3), others_M3.maximum(lowest_3))


def _pixels_of(votes_N3: Tensor) -> Tensor:
    """(N,) how many pixels a filled square has whose size is voted for."""
    return 6 * (2 / SIZE_UNIT * votes_N3[:, 2]).exp()


def follow(
    ballot: Ballot, frame_3HW: Tensor, robot_HW: Tensor, state: SlotState, speed_K2: Tensor, peak_radius: float = 5.0
) -> Tensor:
    """The slot (L,) of each of one frame's object pixels, by place, colour and size.

    Args:
        robot_HW: which pixels show the robot.
        state: slots (K,) of the frame before.
        speed_K2: how far they moved in it.
        peak_radius: as in `VotesConfig`.
    """
    (H, W), P = frame_3HW.shape[1:], len(ballot.peaks_P3)
    if P == 0:
        return torch.zeros_like(ballot.y_L)
    winner_L = ballot.elect(ballot.peaks_P3)
    masks_PHW = frame_3HW.new_zeros(P, H, W)
    masks_PHW[winner_L, ballot.y_L, ballot.x_L] = 1
    position_P2, scale_P2 = (values[0] for values in moments(masks_PHW[None]))
    mass_P1 = masks_PHW.sum((1, 2))[:, None].clamp_min(1)
    hue_P4 = color_features(masks_PHW.flatten(1) @ frame_3HW.flatten(1).T / mass_P1)
    area_P = mass_P1[:, 0].cpu().numpy()

    reach_K1 = 3 * state.scale.mean(-1, keepdim=True) + SEARCH
    off_KP = torch.cdist(state.position + speed_K2, position_P2) / reach_K1
    size_KP = (scale_P2.log().mean(-1) - state.scale.log().mean(-1, keepdim=True)).abs()
    look_KP = COLOR_COST * torch.cdist(color_features(state.color), hue_P4)
    cost_KP = torch.log1p(off_KP.square()) + look_KP
    used_K = state.is_thing[:, 0].cpu().numpy()
    used, free = (FIRST_THING + np.flatnonzero(which) for which in (used_K[FIRST_THING:], ~used_K[FIRST_THING:]))
    cost_UP = (cost_KP + SIZE_COST * size_KP).cpu().numpy()[used].clip(max=MOST_COST)
    # What is matched is what explains the most pixels: else a tool's tip could turn a thing away from its own.
    rows, columns = scipy.optimize.linear_sum_assignment((MOST_COST - cost_UP) * area_P, maximize=True)
    sure = cost_UP[rows, columns] < MOST_COST
    owner_P = np.zeros(P, int)
    owner_P[columns[sure]] = used[rows[sure]]
    # What is left is a piece of a thing that fell apart, or it is new.
    rest = np.flatnonzero(owner_P == 0)
    pieces = cost_UP[:, rest].min(0, initial=MOST_COST) < PIECE_COST
    if pieces.any():
        owner_P[rest[pieces]] = used[cost_UP[:, rest[pieces]].argmin(0)]
    new = rest[~pieces]  # all in the first frame, when no slot is used
    late = len(used) > 0
    if (small := area_P[new] < (TOOL_AREA if late else LATE_AREA)).any():
        around_HW = F.max_pool2d(robot_HW[None].float(), 2 * TOUCHES + 1, 1, TOUCHES)[0]
        touches = (masks_PHW[new] * around_HW).amax((1, 2)).bool().cpu().numpy()
        owner_P[new[small & touches]] = ROBOT_SLOT  # its tool has other colours
        new = new[~(small & touches)]
    if late:  # nothing comes from nowhere: it may be a thing that was lost
        new = new[area_P[new] >= LATE_AREA]
        lost = np.setdiff1d(used, owner_P)
        alike_LN = look_KP.cpu().numpy()[np.ix_(lost, new)]
        rows, columns = scipy.optimize.linear_sum_assignment(alike_LN)
        found = alike_LN[rows, columns] < BACK_COST
        owner_P[new[columns[found]]] = lost[rows[found]]
        new = np.delete(new, columns[found])
    new = new[: len(free)]
    owner_P[new] = free[: len(new)]

    # A thing that has no peak may stand where it stood, beside a larger one: it keeps the votes nearest to it.
    missing = np.setdiff1d(used, owner_P)
    radius_M = (state.scale * state.scale.new_tensor([W / 2, H / 2])).norm(dim=-1)[missing]
    center_M2 = (state.position[missing] + 1) * state.position.new_tensor([W / 2, H / 2]) - 0.5
    known_M3 = torch.cat([center_M2, SIZE_UNIT * radius_M.log()[:, None]], 1)
    votes_M = (_apart(known_M3, ballot.votes_L3) < peak_radius).sum(1)
    there = (votes_M >= MIN_SHARE * _pixels_of(known_M3).clamp_min(MIN_AREA)).cpu().numpy()
    candidates_C3 = torch.cat([ballot.peaks_P3, known_M3[there]])
    owner_C = torch.as_tensor(np.concatenate([owner_P, missing[there]]), device=winner_L.device)
    return owner_C[ballot.elect(candidates_C3)]


class VotesParser(SceneParser):
    """Slots: background, robot, then as many things as the first frame shows; the rest is unused.

    What comes into sight later takes an unused slot. A hidden thing keeps its slot.
    """

    Config = VotesConfig
    config: VotesConfig
    taught = True

    def __init__(self, config: VotesConfig) -> None:
        super().__init__(config)
        self.network = VoteNetwork(config.channels, config.channels_full)
        self.corrector = PlacedCorrector(config)

    def forward(self, frames_BT3HW: Tensor, *, num_slots: int | None = None, generator: Generators = None) -> Parsed:
        """Parse clips; see `SceneParser.forward`. Nothing is drawn at random here: `generator` changes nothing.

        No gradient reaches the network, which learns from `vote_loss`. What is expected of a slot is what it was.
        """
        if num_slots is not None and num_slots < FIRST_THING:
            raise ValueError(f"num_slots is {num_slots}: background and robot take {FIRST_THING}")
        state = self._nothing(frames_BT3HW[:, 0], num_slots or self.config.num_slots)
        speed_BK2 = torch.zeros_like(state.position)
        slots, attentions = [], []
        for frames_B3HW in frames_BT3HW.unbind(1):
            before = state
            attention_BKHW = self._divide(frames_B3HW, state, speed_BK2)
            state = self._corrected(frames_B3HW, _greet(state, frames_B3HW, attention_BKHW), attention_BKHW)
            speed_BK2 = torch.where(before.is_thing, state.position - before.position, 0.0)
            slots.append(state.join())
            attentions.append(attention_BKHW)
        slots_BTKD = torch.stack(slots, 1)
        return Parsed(slots_BTKD, torch.stack(attentions, 1), slots_BTKD[:, :-1])

    def _corrected(self, frames_B3HW: Tensor, state: SlotState, attention_BKHW: Tensor) -> SlotState:
        """The slots read afresh from each frame that shows them, so that what looks alike is alike."""
        blank = replace(state, content=torch.zeros_like(state.content))
        read, _ = self.corrector(frames_B3HW, blank, attention_BKHW)
        shown_BK1 = attention_BKHW.sum((2, 3))[..., None] >= self.corrector.min_pixels
        return replace(read, content=torch.where(shown_BK1, read.content, state.content))

    def lesson_loss(self, frames_N3HW: Tensor, labels_NHW: Tensor) -> Tensor:
        logits_N3HW, votes_N3HW = self.network(frames_N3HW)
        return vote_loss(logits_N3HW, votes_N3HW, vote_targets(labels_NHW))

    @torch.no_grad()
    def _divide(self, frames_B3HW: Tensor, state: SlotState, speed_BK2: Tensor) -> Tensor:
        """What each slot covers (B, K, H, W), which sums to 1 over the slots."""
        # Votes are counted on the CPU: a GPU would wait for each of many small steps.
        logits_B3HW, votes_B3HW = (part.cpu() for part in self.network(frames_B3HW))
        slots = SlotState(*(part.cpu() for part in vars(state).values()))
        seen_B3HW, speeds_BK2 = frames_B3HW.cpu(), speed_BK2.cpu()
        B, K = state.presence.shape[:2]
        slot_BHW = ROBOT_SLOT * (logits_B3HW.argmax(1) == ROBOT)
        for b in range(B):
            radius = self.config.peak_radius
            ballot = count_votes(logits_B3HW[b], votes_B3HW[b], K - FIRST_THING, self.config.min_votes, radius)
            one = SlotState(*(part[b] for part in vars(slots).values()))
            robot_HW = slot_BHW[b] == ROBOT_SLOT
            slot_BHW[b, ballot.y_L, ballot.x_L] = follow(ballot, seen_B3HW[b], robot_HW, one, speeds_BK2[b], radius)
        nothing_BKHW = frames_B3HW.new_zeros(B, K, *slot_BHW.shape[1:])
        return nothing_BKHW.scatter_(1, slot_BHW.to(frames_B3HW.device)[:, None], 1.0)

    def _nothing(self, frames_B3HW: Tensor, K: int) -> SlotState:
        """Slots before anything is seen: the canvas, which fills the frame, and unused ones in its middle."""
        B = len(frames_B3HW)
        presence = frames_B3HW.new_zeros(B, K, 1)
        presence[:, 0] = PRESENCE_BACKGROUND
        place, size = frames_B3HW.new_zeros(B, K, 2), frames_B3HW.new_full((B, K, 2), 0.5)
        content = frames_B3HW.new_zeros(B, K, self.layout.content)
        return SlotState(content, frames_B3HW.new_full((B, K, 3), UNSEEN), place, size, presence)


def _greet(state: SlotState, frames_B3HW: Tensor, attention_BKHW: Tensor) -> SlotState:
    """The slots, those that cover something for the first time with its colour and presence."""
    area_BK1 = attention_BKHW.sum((2, 3))[..., None]
    mean_BK3 = attention_BKHW.flatten(2) @ frames_B3HW.flatten(2).transpose(1, 2) / area_BK1.clamp_min(1)
    fresh_BK1 = (area_BK1 >= MIN_AREA) & (state.color == UNSEEN).all(-1, keepdim=True)
    color = torch.where(fresh_BK1, mean_BK3, state.color)
    presence = torch.where(fresh_BK1 & state.is_unused, PRESENCE_THING, state.presence)
    return SlotState(state.content, color, state.position, state.scale, presence)
