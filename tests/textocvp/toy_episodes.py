"""Episode files without a simulator: coloured squares, one of which is carried to another."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np

from textocvp.data.episodes import FORMAT

COLORS = {"red": (255, 87, 89), "blue": (78, 121, 167), "green": (89, 169, 79), "yellow": (237, 201, 72)}
ARM = (90, 60, 210)
CORNERS = np.array([[3, 3], [3, 18], [18, 3], [18, 18]])
KINDS = ("block", "block", "bowl", "bowl")


def sentence(block: str, bowl: str) -> str:
    return f"put the {block} block in the {bowl} bowl"


def write_toy_episodes(path: Path, lengths: list[int], seed: int = 0, *, version: int = 2, truth: bool = True) -> Path:
    """Write 32x32 episodes: two blocks, two bowls, an arm that carries the first block to the first bowl.

    Without `truth` there are only frames and sentences.
    """
    rng = np.random.default_rng(seed)
    frames, segmentation, objects, instructions, questions = [], [], [], [], []
    for length in lengths:
        names = [str(name) for name in rng.permutation(list(COLORS))]
        places = CORNERS[rng.permutation(4)] + rng.integers(0, 3, size=(4, 2))
        items = [{"kind": kind, "color": color} for kind, color in zip(KINDS, names, strict=True)]
        if version == 2:
            items = [{"id": id, "label": 2 + id, **item} for id, item in enumerate(items)]
        objects.append(items)
        instructions.append(sentence(names[0], names[2]))
        questions.append(
            [{"text": sentence(names[a], names[b]), "moves": a, "ends_at": b} for a in (0, 1) for b in (2, 3)]
        )
        for t in range(length):
            labels = np.zeros((32, 32), np.uint8)
            moved = places[0] + (places[2] - places[0]) * min(1.0, t / (length - 2))
            for label, (y, x), side in [(4, places[2], 9), (5, places[3], 9), (2, moved, 6), (3, places[1], 6)]:
                labels[int(y) : int(y) + side, int(x) : int(x) + side] = label
            labels[int(moved[0]) : int(moved[0]) + 3, int(moved[1]) : int(moved[1]) + 3] = 1
            palette = np.array([(47, 47, 47), ARM, *(COLORS[name] for name in names)], np.uint8)
            frames.append(palette[labels])
            segmentation.append(labels)
    text = h5py.string_dtype()
    with h5py.File(path, "w") as file:
        file.attrs.update(format=FORMAT, format_version=version)
        file["frames"] = np.stack(frames)
        file["episode/start"] = np.cumsum([0, *lengths[:-1]])
        file["episode/length"] = np.array(lengths)
        file.create_dataset("episode/instruction", data=instructions, dtype=text)
        if not truth:
            return path
        file.attrs.update(split="toy", config="{}")
        file["segmentation"] = np.stack(segmentation)
        file["episode/seed"] = np.arange(len(lengths)) + 1000 * seed
        file["episode/success"] = np.ones(len(lengths), bool)
        file.create_dataset("episode/objects", data=list(map(json.dumps, objects)), dtype=text)
        if version == 1:
            file["episode/target"] = np.tile([0, 2], (len(lengths), 1))
        else:
            file.attrs["labels"] = json.dumps({"background": 0, "robot": 1})
            file.attrs["vocabulary"] = json.dumps(["put", "the", "block", "in", "bowl", *COLORS])
            file.create_dataset("episode/questions", data=list(map(json.dumps, questions)), dtype=text)
    return path
