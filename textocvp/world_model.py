"""The world model as users meet it: load a checkpoint, give it an observation and a sentence, get a
`Rollout`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from textocvp.checkpoint import DEFAULT_CHECKPOINT, Checkpoint, bundled_checkpoints, resolve_checkpoint
from textocvp.inputs import checked_frames, checked_horizon, checked_pairs, checked_texts, observed_images
from textocvp.model import TextOCVP
from textocvp.parsers.base import Parsed
from textocvp.rollout import Rollout

__all__ = ["DEFAULT_CHECKPOINT", "Checkpoint", "WorldModel", "bundled_checkpoints"]


class WorldModel:
    """Imagines what happens to a scene when a sentence is carried out.

    Attributes:
        model: the network.
        checkpoint: where it came from.
    """

    def __init__(self, model: TextOCVP, checkpoint: Checkpoint | None = None) -> None:
        self.model = model.eval()
        self.checkpoint = checkpoint or Checkpoint(model.config.name)

    @classmethod
    def from_pretrained(
        cls, name_or_folder_or_hub_id: str | Path = DEFAULT_CHECKPOINT, device: str | torch.device = "cpu"
    ) -> WorldModel:
        """Load a checkpoint.

        Args:
            name_or_folder_or_hub_id: a bundled name (`bundled_checkpoints()`), else a folder, else the id
                `owner/name` of a repository on the Hugging Face hub.
            device: where the model computes.

        Raises:
            CheckpointError: if there is no such checkpoint (the message lists the bundled ones), or it is
                damaged.
        """
        name = str(name_or_folder_or_hub_id)
        with resolve_checkpoint(name) as folder:
            return cls(TextOCVP.from_pretrained(folder, device=device), Checkpoint.of(folder, name))

    def __repr__(self) -> str:
        config = self.model.config
        million = sum(p.numel() for p in self.model.parameters()) / 1e6
        H, W = self.image_size
        ahead = (
            f"up to {self.longest_horizon} frames ahead"
            if self.longest_horizon
            else "any number of frames ahead"
        )
        return (
            f"WorldModel({self.checkpoint.name!r}, {million:.1f} M parameters, {H}x{W} frames, "
            f"{config.parser.num_slots} slots, {ahead}, on {self.model.device})"
        )

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) of the only frames that it understands, in pixels."""
        side = self.model.config.parser.image_size
        return side, side

    @property
    def longest_horizon(self) -> int | None:
        """How many frames it can imagine at once; None for as many as you like (the published moving
        window)."""
        predictor = self.model.config.predictor
        return predictor.window if predictor.attention == "causal" else None

    @torch.no_grad()
    def rollout(
        self,
        obs: Mapping[str, Any] | np.ndarray | Rollout,
        text: str | Sequence[str],
        *,
        horizon: int = 24,
        seed: int = 0,
        num_slots: int | None = None,
        attention: bool = False,
        use_cache: bool = True,
    ) -> Rollout:
        """Imagine the next `horizon` frames.

        One scene and n texts give n sequences over one parsed scene; n scenes and n texts go together
        pairwise; n scenes and one text all get that text.

        Args:
            obs: what is seen now: the environment's observation (a mapping with `rgb`), an image (H, W, 3)
                or images (B, H, W, 3), uint8; or a rollout, to go on from its last slots.
            text: what is to be done.
            horizon: how many frames to imagine after the one that is seen.
            seed: of the initial slots, where they are drawn at random. The same seed gives the same rollout.
            num_slots: how many slots to look for in an image, background included: more than the model was
                trained with for scenes of more things. The configured number by default.
            attention: also keep the weights from slots to words.
            use_cache: reuse the keys and values of past frames; without it they are computed again at every
                step (slower, the same up to rounding; for checks).

        Returns:
            a rollout of `horizon + 1` frames, the first of which is the parsed observation.

        Raises:
            TypeError: if the observation is not uint8 or none of the above.
            ValueError: if a shape, value or size, the horizon, or a text is not allowed; the message says
                what is.

        A word that the text encoder has never met is a `UserWarning` that names the word.
        """
        if self.model.config.stage == "parser":
            warnings.warn(
                f"{self.checkpoint.name} has been through the first stage of training only: it can parse, and "
                "what it imagines is noise",
                UserWarning,
                stacklevel=2,
            )
        texts = checked_texts(text, self.model.text)
        hint = ". To see further, go on from where a rollout ended: rollout(previous_rollout, text)"
        checked_horizon(horizon, self.longest_horizon, hint)
        slots_BKD = self._first_slots(obs, seed, num_slots)
        sentences = len(texts)
        B = checked_pairs(slots_BKD.shape[0], sentences)
        texts = texts * B if sentences == 1 else texts
        seed_B1KD = slots_BKD.expand(B, -1, -1)[:, None]
        imagined = self.model.predictor.rollout(
            seed_B1KD, self.model.text(texts), horizon, use_cache=use_cache, return_attention=attention
        )
        slots_BTKD = torch.cat([seed_B1KD, imagined.slots_BSKD], dim=1).float()
        return self._as_rollout(slots_BTKD, tuple(texts), imagined.attention_BSnhKL)

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
        """Slots of true frames, nothing imagined: what a perfect prediction would be measured at.

        Args:
            video: (T, H, W, 3) or (B, T, H, W, 3) uint8.
            seed: of the initial slots.
            num_slots: how many slots to use, as in `rollout`.

        Raises:
            TypeError, ValueError: as `rollout`.
        """
        frames = np.asarray(video)
        if frames.ndim == 4:
            frames = frames[None]
        if frames.ndim != 5:
            raise ValueError(f"video must be (T, H, W, 3) or (B, T, H, W, 3), not {np.asarray(video).shape}")
        B, T = frames.shape[:2]
        flat_N3HW = checked_frames(
            frames.reshape(-1, *frames.shape[2:]), self.image_size, self.model.device, "video"
        )
        parsed = self._parsed(flat_N3HW.unflatten(0, (B, T)), seed, num_slots)
        return self._as_rollout(parsed.slots_BTKD.float(), (), None)

    def words(self, text: str) -> list[str]:
        """A sentence as the text encoder sees it, one word for each weight that `Rollout.attention` gives it.

        Raises:
            TypeError: if the text is not a string.
        """
        if not isinstance(text, str):
            raise TypeError(f"a text must be a string, not {type(text).__name__}")
        return self.model.text.words(text)

    def _parsed(self, frames_BT3HW: Tensor, seed: int, num_slots: int | None) -> Parsed:
        if num_slots is not None and (not isinstance(num_slots, (int, np.integer)) or num_slots < 1):
            raise ValueError(f"num_slots must be a whole number of at least 1 slot, not {num_slots!r}")
        generator = torch.Generator(device=self.model.device).manual_seed(seed)
        return self.model.parser(frames_BT3HW, num_slots=num_slots, generator=generator)

    def _first_slots(
        self, obs: Mapping[str, Any] | np.ndarray | Rollout, seed: int, num_slots: int | None
    ) -> Tensor:
        if isinstance(obs, Rollout):
            if num_slots is not None and num_slots != obs.slots.shape[2]:
                raise ValueError(
                    f"this rollout goes on with its own {obs.slots.shape[2]} slots; num_slots = {num_slots} is "
                    "for images"
                )
            if obs.layout != self.model.parser.layout or obs.image_size != self.image_size:
                raise ValueError(
                    f"this rollout was made by another model: its slots are {obs.layout} at {obs.image_size} "
                    f"pixels, this model's are {self.model.parser.layout} at {self.image_size}"
                )
            return obs.slots[:, -1].to(self.model.device)
        frames_B3HW = checked_frames(observed_images(obs), self.image_size, self.model.device)
        return self._parsed(frames_B3HW[:, None], seed, num_slots).slots_BTKD[:, 0]

    def _as_rollout(self, slots_BTKD: Tensor, texts: tuple[str, ...], attention: Tensor | None) -> Rollout:
        return Rollout(
            slots=slots_BTKD,
            texts=texts,
            image_size=self.image_size,
            layout=self.model.parser.layout,
            renderer=self.model.renderer,
            attention=attention,
        )
