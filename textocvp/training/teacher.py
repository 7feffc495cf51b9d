"""Masks that a video gives of itself, for a parser that learns to see: no simulator, no labels.

The camera stands still, so the median of an episode's frames shows the scene without what moves, and its commonest
colours are those of floor and table. What has none of them is foreground; gray parts of it that reach into the upper
third are the robot, but for what the median shows below it, and connected parts of one hue are objects. Where no
colours are common because light falls unevenly on a gray floor (CATER), the floor's light is a smooth surface, and
there is no robot.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from textocvp.data.episodes import Episodes

Labels = NDArray[np.uint8]

TONE_SHARE = 0.06  # of the picture: a colour as common as this is background
TONE_RADIUS = 4  # of 255, in each channel: clean videos have flat floors
MIXED = 0.35  # share of a thing in the colour of a pixel up to which the pixel is background
NOISE = 8.0  # of 255, in each channel: what such a pixel may differ from a mixture of the two
GRAY = 26  # of 255: difference between channels up to which a pixel is gray
SAME_HUE = 0.035  # difference of chroma between neighbours up to which they are one thing
TWO_HUES = 0.025  # and between the halves of a thing from which on it is two
MIN_PIXELS = 4
FLAT = 0.6  # share of the picture that the commonest colours must have
# Of a floor in uneven light: what differs more from it in colour, in 0..255, or is this much darker or lighter.
FLOOR_CHROMA, DARKER, LIGHTER = 14.0, 0.66, 1.06
# As SAME_HUE, MIXED and NOISE. Things are round and shaded, and what is next to a pixel is not quite what is in it.
FLOOR_HUE, FLOOR_MIXED, FLOOR_NOISE = 0.07, 0.5, 30.0
FLOOR_ORDER = 4  # of the polynomial that the floor's light is


@dataclass(frozen=True)
class Backdrop:
    """What stays behind the things of an episode: its commonest colours, or the light on a gray floor."""

    median_HW3: NDArray[np.float32]
    tones_N3: NDArray[np.float32]
    standing_HW: NDArray[np.bool_] | None = None  # where the median shows a thing, and neither robot nor background
    floor_HW: NDArray[np.float32] | None = None


@dataclass
class Teacher:
    """Says what the pixels of clips show: 0 background, 1 robot, 2 and more one for each object."""

    # `video` takes masks from the video itself, `masks` those that come with the episodes.
    kind: Literal["video", "masks"]
    episodes: Episodes  # where the clips are from
    _backdrops: dict[int, Backdrop] = field(default_factory=dict)

    def labels(self, starts: NDArray[np.int64], frames_BTHW3: NDArray[np.uint8], stride: int) -> Labels:
        """Labels (B, T, H, W) of clips of every `stride`-th frame from these starts on.

        Raises:
            ValueError: if the episodes have no masks.
        """
        numbers = np.searchsorted(self.episodes.starts, starts, side="right") - 1
        found = []
        for index, start, frames_THW3 in zip(numbers.tolist(), starts, frames_BTHW3, strict=True):
            if self.kind == "masks":
                first = start - self.episodes.starts[index]
                found.append(self._given(index)[first:][: len(frames_THW3) * stride : stride])
                continue
            if index not in self._backdrops:
                self._backdrops[index] = backdrop(self.episodes.frames(index))
            found.append(video_masks(frames_THW3, self._backdrops[index]))
        return np.stack(found)

    def _given(self, index: int) -> Labels:
        truth = self.episodes.truth(index)
        if truth is None or truth.segmentation is None:
            raise ValueError(f"{self.episodes.path} has no masks to teach with: use --teacher video")
        labels = truth.segmentation.copy()
        if truth.robot != 1:  # that label is the robot's here
            labels[labels == 1] = np.setdiff1d(np.arange(2, 256), labels)[0]
        labels[truth.segmentation == truth.robot] = 1
        return labels


def backdrop(frames_THW3: NDArray[np.uint8]) -> Backdrop:
    """What stays behind the things of an episode."""
    median_HW3 = np.median(frames_THW3, axis=0).astype(np.float32)
    tones_N3 = background_tones(median_HW3)
    near_HW = (np.abs(median_HW3[:, :, None] - tones_N3).max(-1) <= TONE_RADIUS).any(-1)
    # Several tones that follow each other are one surface in uneven light.
    steps = np.diff(np.sort(tones_N3.mean(-1)))
    uneven = len(steps) > 1 and steps.max() <= 4 * TONE_RADIUS
    found = Backdrop(median_HW3, tones_N3)
    if uneven or near_HW.mean() < FLAT:
        return replace(found, floor_HW=_floor(median_HW3))
    return replace(found, standing_HW=_frame_masks(median_HW3, found) > 1)


def _floor(median_HW3: NDArray[np.float32]) -> NDArray[np.float32]:
    """The light on a gray floor, fitted to what lies near to it."""
    H, W, _ = median_HW3.shape
    y_HW, x_HW = np.mgrid[-1 : 1 : H * 1j, -1 : 1 : W * 1j]
    powers = [(i, j) for i in range(FLOOR_ORDER + 1) for j in range(FLOOR_ORDER + 1 - i)]
    terms_NP = np.stack([(x_HW**i * y_HW**j).ravel() for i, j in powers], 1)
    light_N = median_HW3.mean(-1).ravel()
    gray_N = np.ptp(median_HW3, axis=-1).ravel() <= FLOOR_CHROMA
    if gray_N.sum() < 4 * len(powers):
        gray_N[:] = True
    kept_N = gray_N
    for _ in range(8):
        fit_N = terms_NP @ np.linalg.lstsq(terms_NP[kept_N], light_N[kept_N], rcond=None)[0]
        off_N = np.abs(light_N - fit_N)
        kept_N = gray_N & (off_N <= max(3 * float(np.median(off_N[kept_N])), 2.0))
    return fit_N.reshape(H, W).astype(np.float32)


def background_tones(median_HW3: NDArray[np.float32]) -> NDArray[np.float32]:
    """The commonest colours (N, 3) of the median frame, at least one."""
    left = median_HW3.reshape(-1, 3)
    total = len(left)
    tones: list[NDArray[np.float32]] = []
    while len(left):
        cells = (left // 4).astype(int) @ [1, 64, 4096]
        values, counts = np.unique(cells, return_counts=True)
        tone = np.median(left[cells == values[counts.argmax()]], axis=0)
        inside = np.abs(left - tone).max(-1) <= TONE_RADIUS
        if tones and inside.sum() < TONE_SHARE * total:
            break
        tones.append(tone)
        left = left[~inside]
    return np.array(tones, np.float32)


def video_masks(frames_NHW3: NDArray[np.uint8], behind: Backdrop) -> Labels:
    """Labels (N, H, W) of frames: 0 background, 1 robot, 2 and more one for each object of a frame."""
    frames = frames_NHW3.astype(np.float32)
    if behind.floor_HW is None:
        return np.stack([_frame_masks(frame_HW3, behind) for frame_HW3 in frames])
    return np.stack([_masks_on_floor(frame_HW3, behind.floor_HW) for frame_HW3 in frames])


def _masks_on_floor(frame_HW3: NDArray[np.float32], floor_HW: NDArray[np.float32]) -> Labels:
    """Shadows are a little darker than the floor and as gray; all else is a thing."""
    share_HW = frame_HW3.mean(-1) / floor_HW.clip(1)
    colored_HW = np.ptp(frame_HW3, axis=-1) > FLOOR_CHROMA
    solid = ndimage.binary_fill_holes(colored_HW | (share_HW < DARKER) | (share_HW > LIGHTER))
    floor_HW3 = np.broadcast_to(floor_HW[..., None], frame_HW3.shape)
    solid &= ~(_border(solid) & _mostly(floor_HW3, frame_HW3, FLOOR_MIXED, FLOOR_NOISE))
    return _numbered(_parts_of_one_hue(frame_HW3, solid, FLOOR_HUE), np.zeros(solid.shape, np.uint8))


def _numbered(things_HW: NDArray[np.int64], labels_HW: Labels) -> Labels:
    for number, part in enumerate(np.unique(things_HW[things_HW > 0])[:250]):
        labels_HW[things_HW == part] = 2 + number
    return labels_HW


def _frame_masks(frame_HW3: NDArray[np.float32], behind: Backdrop) -> Labels:
    tones_K3 = behind.tones_N3
    apart_HWK = np.abs(frame_HW3[:, :, None] - tones_K3).max(-1)
    # Where floor and table meet there is a line of mixed colours, one or two pixels thick.
    solid = ndimage.binary_opening(apart_HWK.min(-1) > TONE_RADIUS, np.ones((2, 2)))
    solid &= ~(_border(solid) & _mostly(tones_K3[apart_HWK.argmin(-1)], frame_HW3, MIXED, NOISE))
    labels = np.zeros(solid.shape, np.uint8)
    gray = solid & (np.ptp(frame_HW3, axis=-1) <= GRAY)
    if behind.standing_HW is not None:  # a gray thing that the robot touches
        gray &= ~(behind.standing_HW & (np.abs(frame_HW3 - behind.median_HW3).max(-1) <= TONE_RADIUS))
    parts, _ = ndimage.label(gray)
    high = np.unique(parts[: len(parts) // 3])
    labels[np.isin(parts, high[high > 0])] = 1
    return _numbered(_split_by_hue(frame_HW3, _parts_of_one_hue(frame_HW3, solid & (labels == 0))), labels)


def _border(solid_HW: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return solid_HW & ~ndimage.binary_erosion(solid_HW, border_value=1)


def _mostly(
    tone_HW3: NDArray[np.float32], frame_HW3: NDArray[np.float32], mixed: float, noise: float
) -> NDArray[np.bool_]:
    """Which pixels (H, W) are their tone with less than `mixed` of a neighbour's colour in it."""
    H, W, _ = frame_HW3.shape
    around = np.pad(frame_HW3, ((1, 1), (1, 1), (0, 0)), "edge")
    own_HW3, mostly_HW = frame_HW3 - tone_HW3, np.zeros((H, W), bool)
    for dy, dx in np.ndindex(3, 3):
        other_HW3 = around[dy : dy + H, dx : dx + W] - tone_HW3
        share_HW = (own_HW3 * other_HW3).sum(-1) / np.square(other_HW3).sum(-1).clip(1)
        rest_HW = np.abs(own_HW3 - share_HW[..., None] * other_HW3).max(-1)
        mostly_HW |= (share_HW > 0) & (share_HW < mixed) & (rest_HW <= noise)
    return mostly_HW


