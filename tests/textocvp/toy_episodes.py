"""Episode files without a simulator: coloured squares, one of which is carried to another."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from textocvp.data.episodes import FORMAT, FORMAT_VERSION

COLORS = {"red": (255, 87, 89), "blue": (78, 121, 167), "green": (89, 169, 79), "yellow": (237, 201, 72)}
ARM = (90, 60, 210)
CORNERS = np.array([[3, 3], [3, 18], [18, 3], [18, 18]])


def write_toy_episodes(path: Path, lengths: list[int], seed: int = 0) -> Path:
    """Write 32x32 episodes: two blocks, two bowls, an arm that carries the first block to the first bowl."""
    rng = np.random.default_rng(seed)
    frames, segmentation, objects, instructions = [], [], [], []
    for length in lengths:
        names = [str(name) for name in rng.permutation(list(COLORS))]
        places = CORNERS[rng.permutation(4)] + rng.integers(0, 3, size=(4, 2))
        kinds = ["block", "block", "bowl", "bowl"]
        objects.append([{"kind": kind, "color": color} for kind, color in zip(kinds, names, strict=True)])
        instructions.append(f"put the {names[0]} block in the {names[2]} bowl")
        for t in range(length):
            labels = np.zeros((32, 32), np.uint8)
            moved = places[0] + (places[2] - places[0]) * min(1.0, t / (length - 2))
            for label, (y, x), side in [
                (4, places[2], 9),
                (5, places[3], 9),
                (2, moved, 6),
                (3, places[1], 6),
            ]:
                labels[int(y) : int(y) + side, int(x) : int(x) + side] = label
            labels[int(moved[0]) : int(moved[0]) + 3, int(moved[1]) : int(moved[1]) + 3] = 1
            palette = np.array([(47, 47, 47), ARM, *(COLORS[name] for name in names)], np.uint8)
            frames.append(palette[labels])
            segmentation.append(labels)
    with h5py.File(path, "w") as file:
        file.attrs.update(format=FORMAT, format_version=FORMAT_VERSION, split="toy", config="{}")
        file["frames"], file["segmentation"] = np.stack(frames), np.stack(segmentation)
        file["episode/start"] = np.cumsum([0, *lengths[:-1]])
        file["episode/length"] = np.array(lengths)
        file["episode/seed"] = np.arange(len(lengths)) + 1000 * seed
        file["episode/success"] = np.ones(len(lengths), bool)
        file["episode/target"] = np.tile([0, 2], (len(lengths), 1))
        text = h5py.string_dtype()
        file.create_dataset("episode/instruction", data=instructions, dtype=text)
        file.create_dataset("episode/objects", data=[json.dumps(item) for item in objects], dtype=text)
    return path
