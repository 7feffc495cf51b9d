"""TextOCVP: scene parser, text encoder, predictor and renderer in one module (TextOCVP, TMLR 2026, figure 1)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from huggingface_hub import PyTorchModelHubMixin
from torch import nn

from textocvp.checkpoint import (
    TEXT_FOLDER,
    CheckpointError,  # noqa: F401 - for those who catch what `from_pretrained` raises
    load_checkpoint,
    read_config,
    resolve_checkpoint,
    swap_in,
    write_checkpoint,
)
from textocvp.config import ModelConfig
from textocvp.parsers import build_parser
from textocvp.parsers.votes import VotesConfig
from textocvp.pictures.restorer import LEVELS, Restorer
from textocvp.predictors import build_predictor
from textocvp.predictors.base import SlotPredictor
from textocvp.renderers import build_renderer
from textocvp.renderers.carry import CarryConfig
from textocvp.renderers.glimpse import PictureConfig
from textocvp.renderers.patches import FeatureConfig, PatchConfig
from textocvp.renderers.upsample import UpsampleConfig
from textocvp.text import build_text_encoder


class TextOCVP(
    nn.Module, PyTorchModelHubMixin, library_name="textocvp", tags=["world-model", "object-centric", "video-prediction"]
):
    """The text-conditioned object-centric video predictor: `parser`, `text`, `predictor`, `renderer`.

    Where its config has an `outcome`, it also has a second predictor of that name, and likewise a `restorer`.

    Args:
        text_files: the text encoder's own folder, of a checkpoint that is being loaded.

    Raises:
        ValueError: if parts do not fit each other, or pretrained weights are missing.
    """

    def __init__(self, config: ModelConfig, text_files: Path | None = None) -> None:
        super().__init__()
        check_parts(config)
        self.parser = build_parser(config.parser)
        self.text = build_text_encoder(config.text, text_files)
        self.config = replace(config, text=self.text.config)  # says which frozen weights these are
        self.predictor = build_predictor(config.predictor, config.parser.layout, config.text.dim)
        self.outcome: SlotPredictor | None = None
        if config.outcome is not None:
            self.outcome = build_predictor(config.outcome, config.parser.layout, config.text.dim)
        self.renderer = build_renderer(config.renderer, config.parser.layout, config.parser.image_size)
        self.restorer = None if config.restorer is None else Restorer(config.restorer)

    @property
    def device(self) -> torch.device:
        """Where the model's parameters are."""
        return next(self.parameters()).device

    def save_pretrained(self, save_directory: str | Path, **options: Any) -> str | None:
        """Write the checkpoint into a folder; an old one stays whole until the new one is. Options: as the hub's."""
        folder = Path(save_directory)
        folder.mkdir(parents=True, exist_ok=True)
        options.setdefault("repo_id", folder.name)
        # The hub's own removes an old config.json before it writes anything.
        with TemporaryDirectory(dir=folder, prefix=".new-") as new:
            result: str | None = super().save_pretrained(new, **options)
            swap_in(Path(new), folder)
        return result

    def _save_pretrained(self, save_directory: Path) -> None:
        """Called by `save_pretrained(folder)`, which also writes a model card unless the folder has one."""
        config = self.config
        if self.parser.frozen is not None:
            known = {"encoder_fingerprint": self.parser.frozen.fingerprint}
            config = replace(config, parser=replace(config.parser, **known))  # type: ignore[arg-type]
        write_checkpoint(save_directory, self, config.to_dict())
        self.text.save_files(save_directory / TEXT_FOLDER)

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls, name: str | Path, *, device: str | torch.device = "cpu", **hub: Any
    ) -> TextOCVP:
        """Load a checkpoint, in evaluation mode.

        Args:
            name: a bundled name, a folder or a hub id.
            hub: as in `huggingface_hub.snapshot_download`, for example `revision`.

        Raises:
            CheckpointError: if a file is missing or damaged, or a config field or tensor does not fit; it is named.
        """
        with resolve_checkpoint(name, **hub) as folder:
            config = read_config(folder)
            model = load_checkpoint(folder, lambda: cls(config, folder / TEXT_FOLDER))
        return model.to(device)


def check_parts(config: ModelConfig) -> None:
    """Raise a ValueError where two parts do not fit each other; the message says what to set."""
    parser, renderer, text = config.parser, config.renderer, config.text
    layout, side = parser.layout, parser.image_size
    if isinstance(renderer, PictureConfig) and not layout.explicit:
        needs = "parser.layout.explicit = true: it draws a slot at its own place"
        raise ValueError(f"renderer.kind {renderer.kind!r} needs {needs}")
    if isinstance(renderer, CarryConfig) and not isinstance(parser, VotesConfig):
        raise ValueError("renderer.kind 'carry' needs to know which slot is the robot: set parser.kind=votes")
    if isinstance(renderer, UpsampleConfig):
        if layout.explicit or parser.num_slots != 1:
            raise ValueError("renderer.kind 'upsample' draws the one slot of a frame: set parser.kind=holistic")
        if side < 16 or side & (side - 1):
            raise ValueError(f"renderer.kind 'upsample' draws frames of 16, 32, 64, 128, ... pixels, not {side}")
    if config.restorer is not None and side % 2 ** (LEVELS - 1):
        raise ValueError(f"a restorer takes frames of a multiple of {2 ** (LEVELS - 1)} pixels, not {side}")
    if isinstance(renderer, PatchConfig) and side % renderer.patches:
        raise ValueError(f"renderer.patches: {renderer.patches} patches do not divide {side} pixels evenly")
    if isinstance(renderer, FeatureConfig):
        if parser.features is None:
            way = "set parser.kind=savi and parser.encoder=dinov2 or efficientnet-lite0"
            raise ValueError(f"renderer.kind 'features' redraws the features of a frozen encoder: {way}")
        for name, wanted in zip(("patches", "feature_dim"), parser.features, strict=True):
            has = getattr(renderer, name)
            if has != wanted:
                way = f"set renderer.{name}={wanted}"
                raise ValueError(f"renderer.{name} is {has}, the encoder's features have {wanted}: {way}")
    for name, part in (("predictor", config.predictor), ("outcome", config.outcome)):
        if not getattr(part, "color_bias", False):  # an option of predictors that attend to the text
            continue
        needs = ""
        if not text.words_have_rgb:
            needs = f"words that carry RGB, which is text.kind=lexicon, not {text.kind!r}"
        elif not layout.explicit:
            needs = "slots with explicit colour (parser.layout.explicit = true)"
        if needs:
            raise ValueError(f"{name}.color_bias=true needs {needs}: set {name}.color_bias=false")


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """The model in evaluation mode, and afterwards each part in the mode that it was in."""
    training = [module for module in model.modules() if module.training]
    model.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True
