"""The world model as users meet it: from an observation and a sentence to a `Rollout`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from textocvp.checkpoint import DEFAULT_CHECKPOINT, Checkpoint, bundled_checkpoints, resolve_checkpoint
from textocvp.inputs import (
    ForeignPictureWarning,
    checked_frames,
    checked_horizon,
    checked_pairs,
    checked_seed,
    checked_texts,
    observed_images,
    times_larger,
    warn_of_absent,
    warn_of_foreign,
)
from textocvp.metrics.frames import psnr
from textocvp.model import TextOCVP
from textocvp.pictures.put_right import put_right
from textocvp.predictors.base import SlotPredictor
from textocvp.rollout import CHUNK, Rollout

__all__ = ["DEFAULT_CHECKPOINT", "Checkpoint", "WorldModel", "bundled_checkpoints"]


class WorldModel:
    """Imagines what happens to a scene when a sentence is carried out."""

    def __init__(self, model: TextOCVP, checkpoint: Checkpoint | None = None) -> None:
        self.model = model.eval()
        self.checkpoint = checkpoint or Checkpoint(model.config.name)

    @classmethod
    def from_pretrained(
        cls, name_or_folder_or_hub_id: str | Path = DEFAULT_CHECKPOINT, device: str | torch.device = "cpu"
    ) -> WorldModel:
        """Load a checkpoint.

        Args:
            name_or_folder_or_hub_id: a bundled name (`bundled_checkpoints()`), else a folder, else the id `owner/name`
                of a repository on the Hugging Face hub.
            device: where the model computes.

        Raises:
            CheckpointError: if there is no such checkpoint (the message lists the bundled ones), or it is damaged.
        """
        name = str(name_or_folder_or_hub_id)
        with resolve_checkpoint(name) as folder:
            return cls(TextOCVP.from_pretrained(folder, device=device), Checkpoint.of(folder, name))

    def __repr__(self) -> str:
        config = self.model.config
        million = sum(p.numel() for p in self.model.parameters()) / 1e6
        H, W = self.image_size
        ahead = f"up to {self.longest_horizon}" if self.longest_horizon else "any number of"
        return (
            f"WorldModel({self.checkpoint.name!r}, {million:.1f} M parameters, {H}x{W} frames, "
            f"{config.parser.num_slots} slots, {ahead} frames ahead, on {self.model.device})"
        )

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) of the frames that it was trained on, in pixels; it also takes whole multiples of that."""
        side = self.model.config.parser.image_size
        return side, side

    @property
    def longest_horizon(self) -> int | None:
        """How many frames it can imagine at once; None for any number (the published moving window)."""
        predictor = self.model.config.predictor
        return predictor.window if predictor.causal else None

    @torch.no_grad()
    def rollout(
        self,
        obs: Mapping[str, Any] | np.ndarray | Rollout,
        text: str | Sequence[str],
        *,
        horizon: int | None = None,
        seed: int = 0,
        num_slots: int | None = None,
        attention: bool = False,
    ) -> Rollout:
        """Imagine the next `horizon` frames.

        One scene and n texts give n sequences, and the scene is parsed once. n scenes and n texts go together
        pairwise. n scenes and one text all get that text.

        Args:
            obs: what is seen now: the environment's observation (a mapping with `rgb`), an image (H, W, 3) or images
                (B, H, W, 3), uint8, of `image_size` or a whole multiple of it. Or a rollout, to go on from its last
                slots; what is drawn with the first frame in mind still is.
            text: what is to be done.
            horizon: how many frames to imagine after the one that is seen; by default `longest_horizon`, or 24 if there
                is none.
            seed: of the initial slots, where they are drawn at random: a whole number from 0 to 2**64 - 1. The same
                seed gives a scene the same rollout, alone and among others.
            num_slots: how many slots to look for in an image, background included. The configured number by default;
                more for scenes of more things than the model was trained with.
            attention: also keep the attention from slots to words.

        Returns:
            A rollout of `horizon + 1` frames, the first of which is the parsed observation. It is of the model's own
            `image_size`, or, if the renderer remembers first frames (`carry`), of theirs.

        Raises:
            TypeError: if the observation is none of the above or not uint8, or a text is no string.
            ValueError: if a shape, value or size, the horizon or a text is not allowed; the message says what is.

        Warns:
            UserWarning: if the text encoder does not know a word, which is named, or if the predictor is untrained.
            ForeignPictureWarning: a UserWarning, if the observation does not look like the pictures that the model was
                trained on; the likely cause is named.
        """
        if self.model.config.stage == "parser":
            only = "has been through the first stage of training only: it can parse, but what it imagines is noise"
            warnings.warn(f"{self.checkpoint.name} {only}", UserWarning, stacklevel=3)
        horizon = horizon if horizon is not None else self.longest_horizon or 24
        return self._imagined(self.model.predictor, obs, text, horizon, seed, num_slots, attention)

    @property
    def foresees(self) -> bool:
        """Whether the model has a predictor of whole sentences, so that it can `outcome`."""
        return self.model.outcome is not None

    @torch.no_grad()
    def outcome(
        self,
        obs: Mapping[str, Any] | np.ndarray | Rollout,
        text: str | Sequence[str],
        *,
        seed: int = 0,
        num_slots: int | None = None,
    ) -> Rollout:
        """Imagine at once where a sentence leads, without the way there. Arguments and errors as `rollout`.

        Returns:
            A rollout of two frames: the parsed observation, and how it looks when the sentence has been carried out.

        Raises:
            NotImplementedError: if the model has no predictor of whole sentences.
        """
        if self.model.outcome is None:
            raise NotImplementedError(
                f"{self.checkpoint.name} cannot foresee outcomes in one step; "
                "`textocvp train predictor --outcome` teaches it"
            )
        return self._imagined(self.model.outcome, obs, text, 1, seed, num_slots)

    def _imagined(
        self,
        predictor: SlotPredictor,
        obs: Mapping[str, Any] | np.ndarray | Rollout,
        text: str | Sequence[str],
        horizon: int,
        seed: int,
        num_slots: int | None,
        attention: bool = False,
    ) -> Rollout:
        """`rollout` with one of the model's predictors."""
        texts = checked_texts(text, self.model.text, depth=4)
        hint = ". To see further, go on from where a rollout ended: rollout(previous_rollout, text)"
        checked_horizon(horizon, predictor.config.window if predictor.config.causal else None, hint)
        start = self._start(obs, seed, num_slots)
        B = checked_pairs(len(start), len(texts))
        texts = texts * B if len(texts) == 1 else texts
        seed_B1KD = start.slots[:, -1:].to(self.model.device).expand(B, -1, -1, -1)
        words = self.model.text.lookup(texts)
        # Only of what is seen, not imagined; too few slots do not show everything.
        if not start.texts and start.slots.shape[2] >= self.model.config.parser.num_slots:
            seen_BKD, layout = start.slots[:, -1].to(self.model.device), start.layout
            warn_of_absent(seen_BKD, layout, words, texts, self.model.text, depth=4)
        tokens = self.model.text.encode(words)
        imagined = predictor.rollout(seed_B1KD, tokens, horizon, return_attention=attention)
        slots_BTKD = torch.cat([seed_B1KD, imagined.slots_BSKD], dim=1).float()
        seen = start.seen * B if start.seen is not None and len(start) == 1 else start.seen
        attention_BSnhKL = imagined.attention_BSnhKL
        size, layout, renderer = start.image_size, self.model.parser.layout, self.model.renderer
        return Rollout(slots_BTKD, tuple(texts), size, layout, renderer, attention_BSnhKL, seen)

    def imagine(
        self,
        obs: Mapping[str, Any] | np.ndarray,
        text: str | Sequence[str],
        *,
        horizon: int,
        seed: int = 0,
        num_slots: int | None = None,
    ) -> Tensor:
        """Only the frames (B, horizon + 1, 3, H, W) of `rollout`, as every `VideoModel` gives them."""
        return self.rollout(obs, text, horizon=horizon, seed=seed, num_slots=num_slots).frames

    @torch.no_grad()
    def parse(self, video: np.ndarray, *, seed: int = 0, num_slots: int | None = None) -> Rollout:
        """The slots of true frames: what a perfect prediction would be.

        Args:
            video: (T, H, W, 3) or (B, T, H, W, 3) uint8.
            seed, num_slots: as in `rollout`.

        Raises:
            TypeError, ValueError: as `rollout`.

        Warns:
            ForeignPictureWarning: if a first frame does not look like the pictures that the model was trained on.
        """
        frames = np.asarray(video)
        if frames.ndim not in (4, 5):
            raise ValueError(f"video must be (T, H, W, 3) or (B, T, H, W, 3), not {frames.shape}")
        B, T = frames.shape[:-3] if frames.ndim == 5 else (1, len(frames))
        images = frames.reshape(-1, *frames.shape[-3:])
        frames_N3HW = checked_frames(images, self.image_size, self.model.device, "video", multiples=True)
        frames_BT3HW = self._put_right(frames_N3HW.unflatten(0, (B, T)), depth=3)
        parsed = self._parsed(frames_BT3HW, seed, num_slots)
        self._warn_of_foreign(frames_BT3HW[:, 0], parsed, seed, num_slots, depth=3)
        return parsed

    def words(self, text: str) -> list[str]:
        """A sentence as the text encoder splits it: what the last axis of `Rollout.attention` stands for."""
        if not isinstance(text, str):
            raise TypeError(f"a text must be a string, not {type(text).__name__}")
        return self.model.text.words(text)

    def reads(self, text: str) -> str:
        """What the model understands: a sentence in the wording that it was trained on, without unknown words.

        Raises:
            TypeError, ValueError: as `rollout`.
        """
        (text,) = checked_texts(text, self.model.text, depth=2)
        return self.model.text.reads(text)

    def _parsed(self, frames_BT3HW: Tensor, seed: int, num_slots: int | None) -> Rollout:
        if num_slots is not None and (not isinstance(num_slots, (int, np.integer)) or num_slots < 1):
            raise ValueError(f"num_slots must be a whole number of at least 1 slot, not {num_slots!r}")
        model = self.model
        # One for each scene: where it stands in a batch must not matter.
        seed = checked_seed(seed)
        generators = [torch.Generator(device=model.device).manual_seed(seed) for _ in frames_BT3HW]
        parsed = model.parser(self._at_own_size(frames_BT3HW), num_slots=num_slots, generator=generators)
        slots_BTKD = parsed.slots_BTKD.float()
        seen = model.renderer.remember(frames_BT3HW[:, 0], parsed.attention_BTKHW[:, 0], slots_BTKD[:, 0])
        size = self.image_size
        if seen is not None:
            size = (seen[0].frame_3HW.shape[-2], seen[0].frame_3HW.shape[-1])
        return Rollout(slots_BTKD, (), size, model.parser.layout, model.renderer, seen=seen)

    def _start(self, obs: Mapping[str, Any] | np.ndarray | Rollout, seed: int, num_slots: int | None) -> Rollout:
        if isinstance(obs, Rollout):
            own = obs.slots.shape[2]
            if num_slots not in (None, own):
                raise ValueError(f"this rollout goes on with its own {own} slots; num_slots={num_slots} is for images")
            larger = obs.seen is not None and times_larger(obs.image_size, self.image_size) > 0
            if obs.layout != self.model.parser.layout or not (larger or obs.image_size == self.image_size):
                raise ValueError(
                    f"this rollout was made by another model: its slots are {obs.layout} at {obs.image_size} "
                    f"pixels, this model's are {self.model.parser.layout} at {self.image_size}"
                )
            return obs
        frames_B3HW = checked_frames(observed_images(obs), self.image_size, self.model.device, multiples=True)
        frames_B3HW = self._put_right(frames_B3HW[:, None], depth=5)[:, 0]
        parsed = self._parsed(frames_B3HW[:, None], seed, num_slots)
        self._warn_of_foreign(frames_B3HW, parsed, seed, num_slots, depth=5)
        return parsed

    def _put_right(self, frames_BT3HW: Tensor, depth: int) -> Tensor:
        """Videos in the light of the model's own world; a `ForeignPictureWarning` where that had to be changed."""
        own = self.model.config.own_frames
        if own is None:
            return frames_BT3HW
        if frames_BT3HW.shape[-2:] != self.image_size:
            if self.model.renderer.keeps_size:
                return frames_BT3HW
            frames_BT3HW = self._at_own_size(frames_BT3HW)
        frames_BT3HW, done = put_right(frames_BT3HW, own, self.model.restorer)
        if done:
            said = f"the picture does not look like those that this model was trained on: it is {', and '.join(done)}"
            warnings.warn(said, ForeignPictureWarning, stacklevel=depth + 1)
        return frames_BT3HW

    def _warn_of_foreign(
        self, frames_B3HW: Tensor, parsed: Rollout, seed: int, num_slots: int | None, depth: int
    ) -> None:
        """Redraw the pictures that a rollout begins with, and warn where they are not of the model's world."""
        own = self.model.config.own_frames
        if own is None or parsed.slots.shape[2] < self.model.config.parser.num_slots:
            return  # too few slots redraw nothing well

        def psnr_of(frames_B3HW: Tensor, slots_BKD: Tensor | None = None) -> Tensor:
            if slots_BKD is None:
                slots_BKD = self._parsed(frames_B3HW[:, None], seed, num_slots).slots[:, 0]
            # Without the first frame in mind: pixels that are carried along say nothing of the model.
            drawn = [self.model.renderer(part).frames_B3HW for part in slots_BKD.split(CHUNK)]
            return psnr((torch.cat(drawn).clamp(-1, 1) + 1) / 2, (frames_B3HW + 1) / 2)

        own_B3HW = self._at_own_size(frames_B3HW)
        warn_of_foreign(own_B3HW, psnr_of(own_B3HW, parsed.slots[:, 0]), own, psnr_of, depth=depth + 1)

    def _at_own_size(self, frames: Tensor) -> Tensor:
        """Frames (..., 3, H, W) at the size of those that the model was trained on."""
        return F.adaptive_avg_pool2d(frames.flatten(0, -4), self.image_size).unflatten(0, frames.shape[:-3])
