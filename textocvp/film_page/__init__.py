"""Films for a browser: what a page needs to play rollouts, and one HTML file with everything in it.

`film.js` and `film.css` beside this file draw a film; `what_if.html` is the page that is sent to others.
"""

import base64
import io
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from textocvp.files import replace_text
from textocvp.rollout import Rollout

SEEN = 0.5  # presence of a slot from which on it is named
ALIKE = 30  # of 0..255 in each channel: colours that differ less are shown lighter and darker


def film_data(
    rollout: Rollout,
    words: Sequence[str] = (),
    names: Mapping[int, str] | None = None,
    *,
    row: int = 0,
    real: np.ndarray | None = None,
) -> dict[str, Any]:
    """One sequence of a rollout, for `film.js`; all of it can be written as JSON.

    Args:
        words: what the last axis of `Rollout.attention` stands for; without attention nothing is shown of them.
        names: of the slots that are to be listed; by default `slot_names`.
        row: which sequence.
        real: true frames (T', H, W, 3) uint8, shown beside the imagined ones, with their difference. If they end
            earlier than the rollout, the last one stays.

    Raises:
        ValueError: if the true frames have another size.
    """
    one = rollout.select(row)
    frames_THW3 = (one.frames[0].permute(0, 2, 3, 1).cpu().numpy() * 255).round().astype(np.uint8)
    T, H, W, _ = frames_THW3.shape
    colors_K3 = (one.colors[0, 0].cpu().numpy() * 255).round().astype(int)
    shown: dict[str, list[int]] = {}  # a thing may have several slots: all count as its first
    for slot, name in sorted((slot_names(one) if names is None else names).items()):
        shown.setdefault(name, []).append(slot)
    first_K = np.arange(len(colors_K3))
    for slots in shown.values():
        first_K[slots] = slots[0]
    film: dict[str, Any] = {
        "text": one.texts[0] if one.texts else "",
        "width": W,
        "height": H,
        "count": T,
        "frames": picture_url(frames_THW3.reshape(T * H, W, 3)),  # one below the other
        "runs": run_lengths(first_K[one.masks[0].argmax(1).cpu().numpy()]),
        "colors": told_apart(colors_K3, [slots[0] for _, slots in sorted(shown.items())]).tolist(),
        "slots": [{"slot": slots[0], "name": name} for name, slots in sorted(shown.items())],
    }
    if one.attention is not None and words:
        # Percent, the mean over layers, heads and slots of a thing; frame 0 was seen, and shows that of the first step.
        share_SKL = one.attention[0].mean((1, 2)).cpu().numpy()[..., : len(words)]
        for slots in shown.values():
            share_SKL[:, slots[0]] = share_SKL[:, slots].mean(1)
        percent_SKL = (100 * share_SKL).round().astype(int)
        film |= {"words": list(words), "attention": [percent_SKL[0].tolist(), *percent_SKL.tolist()]}
    if real is not None:
        if real.shape[1:] != frames_THW3.shape[1:]:
            raise ValueError(f"true frames are {real.shape[1:]}, imagined ones {frames_THW3.shape[1:]}")
        real_THW3 = real[np.minimum(np.arange(T), len(real) - 1)]
        apart_THW3 = np.abs(frames_THW3.astype(np.int16) - real_THW3).astype(np.uint8)
        film["real"], film["apart"] = (
            picture_url(pictures.reshape(T * H, W, 3)) for pictures in (real_THW3, apart_THW3)
        )
        film["apart_percent"] = (apart_THW3.mean((1, 2, 3)) / 2.55).round(1).tolist()
    return film


def told_apart(colors_K3: np.ndarray, listed: Sequence[int]) -> np.ndarray:
    """The colours (K, 3), those of listed slots that look like an earlier one in turns lighter and darker."""
    found_K3 = colors_K3.copy()
    for at, slot in enumerate(listed):
        alike = sum(int(np.abs(colors_K3[slot] - colors_K3[other]).max()) < ALIKE for other in listed[:at])
        if alike:
            found_K3[slot] = (colors_K3[slot] + (255 if alike % 2 else 0)) // 2
    return found_K3


def slot_names(rollout: Rollout) -> dict[int, str]:
    """What to call the slots (B = 1) that hold something in the first frame, when nobody has named them."""
    sizes_K = np.bincount(rollout.decode_masks([0])[0, 0].argmax(0).cpu().flatten().numpy())
    seen_K = rollout.presence[0, 0].cpu().numpy()
    names = {slot: f"slot {slot}" for slot in np.flatnonzero(sizes_K).tolist() if seen_K[slot] >= SEEN}
    return names | {int(sizes_K.argmax()): "table"}


def picture_url(picture_HW3: np.ndarray) -> str:
    """A picture (H, W, 3) uint8 as a PNG in a data URL."""
    buffer = io.BytesIO()
    Image.fromarray(picture_HW3).save(buffer, "PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def run_lengths(labels_THW: np.ndarray) -> list[int]:
    """Whole numbers as [number, how often, number, how often, ...], in the order of the array."""
    flat = labels_THW.ravel()
    starts = np.flatnonzero(np.diff(flat, prepend=flat[0] - 1))
    return np.stack([flat[starts], np.diff(starts, append=flat.size)], axis=1).ravel().tolist()


def asset(name: str) -> str:
    """A file beside this one."""
    return files("textocvp.film_page").joinpath(name).read_text(encoding="utf-8")


def with_films(page: str) -> str:
    """A page in which `/*film.css*/` and `/*film.js*/` stand for these files."""
    for name in ("film.css", "film.js"):
        page = page.replace(f"/*{name}*/", asset(name))
    return page


def save_page(path: Path, title: str, films: Sequence[Mapping[str, Any]]) -> Path:
    """Write one HTML page that shows films beside each other and needs nothing else; missing folders are made."""
    data = json.dumps({"title": title, "films": list(films)}).replace("<", "\\u003c")
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, with_films(asset("what_if.html")).replace("/*data*/", data))
    return path
