"""Every episode parsed once: the training data of the predictor.

Stage 2 freezes the parser, so its slots never change and need not be computed again at every step. The cache
is one HDF5 file: `slots` (N, K, D) float16, all frames of all episodes one after another; `starts` (E + 1)
where each episode begins; `instructions` (E). It remembers which parser and which episodes it was made from,
and is refused for others."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from textocvp.parsers.base import to_frames

if TYPE_CHECKING:
    from textocvp.data.episodes import EpisodeFile
    from textocvp.model import TextOCVP


PART = 64  # episodes a part: what is lost at most when parsing is killed


class SlotCacheError(ValueError):
    """A slot cache belongs to another parser or other episodes, or is damaged; the message says which."""


@dataclass
class SlotCache:
    """A slot cache in memory.

    Attributes:
        slots_NKD: float16.
        starts: (E + 1,) first frame of each episode, and N.
        instructions: one sentence an episode.
        parser: fingerprint of the parser that found the slots.
        episodes: fingerprint of the episodes that were parsed.
    """

    slots_NKD: np.ndarray
    starts: np.ndarray
    instructions: list[str]
    parser: str
    episodes: str

    def __len__(self) -> int:
        return len(self.instructions)

    @property
    def lengths(self) -> np.ndarray:
        """Frames of each episode (E,)."""
        return np.diff(self.starts)

    def episode(self, index: int) -> Tensor:
        """The slots (T, K, D) float32 of one episode."""
        return torch.from_numpy(
            self.slots_NKD[self.starts[index] : self.starts[index + 1]].astype(np.float32)
        )

    def padded(self, frames: int) -> Tensor:
        """All episodes at one length (E, T, K, D) float16: the last frame repeated, or cut."""
        within = np.minimum(np.arange(frames)[None], self.lengths[:, None] - 1)
        return torch.from_numpy(self.slots_NKD[self.starts[:-1, None] + within])

    def save(self, path: Path) -> None:
        """Write one HDF5 file; killed at any moment, either the whole file is there or none."""
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(path.name + ".new")
        with h5py.File(unfinished, "w") as file:
            rows = max(1, min(256, len(self.slots_NKD)))
            file.create_dataset("slots", data=self.slots_NKD, chunks=(rows, *self.slots_NKD.shape[1:]))
            file["starts"] = self.starts
            file.create_dataset("instructions", data=self.instructions, dtype=h5py.string_dtype())
            file.attrs["parser"], file.attrs["episodes"] = self.parser, self.episodes
        unfinished.replace(path)

    @classmethod
    def load(cls, path: Path) -> SlotCache:
        """Read a file that `save` wrote.

        Raises:
            SlotCacheError: if it is no slot cache.
        """
        try:
            with h5py.File(path, "r") as file:
                instructions = [text.decode() for text in file["instructions"][:]]
                parser, episodes = str(file.attrs["parser"]), str(file.attrs["episodes"])
                return cls(file["slots"][:], file["starts"][:], instructions, parser, episodes)
        except (KeyError, OSError) as error:
            raise SlotCacheError(f"{path} is no slot cache, or damaged: {error}") from error


def parser_fingerprint(model: TextOCVP) -> str:
    """A hash of the parser's configuration and weights; of a frozen encoder's weights, their fingerprint."""
    settings = model.config.to_dict()["parser"]
    settings.pop("encoder_weights", None)  # where they were found, not what they are
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for name, tensor in sorted(model.parser.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def episodes_fingerprint(episodes: EpisodeFile) -> str:
    """A hash of what an episode file holds: its scenes and how they were collected."""
    digest = hashlib.sha256(str(episodes.attribute("config")).encode())
    for array in (episodes.seeds, episodes.lengths):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update("\n".join(episodes.instructions).encode())
    return digest.hexdigest()


def cached_slots(model: TextOCVP, episodes: EpisodeFile, path: Path, *, batch: int = 16) -> SlotCache:
    """The slots of all episodes: read from `path` if they are there, else parsed and written there.

    Parsing shows its progress and goes on where it was killed (finished parts wait in a folder beside
    `path`).

    Raises:
        SlotCacheError: if `path` holds the slots of another parser or of other episodes.
    """
    if path.exists():
        return _checked(SlotCache.load(path), path, parser_fingerprint(model), episodes_fingerprint(episodes))
    whole = _joined(_parts(model, episodes, path, 0, 1, batch))
    whole.save(path)
    shutil.rmtree(_folder(path))
    return whole


def parse_share(
    model: TextOCVP, episodes: EpisodeFile, path: Path, process: int, processes: int, *, batch: int = 16
) -> None:
    """Parse every `processes`-th part, from part number `process` on, for one of them to join with `cached_slots`.

    Raises:
        SlotCacheError: as `cached_slots`.
    """
    if processes > 1 and not path.exists():
        _parts(model, episodes, path, process, processes, batch)


def _folder(path: Path) -> Path:
    return path.with_name(path.name + ".parts")


def _parts(
    model: TextOCVP, episodes: EpisodeFile, path: Path, process: int, processes: int, batch: int
) -> list[SlotCache]:
    """The parts that are this process's, each read if it is there, else parsed and written."""
    parser, source = parser_fingerprint(model), episodes_fingerprint(episodes)
    firsts = range(0, len(episodes), PART)[process::processes]
    parts = []
    with tqdm(total=len(firsts), desc=f"parsing {path.stem}", unit="part", disable=process > 0) as bar:
        for first in firsts:
            part_path = _folder(path) / f"{first:06d}.h5"
            if part_path.exists():
                part = _checked(SlotCache.load(part_path), part_path, parser, source)
            else:
                chosen = range(first, min(first + PART, len(episodes)))
                part = _parse(model, episodes, chosen, parser, source, batch)
                part.save(part_path)
            parts.append(part)
            bar.update()
    return parts


