"""Picture files as a model takes them. What has to be changed for that is changed and said."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from textocvp.inputs import times_larger


def read_picture(
    path: Path | BinaryIO, image_size: tuple[int, int] | None, *, resize: bool = False, crop: bool = False
) -> tuple[NDArray[np.uint8], list[str]]:
    """A picture file as RGB (H, W, 3), 0..255, and what was done to it, in words.

    The orientation tag is obeyed, 16 bits become 8, transparency becomes white, gray becomes RGB.

    Args:
        image_size: (H, W) of the model's frames; None takes any, as it is.
        resize: bring it to that size, with a border where its shape is another.
        crop: bring it to that size, cut off at two sides where its shape is another.

    Raises:
        FileNotFoundError, PIL.UnidentifiedImageError, OSError: if it cannot be read.
        ValueError: if its size is no whole multiple of `image_size`, and it may be neither resized nor cropped.
    """
    said: list[str] = []
    with Image.open(path) as file:
        if (count := getattr(file, "n_frames", 1)) > 1:
            said.append(f"took the first of its {count} frames")
        if file.getexif().get(ExifTags.Base.Orientation, 1) != 1:
            said.append("turned it as its orientation tag says")
        picture = _eight_bits(ImageOps.exif_transpose(file), said)
    if image_size is None:
        return np.asarray(picture), said
    H, W = image_size
    if resize or crop:
        whole, how = bring_to_size(np.asarray(picture)[None], image_size, crop)
        return whole[0], said + how
    if times_larger((picture.height, picture.width), image_size) == 0:
        raise ValueError(
            f"it is {picture.width}x{picture.height} pixels and the model was trained on {W}x{H}: take the picture at "
            "that size or a whole multiple of it, or add --resize (with a border) or --crop (without its edges)"
        )
    return np.asarray(picture), said


def bring_to_size(
    frames_T: NDArray[np.uint8], image_size: tuple[int, int], crop: bool = False
) -> tuple[NDArray[np.uint8], list[str]]:
    """Frames (T, h, w, 3) at another size (T, H, W, 3), and what was done, in words; nothing if they have that size.

    The border, where the shape is another and nothing is cut off, has the colour of the first frame's edge.
    """
    (H, W), (h, w) = image_size, frames_T.shape[1:3]
    if (h, w) == (H, W):
        return frames_T, []
    how = ("cut off its edges and " if crop else "added a border and ") if w * H != W * h else ""
    color = tuple(int(value) for value in np.median(_edge(frames_T[0]), axis=0))
    taken = []
    for frame in map(Image.fromarray, frames_T):
        if crop:
            taken.append(ImageOps.fit(frame, (W, H), Image.Resampling.BOX))
        else:
            taken.append(ImageOps.pad(frame, (W, H), Image.Resampling.BOX, color=color))
    return np.stack([np.asarray(frame) for frame in taken]), [f"{how}brought it from {w}x{h} to {W}x{H} pixels"]


def _eight_bits(picture: Image.Image, said: list[str]) -> Image.Image:
    """As RGB with 8 bits a channel."""
    if picture.mode.startswith(("I", "F")):
        values = np.asarray(picture, dtype=np.float64)
        most = 255.0 if values.max() <= 255 else 65535.0
        if picture.mode == "F" and values.max() <= 1:
            most = 1.0
        picture = Image.fromarray((values.clip(0, most) * (255 / most)).round().astype(np.uint8))
        said.append("brought it to 8 bits a channel")
    if picture.has_transparency_data:
        whole = picture.convert("RGBA")
        if np.asarray(whole)[..., 3].min() < 255:
            said.append("put white behind what is transparent")
        return Image.alpha_composite(Image.new("RGBA", whole.size, "white"), whole).convert("RGB")
    if picture.mode in ("1", "L"):
        said.append("took its gray for all three colours, which says nothing of what is red or blue")
    return picture.convert("RGB")


def _edge(values_HW3: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The pixels (N, 3) at the edge of a picture, for a border that stands out little."""
    return np.concatenate([values_HW3[0], values_HW3[-1], values_HW3[:, 0], values_HW3[:, -1]])
