"""Checks of what a user asks of a model: frames, texts, horizon, and whether they go together."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from textocvp.text.base import TextEncoder


def observed_images(obs: Mapping[str, Any] | np.ndarray) -> np.ndarray:
    """The images (B, H, W, 3) of an observation: a mapping with `rgb`, an image (H, W, 3), or images.

    Raises:
        ValueError: if it is none of these.
    """
    if isinstance(obs, Mapping):
        if "rgb" not in obs:
            raise ValueError(f"the observation has no 'rgb'; it has {', '.join(map(repr, obs)) or 'nothing'}")
        obs = obs["rgb"]
    images = np.asarray(obs)
    if images.ndim == 3:
        images = images[None]
    if images.ndim != 4:
        raise ValueError(
            f"the observation must be an image (H, W, 3) or images (B, H, W, 3), not {images.shape}"
        )
    return images


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
        hint = "; it looks like 0..1: (image * 255).round().astype(np.uint8)" if in_0_1 else ""
        raise TypeError(f"{what} must be uint8 RGB with values 0..255, not {images.dtype}{hint}")
    if images.shape[-1] != 3 or images.shape[0] == 0:
        raise ValueError(
            f"{what} must be RGB with the three colours last, (..., {H}, {W}, 3), not {images.shape}"
        )
    times = times_larger(images.shape[1:3], image_size)
    if times == 0 or (times > 1 and not multiples):
        allowed = (
            f"it takes that and whole multiples of it, such as {2 * H}x{2 * W}"
            if multiples
            else "it takes no other"
        )
        raise ValueError(
            f"{what} is {images.shape[1]}x{images.shape[2]} pixels; this model was trained on {H}x{W}, {allowed}: "
            "render or resize to that"
        )
    if images.max() == 1:
        raise ValueError(
            f"{what} has only the values 0 and 1: a 0..1 picture was cast to uint8 without * 255"
        )
    frames_NHW3 = torch.from_numpy(np.array(images)).to(device)
    return frames_NHW3.permute(0, 3, 1, 2).float() / 127.5 - 1


def checked_texts(text: str | Sequence[str], encoder: TextEncoder, *, depth: int = 3) -> list[str]:
    """One sentence or several as a list. A word that the encoder does not know is a `UserWarning` that names it.

    Args:
        depth: stack level of the user's line, seen from the caller; the warning shows that line.

    Raises:
        TypeError: if one is no string.
        ValueError: if there is none, or an empty one.
    """
    texts = [text] if isinstance(text, str) else list(text)
    if not texts:
        raise ValueError("no text: give one sentence or several")
    for sentence in texts:
        if not isinstance(sentence, str):
            raise TypeError(f"a text must be a string, not {type(sentence).__name__}")
        if not sentence.strip():
            raise ValueError("an empty text; write what is to be done: 'put the red block in the blue bowl'")
    unknown = list(dict.fromkeys(word for sentence in texts for word in encoder.unknown_words(sentence)))
    if unknown:
        words = ", ".join(map(repr, unknown))
        warnings.warn(
            f"the text encoder has never met {words}: the rollout may be as if it were not there",
            UserWarning,
            stacklevel=depth + 1,
        )
    return texts


def checked_horizon(horizon: int, longest: int | None, hint: str = "") -> None:
    """Raise a ValueError, with a `hint`, unless `horizon` is a whole number from 1 to `longest`, if that is known."""
    if not isinstance(horizon, (int, np.integer)) or horizon < 1:
        raise ValueError(f"horizon must be a whole number of at least 1 frame, not {horizon!r}")
    if longest is not None and horizon > longest:
        raise ValueError(
            f"horizon {horizon} is longer than this model was trained for: at most {longest}{hint}"
        )


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