def _parts_of_one_hue(
    frame_HW3: NDArray[np.float32], inside_HW: NDArray[np.bool_], same_hue: float = SAME_HUE
) -> NDArray[np.int64]:
    """Connected parts, each with a number above 0."""
    chroma_HW3 = frame_HW3 / (frame_HW3.sum(-1, keepdims=True) + 30)
    count = int(inside_HW.sum())
    number = np.zeros(inside_HW.shape, int)
    number[inside_HW] = np.arange(count)
    ends: tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]] = [], []
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        linked = inside_HW[a] & inside_HW[b]
        close = np.abs(chroma_HW3[a][linked] - chroma_HW3[b][linked]).max(-1) <= same_hue
        ends[0].append(number[a][linked][close])
        ends[1].append(number[b][linked][close])
    one, other = map(np.concatenate, ends)
    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(count, count))
    parts_N = connected_components(graph, directed=False)[1] + 1
    parts_N[np.bincount(parts_N)[parts_N] < MIN_PIXELS] = 0
    parts_HW = np.zeros(inside_HW.shape, int)
    parts_HW[inside_HW] = parts_N
    # Pixels of mixed colours between things go to the nearest part.
    return np.where(inside_HW, parts_HW[_nearest(parts_HW > 0)], 0) if parts_N.any() else parts_HW


