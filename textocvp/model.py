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
from typing import Any

import torch
from huggingface_hub import PyTorchModelHubMixin, snapshot_download
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from textocvp.config import ModelConfig
from textocvp.feature_renderer import check_features
from textocvp.parser import build_parser
from textocvp.predictor import build_predictor
from textocvp.renderer import build_renderer
from textocvp.text import build_text_encoder

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
TEXT_FOLDER = "text"  # only where a fine-tuned text encoder needs it


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged, or made for another model; the message says which part and why."""


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


def checkpoint_folder(name: str | Path, **hub: Any) -> Path:
    """The folder of that name, or the one into which the repository `name` of the Hugging Face hub was fetched.

    Args:
        hub: as in `huggingface_hub.snapshot_download`.

    Raises:
        CheckpointError: if there is neither.
    """
    folder = Path(name)
    if folder.is_dir():
        return folder
    try:
        patterns = [CONFIG_FILE, WEIGHTS_FILE, f"{TEXT_FOLDER}/*"]
        return Path(snapshot_download(str(name), allow_patterns=patterns, **hub))
    # The hub client raises many kinds: no such repository, no network, not a valid id, no access.
    except Exception as error:
        raise CheckpointError(
            f"{str(name)!r} is no folder here, and fetching it from the Hugging Face hub failed: "
            f"{type(error).__name__}: {error}"
        ) from error


def read_config(folder: Path) -> ModelConfig:
    """The configuration of the checkpoint in `folder`.

    Raises:
        CheckpointError: if there is no readable `config.json` there, it is of another architecture, or a field is
            unknown or missing.
    """
    data = read_json(folder)
    if data.get("architecture") == "mage-vqvae":
        raise CheckpointError(
            f"{folder} holds a VQ-VAE, which imagines nothing: `textocvp train mage --vqvae {folder}` makes a MAGE "
            "of it"
        )
    if "architecture" in data:
        raise CheckpointError(
            f"{folder} holds a {data['architecture']!r} model, which has no slots: load it with "
            "textocvp.video.load_video_model"
        )
    try:
        return ModelConfig.from_dict(data)
    except ValueError as error:
        raise CheckpointError(f"{folder / CONFIG_FILE}: {error}") from error


def read_json(folder: Path) -> dict[str, Any]:
    """What `config.json` of the checkpoint in `folder` holds, whatever its architecture.

    Raises:
        CheckpointError: if there is no readable `config.json` there.
    """
    path = folder / CONFIG_FILE
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CheckpointError(
            f"{folder} is no checkpoint: there is no {CONFIG_FILE}; it must contain {CONFIG_FILE} and "
            f"{WEIGHTS_FILE}"
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{path} is damaged: it must hold one JSON object, not a {type(data).__name__}")
    return data


def load_weights(model: nn.Module, path: Path) -> None:
    """Copy every tensor of a safetensors file into the model.

    Raises:
        CheckpointError: if the file is missing or damaged, or its tensors are not exactly the model's in
            name, shape and kind of number.
    """
    try:
        found = load_file(path)
    except FileNotFoundError:
        raise CheckpointError(f"{path.parent} is no checkpoint: there is no {path.name}") from None
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error
    wanted = model.state_dict()
    for problem, names in (
        ("lacks", wanted.keys() - found.keys()),
        ("has what the model does not:", found.keys() - wanted.keys()),
    ):
        if names:
            raise CheckpointError(f"{path} {problem} {_listed(sorted(names))}")
    for name, tensor in wanted.items():
        if _kind(found[name]) != _kind(tensor):
            raise CheckpointError(
                f"{path}: tensor {name!r} is {_described(found[name])}, the model's is {_described(tensor)}"
            )
    model.load_state_dict(found, strict=True)


def _kind(tensor: Tensor) -> tuple[torch.Size, bool]:
    # Weights may be stored in a shorter float; integers and floats must not be mixed up.
    return tensor.shape, tensor.is_floating_point()


def _described(tensor: Tensor) -> str:
    return f"{tuple(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"


def _listed(names: list[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"tensor{'s' if len(names) > 1 else ''} {', '.join(map(repr, names[:most]))}{more}"
