"""Checks of what a user asks of a model: frames, texts, horizon, and whether they go together.

Pictures can be sound and still be of another world than the model's. `OwnFrames` tells them apart.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from textocvp.slots import SlotLayout, SlotState
from textocvp.text.base import TextEncoder, WordBatch

# A picture is foreign where the squared error of its redrawing is four times that of the worst in a hundred of the
# model's own. For tabletop-small that is below 19.7 dB: 1 of 3,800 own frames is, and all 74 frames of another camera
# and of CLIPort, which reach 14.2 dB at most.
FOREIGN_DB = 6.0
# An own picture that is turned upside down is redrawn better by 0.9 dB at most (1,400 frames), a mirrored one by up to
# 5 dB: mirrored pictures cannot be told.
UPSIDE_DOWN_DB = 1.5
FLAT = 8  # values 0..255 that differ by no more are taken for equal
# A hue is a colour divided by its brightest channel, so that it stays the same in other light.
HUE_REACH = 0.04  # in each channel, of 0..1: what counts as of a hue
HUE_SHARE = 0.005  # of the pixels: what counts as showing a hue
# How far a thing is seen from the colour that names it, in the light that suits it best (RGB 0..1): at most .057 for
# 1,800 things in 300 scenes of the tabletop and of CLIPort. 96 % of the 1,500 colours that these lack are farther off.
ABSENT = 0.08
LIGHT = (0.7, 1.05)  # surfaces show their colour times the light on them
# Frames of a video differ from the next in at most 10 % of the pixels, two scenes in at least 32 % (66 pairs).
SAME_SCENE = 0.2
OTHER_CANVAS = 60  # of 0..255, by which the median pixel may differ where all held-out frames have the same
LEARNT_DB = 18.0  # of a parser's own world, on average; below it a picture that is redrawn badly tells nothing
DARK = 40  # of 0..255; a colour below it has no hue


class ForeignPictureWarning(UserWarning):
    """A picture does not look like those that the model was trained on."""


@dataclass(frozen=True)
class OwnFrames:
    """What a model makes of held-out first frames of its own world; `measure_own_frames` makes it."""

    count: int  # of frames
    psnr: float  # dB of the redrawn frames, their mean
    psnr_low: float  # dB that 99 of 100 reach
    # RRGGBB of a hue that 99 of 100 show and that is another where red and blue change places; empty for none
    hue: str = ""
    gray: bool = False  # whether some of them are gray
    canvas: str = ""  # RRGGBB of the median pixel, where it is the same in all of them; see `put_right`
    grain: float = 1.0  # share of neighbouring pixels that differ a little, which 99 of 100 stay below

    def __post_init__(self) -> None:
        for name in ("hue", "canvas"):
            value = getattr(self, name)
            if value and (len(value) != 6 or set(value) - set("0123456789abcdef")):
                raise ValueError(f"own_frames.{name} is {value!r}: must be six hexadecimal digits, as 6f4cff")


def observed_images(obs: Mapping[str, Any] | np.ndarray) -> np.ndarray:
    """The images (B, H, W, 3) of an observation: a mapping with `rgb`, an image (H, W, 3), or images.

    Raises:
        ValueError: if it is none of these.
    """
    if isinstance(obs, Mapping):
        if "rgb" not in obs:
            raise ValueError(f"the observation has no 'rgb'; it has {', '.join(map(repr, obs)) or 'nothing'}")
        if _are_one_scene(np.asarray(obs["rgb"]), obs.get("instruction")):
            raise ValueError(
                f"the observation's 'rgb' holds {len(obs['rgb'])} frames of one scene, as of a frame stack; give the "
                "last one, obs['rgb'][-1], or if they are scenes of their own the bare array obs['rgb']"
            )
        obs = obs["rgb"]
    images = np.asarray(obs)
    if images.ndim == 3:
        images = images[None]
    if images.ndim != 4:
        raise ValueError(f"the observation must be an image (H, W, 3) or images (B, H, W, 3), not {images.shape}")
    return images


def _are_one_scene(images: np.ndarray, instructions: Any) -> bool:
    """Whether images (B, H, W, 3) and their B sentences are those of one scene, a moment apart."""
    many = images.ndim == 4 and len(images) > 1 and not isinstance(instructions, str | None)
    if not many or len(set(map(str, instructions))) > 1:
        return False
    moved_BHW = np.abs(np.diff(images.astype(np.int16), axis=0)).max(-1) > FLAT
    return bool((moved_BHW.mean((1, 2)) < SAME_SCENE).all())


def times_larger(size: tuple[int, int], image_size: tuple[int, int]) -> int:
    """How many times larger pictures of `size` (H, W) are than `image_size`; 0 if no whole number of times."""
    times = size[0] // image_size[0]
    return times if size == (times * image_size[0], times * image_size[1]) else 0


def checked_frames(
    images: np.ndarray,
    image_size: tuple[int, int],
    device: torch.device,
    what: str = "the observation",
    *,
    multiples: bool = False,
) -> Tensor:
    """Images (N, H, W, 3) uint8 as frames (N, 3, H, W) in -1..1.

    Args:
        image_size: the (H, W) that the model was trained on.
        what: what messages call the images.
        multiples: whether they may also be a whole number of times larger.

    Raises:
        TypeError: if they are not uint8.
        ValueError: if the shape or size is another one, or the values cannot be those of a picture.
    """
    H, W = image_size
    if images.dtype != np.uint8:
        in_0_1 = images.dtype.kind == "f" and images.size and 0 <= images.min() <= images.max() <= 1
        hint = "; if its values are 0..255: image.round().astype(np.uint8)"
        hint = "; it looks like 0..1: (image * 255).round().astype(np.uint8)" if in_0_1 else hint
        hint = "; of 16 bits make 8: (image // 257).astype(np.uint8)" if images.dtype == np.uint16 else hint
        raise TypeError(f"{what} must be uint8 RGB with values 0..255, not {images.dtype}{hint}")
    if images.shape[-1] != 3 or images.shape[0] == 0:
        raise ValueError(f"{what} must be RGB with the three colours last, (..., {H}, {W}, 3), not {images.shape}")
    times = times_larger(images.shape[1:3], image_size)
    if times == 0 or (times > 1 and not multiples):
        allowed = (
            f"it takes that and whole multiples of it, such as {2 * H}x{2 * W}" if multiples else "it takes no other"
        )
        raise ValueError(
            f"{what} is {images.shape[1]}x{images.shape[2]} pixels; this model was trained on {H}x{W}, {allowed}: "
            "render or resize to that"
        )
    if images.max() == 1:
        raise ValueError(f"{what} has only the values 0 and 1: a 0..1 picture was cast to uint8 without * 255")
    frames_NHW3 = torch.from_numpy(np.array(images)).to(device)
    return frames_NHW3.permute(0, 3, 1, 2).float() / 127.5 - 1


def warn_of_foreign(
    frames_B3HW: Tensor, psnr_B: Tensor, own: OwnFrames, psnr_of: Callable[[Tensor], Tensor], *, depth: int
) -> None:
    """A `ForeignPictureWarning`, with the likely cause, for the first picture that is not of the model's world.

    Its words are the same for every picture of one cause, so that Python shows it once.

    Args:
        frames_B3HW: the pictures, in -1..1.
        psnr_B: of these redrawn, in dB.
        own: what is usual.
        psnr_of: redraws other pictures; it is asked only where one is redrawn badly.
        depth: stack level of the user's line, seen from the caller.
    """
    values_B3HW = ((frames_B3HW + 1) * 127.5).contiguous()  # for speed
    flat_B = (values_B3HW.amax((2, 3)) - values_B3HW.amin((2, 3))).amax(1) <= FLAT
    gray_B = are_gray(values_B3HW) & (not own.gray)
    swapped_B = torch.zeros_like(gray_B)
    if own.hue:
        hue_3 = from_hex(own.hue, values_B3HW) / 255
        now_B, other_B = hue_shares(values_B3HW, torch.stack([hue_3, hue_3.flip(0)])).unbind(1)
        swapped_B = (other_B >= HUE_SHARE) & (other_B >= 2 * now_B)
    other_B = torch.zeros_like(gray_B)
    if own.canvas:
        other_B = (canvas(values_B3HW) - from_hex(own.canvas, values_B3HW)).abs().amax(1) > OTHER_CANVAS
    poor_B = psnr_B < own.psnr_low
    for i in (flat_B | gray_B | swapped_B | other_B | poor_B).nonzero()[:, 0].tolist():
        if flat_B[i]:
            black = values_B3HW[i].max() <= FLAT
            cause = "is all of one colour" + (": black, as a 0..1 picture cast to uint8 is" if black else "")
        elif gray_B[i]:
            cause = "is gray, its three channels are equal"
        elif swapped_B[i]:
            cause = "has red and blue swapped (BGR): image[..., ::-1] swaps them back"
        elif own.psnr < LEARNT_DB:
            cause = f"is redrawn badly because all are: this parser has learnt too little ({own.psnr:.0f} dB)"
        elif not other_B[i] and _upside_down(frames_B3HW[i : i + 1], psnr_B[i], own, psnr_of):
            cause = "is upside down: image[::-1] turns it"
        elif other_B[i] or psnr_B[i] < own.psnr_low - FOREIGN_DB:
            cause = "shows another camera, scene or light"
        else:
            continue
        warnings.warn(
            f"the picture does not look like those that this model was trained on: it probably {cause}. "
            "What is imagined from it may mean nothing",
            ForeignPictureWarning,
            stacklevel=depth + 1,
        )
        return


def canvas(values_B3HW: Tensor) -> Tensor:
    """(B, 3) the median colour of pictures."""
    return values_B3HW.flatten(2).median(-1).values


def from_hex(color: str, like: Tensor) -> Tensor:
    """A colour of `OwnFrames`, RRGGBB, as (3,) numbers of 0..255 where `like` is."""
    return like.new_tensor(list(bytes.fromhex(color)))


def are_gray(values_B3HW: Tensor) -> Tensor:
    """(B,) whether pictures, 0..255, have three equal channels."""
    return (values_B3HW.amax(1) - values_B3HW.amin(1)).amax((1, 2)) <= FLAT


def hue_shares(values_B3HW: Tensor, hues_C3: Tensor) -> Tensor:
    """(B, C) which share of the pixels, 0..255, is of each of these hues, 0..1."""
    brightest_B1HW = values_B3HW.amax(1, keepdim=True)
    hue_B3HW = values_B3HW / brightest_B1HW.clamp_min(DARK)
    # Darker pixels have a largest channel below 1, and so are of no hue whose reach does not let them be.
    off_BCHW = torch.stack([(hue_B3HW - hue_3[:, None, None]).abs().amax(1) for hue_3 in hues_C3], 1)
    return (off_BCHW <= HUE_REACH).float().mean((2, 3))


def _upside_down(frame_13HW: Tensor, psnr: Tensor, own: OwnFrames, psnr_of: Callable[[Tensor], Tensor]) -> bool:
    """Whether a picture that is redrawn badly is redrawn as usual when it is turned."""
    turned = psnr_of(frame_13HW.flip(2))[0]
    return bool((turned >= psnr + UPSIDE_DOWN_DB) & (turned >= own.psnr_low - FOREIGN_DB))


def checked_texts(text: str | Sequence[str], encoder: TextEncoder, *, depth: int = 3) -> list[str]:
    """One sentence or several as a list.

    A word that the encoder does not know is a `UserWarning` that names it. So is a sentence that is like none that it
    was trained on, however it is reworded.

    Args:
        depth: stack level of the user's line, seen from the caller; the warning shows that line.

    Raises:
        TypeError: if one is no string.
        ValueError: if there is none, or an empty one, or one that denies something to a model that knows only wishes.
    """
    if isinstance(text, bytes | Mapping) or not isinstance(text, str | Iterable):
        raise TypeError(f"give one text, or a list of texts, and not {type(text).__name__}")
    texts = [text] if isinstance(text, str) else list(text)
    if not texts:
        raise ValueError("no text: give one sentence or several")
    for sentence in texts:
        if not isinstance(sentence, str):
            raise TypeError(f"a text must be a string, not {type(sentence).__name__}")
        if not sentence.strip():
            raise ValueError("an empty text: write what is to happen")
        if denied := encoder.negations(sentence):
            raise ValueError(
                f"{sentence!r} says {denied[0]!r}, which this model has never met: it would imagine what is not to "
                "be. Write what is to be done instead"
            )
        if not encoder.words(sentence):
            raise ValueError(encoder.nothing_said(sentence))
    unknown = list(dict.fromkeys(word for sentence in texts for word in encoder.unknown_words(sentence)))
    strange = [(sentence, forms) for sentence in texts if (forms := encoder.forms_but(sentence))]
    said = []
    if unknown:
        words = ", ".join(map(repr, unknown))
        said.append(f"the text encoder has never met {words}: the rollout is as if it were not there")
    if strange:
        (sentence, forms), more = strange[0], f" (and {len(strange) - 1} more)" if strange[1:] else ""
        known = " or ".join(map(repr, forms[:3])) + (" and others" if forms[3:] else "")
        said.append(
            f"{sentence!r}{more} is read as {encoder.reads(sentence)!r}, and the model was trained on {known}: what "
            "is imagined may be something else"
        )
    if said:
        warnings.warn(". ".join(said), UserWarning, stacklevel=depth + 1)
    return texts


def warn_of_absent(
    slots_BKD: Tensor, layout: SlotLayout, words: WordBatch, texts: Sequence[str], encoder: TextEncoder, *, depth: int
) -> None:
    """A `UserWarning` that names the first colour that no slot has, and the nearest ones that some have.

    Args:
        slots_BKD: of what is seen; one scene for all texts, or as many.
        depth: stack level of the user's line, seen from the caller.
    """
    if not layout.explicit or not words.names_color_BL.any():
        return
    state = SlotState.split(slots_BKD, layout)
    seen_B1K3, named_BL13 = (state.color[:, None] + 1) / 2, (words.colors_BL3[:, :, None] + 1) / 2
    light_BLK1 = (seen_B1K3 * named_BL13).sum(-1, keepdim=True) / named_BL13.square().sum(-1, keepdim=True)
    off_BLK = (seen_B1K3 - light_BLK1.clamp(*LIGHT) * named_BL13).norm(dim=-1)
    off_BLK = off_BLK.masked_fill(~state.is_thing[:, None, :, 0], torch.inf)
    absent_BL = words.names_color_BL & (off_BLK.amin(-1) > ABSENT)
    for b, position in absent_BL.nonzero().tolist():
        word, things = encoder.words(texts[b])[position], off_BLK[b, position].isfinite()
        slots_2 = off_BLK[b, position].argsort()[: min(2, int(things.sum()))]
        colors_23 = seen_B1K3[b if len(slots_BKD) > 1 else 0, 0, slots_2].cpu().tolist()
        names = dict.fromkeys(encoder.color_name(color) for color in colors_23)
        if word in names:  # in an odd light
            continue
        nearest = " and ".join(map(repr, names)) or "nothing"
        warnings.warn(
            f"nothing seen is {word!r}; the nearest is {nearest}. What is "
            f"imagined of {texts[b]!r} may be another thing's motion",
            UserWarning,
            stacklevel=depth + 1,
        )
        return


def checked_seed(seed: int) -> int:
    """A seed as a Python int; a ValueError unless it is a whole number that PyTorch takes."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**64:
        raise ValueError(f"seed must be a whole number from 0 to 2**64 - 1, not {seed!r}")
    return int(seed)


def checked_horizon(horizon: int, longest: int | None, hint: str = "") -> None:
    """Raise a ValueError, with a `hint`, unless `horizon` is a whole number from 1 to `longest`, if that is known."""
    if not isinstance(horizon, (int, np.integer)) or horizon < 1:
        raise ValueError(f"horizon must be a whole number of at least 1 frame, not {horizon!r}")
    if longest is not None and horizon > longest:
        raise ValueError(f"horizon {horizon} is longer than this model was trained for: at most {longest}{hint}")


def checked_pairs(scenes: int, sentences: int) -> int:
    """The number of sequences. There must be as many scenes as sentences, or one of either for all of the other.

    Raises:
        ValueError: if there are not.
    """
    if scenes != sentences and scenes != 1 and sentences != 1:
        raise ValueError(
            f"{scenes} scenes and {sentences} texts do not go together: give one scene, one text, or as many of each"
        )
    return max(scenes, sentences)