def _nearest(found_HW: NDArray[np.bool_]) -> tuple[NDArray[np.int32], ...]:
    """Row and column of the nearest such pixel to each, both (H, W)."""
    return tuple(ndimage.distance_transform_edt(~found_HW, return_distances=False, return_indices=True))


def _split_by_hue(frame_HW3: NDArray[np.float32], parts_HW: NDArray[np.int64]) -> NDArray[np.int64]:
    """Parts whose inside has two hues are two things: pixels of mixed colours linked a block with its bowl."""
    chroma_HW3 = frame_HW3 / frame_HW3.sum(-1, keepdims=True).clip(60)  # the same on lit and on shaded faces
    found_HW = parts_HW.copy()
    for part in np.unique(parts_HW[parts_HW > 0]):
        its_HW = parts_HW == part
        inside_HW = its_HW & ~_border(its_HW)
        hues_N3 = chroma_HW3[inside_HW]
        few = len(hues_N3) // 10
        if few == 0:
            continue
        ends_N3 = hues_N3[hues_N3[:, np.ptp(hues_N3, axis=0).argmax()].argsort()]
        start_23 = np.stack([ends_N3[:few].mean(0), ends_N3[-few:].mean(0)])
        if np.ptp(start_23, axis=0).max() <= TWO_HUES:
            continue
        means_23, which_N = kmeans2(hues_N3, start_23, minit="matrix")
        if np.ptp(means_23, axis=0).max() > TWO_HUES and np.bincount(which_N, minlength=2).min() > few:
            second_HW = inside_HW.copy()
            second_HW[inside_HW] = which_N == 1
            found_HW[its_HW & second_HW[_nearest(inside_HW)]] = found_HW.max() + 1
    return found_HW
