"""TextOCVP: scene parser, text encoder, predictor and renderer in one module, and its checkpoint on disk.

A checkpoint is a folder with `config.json` (a `ModelConfig`) and `model.safetensors` (every tensor of the
model, and no other). Frozen pretrained encoders, of text and of images, are not in it: `config.json` has
their names and fingerprints. Of a fine-tuned one the folder `text` holds architecture and tokenizer. Loading
is strict: a checkpoint that does not fit is an error that names the field or the tensor. Nothing is ever
unpickled.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from huggingface_hub import PyTorchModelHubMixin
from safetensors.torch import save_file
from torch import nn

from textocvp.checkpoint import (
    CONFIG_FILE,
    TEXT_FOLDER,
    WEIGHTS_FILE,
    CheckpointError,
    checkpoint_folder,
    load_weights,
    read_config,
)
from textocvp.config import ModelConfig
from textocvp.parsers import build_parser
from textocvp.predictors import build_predictor
from textocvp.renderers import build_renderer
from textocvp.text import build_text_encoder


class TextOCVP(
    nn.Module,
    PyTorchModelHubMixin,
    library_name="textocvp",
    tags=["world-model", "object-centric", "video-prediction"],
):
    """The text-conditioned object-centric video predictor (TextOCVP, TMLR 2026, figure 1).

    Attributes:
        config: every choice of architecture.
        parser: frames to slots.
        text: sentences to tokens.
        predictor: slots and tokens to the slots of the next frames.
        renderer: slots to frames and masks.

    Args:
        text_files: the text encoder's own folder, of a checkpoint that is being loaded.

    Raises:
        ValueError: if parts do not fit each other, or pretrained weights are missing.
    """

    def __init__(self, config: ModelConfig, text_files: Path | None = None) -> None:
        super().__init__()
        check_features(config)
        self.parser = build_parser(config.parser)
        self.text = build_text_encoder(config.text, text_files)
        if config.predictor.color_bias and not self.text.words_have_rgb:
            raise ValueError(
                "predictor.color_bias=true needs words that carry RGB, which is text.kind=lexicon, not "
                f"{config.text.kind!r}: set predictor.color_bias=false"
            )
        self.config = replace(config, text=self.text.config)  # says which frozen weights these are
        self.predictor = build_predictor(config.predictor, config.parser.layout, config.text.dim)
        self.renderer = build_renderer(config.renderer, config.parser.layout, config.parser.image_size)

    @property
    def device(self) -> torch.device:
        """Where the model's parameters are."""
        return next(self.parameters()).device

    def _save_pretrained(self, save_directory: Path) -> None:
        """Called by `save_pretrained(folder)`, which also writes a model card unless the folder has one."""
        # Copies, because safetensors refuses tensors that share memory, as views of a fused projection do.
        tensors = {
            name: tensor.detach().cpu().contiguous().clone() for name, tensor in self.state_dict().items()
        }
        save_file(tensors, save_directory / WEIGHTS_FILE, metadata={"format": "pt"})
        self.text.save_files(save_directory / TEXT_FOLDER)
        parser = replace(self.config.parser, encoder_fingerprint=self.parser.encoder_fingerprint)
        text = json.dumps(replace(self.config, parser=parser).to_dict(), indent=2) + "\n"
        (save_directory / CONFIG_FILE).write_text(text, encoding="utf-8")

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls,
        pretrained_model_name_or_path: str | Path,
        *,
        revision: str | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        token: str | bool | None = None,
        device: str | torch.device = "cpu",
    ) -> TextOCVP:
        """Load a checkpoint, in evaluation mode.

        Args:
            pretrained_model_name_or_path: a folder, or else the id of a repository on the Hugging Face hub.
            revision, cache_dir, local_files_only, token: as in `huggingface_hub.snapshot_download`; hub only.
            device: where to put the model.

        Raises:
            CheckpointError: if a file is missing or damaged, or a config field or tensor does not fit; it is
                named.
        """
        folder = checkpoint_folder(
            pretrained_model_name_or_path,
            revision=revision,
            cache_dir=cache_dir,
            local_files_only=local_files_only,
            token=token,
        )
        config = read_config(folder)
        try:
            model = cls(config, folder / TEXT_FOLDER)
        except (ValueError, TypeError) as error:
            raise CheckpointError(f"{folder / CONFIG_FILE}: {error}") from error
        load_weights(model, folder / WEIGHTS_FILE)
        return model.to(device).eval()


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


def check_features(config: ModelConfig) -> None:
    """Raise a ValueError where renderer and parser do not speak of the same features; the message says what to set."""
    parser, renderer = config.parser, config.renderer
    if renderer.kind != "features":
        return
    if parser.encoder != "dinov2" or parser.corrector != "slot_attention":
        raise ValueError(
            "renderer.kind 'features' redraws the features of a frozen encoder: set parser.encoder=dinov2 and "
            "parser.corrector=slot_attention"
        )
    for name, has, wanted in (
        ("renderer.feature_dim", renderer.feature_dim, parser.encoder_dim),
        ("renderer.patches", renderer.patches, parser.image_size // parser.encoder_patch),
    ):
        if has != wanted:
            raise ValueError(f"{name} is {has}, the encoder's features have {wanted}: set {name}={wanted}")