@torch.no_grad()
def _parse(
    model: TextOCVP, episodes: EpisodeFile, chosen: range, parser: str, source: str, batch: int
) -> SlotCache:
    slots, lengths, instructions = [], [], []
    for first in range(chosen.start, chosen.stop, batch):
        numbers = range(first, min(first + batch, chosen.stop))
        read = episodes.frames(numbers)
        longest = max(map(len, read))
        # Parsing is causal: repeating the last frame of the shorter episodes changes nothing before it.
        padded = [clip[np.minimum(np.arange(longest), len(clip) - 1)] for clip in read]
        frames = to_frames(np.stack(padded), model.device)
        # Initialisers that draw at random draw the same again for the same episodes.
        generator = torch.Generator(model.device).manual_seed(first)
        found = model.parser(frames, generator=generator).slots_BTKD.half().cpu().numpy()
        for number, clip, slots_TKD in zip(numbers, read, found, strict=True):
            slots.append(slots_TKD[: len(clip)])
            lengths.append(len(clip))
            instructions.append(episodes.instructions[number])
    starts = np.concatenate([[0], np.cumsum(lengths)])
    return SlotCache(np.concatenate(slots), starts, instructions, parser, source)


def _joined(parts: list[SlotCache]) -> SlotCache:
    lengths = np.concatenate([part.lengths for part in parts])
    return SlotCache(
        np.concatenate([part.slots_NKD for part in parts]),
        np.concatenate([[0], np.cumsum(lengths)]),
        [text for part in parts for text in part.instructions],
        parts[0].parser,
        parts[0].episodes,
    )


def _checked(cache: SlotCache, path: Path, parser: str, source: str) -> SlotCache:
    for what, has, wanted in (("parser", cache.parser, parser), ("episodes", cache.episodes, source)):
        if has != wanted:
            raise SlotCacheError(
                f"{path} holds the slots of another {what} ({has[:12]}, wanted {wanted[:12]}): delete it, or "
                "train into another folder"
            )
    return cache
