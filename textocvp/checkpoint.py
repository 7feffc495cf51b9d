"""Checkpoints: a folder with `config.json` and `model.safetensors` (every tensor of the model, and no other).

Frozen pretrained encoders are not in it: `config.json` has their names and fingerprints. Of a fine-tuned text encoder
the folder `text` holds architecture and tokenizer. Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, TypeVar

import torch
from huggingface_hub import snapshot_download
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from textocvp.config import ModelConfig
from textocvp.files import replace_text, replacing

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
HASH = "weights_sha256"  # in `config.json`: of the file with the weights
TEXT_FOLDER = "text"  # only where a fine-tuned text encoder needs it
DEFAULT_CHECKPOINT = "tabletop-small"

M = TypeVar("M", bound=nn.Module)


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged, or made for another model; the message says which part and why."""


@dataclass(frozen=True)
class Checkpoint:
    """Where a model came from."""

    name: str  # the bundled name, the folder or the hub id that was asked for
    sha256: str = ""  # of its `model.safetensors`; empty for a model that was never saved

    @classmethod
    def of(cls, folder: Path, name: str) -> Checkpoint:
        """The checkpoint in `folder`, found under `name`."""
        return cls(name, hashlib.sha256((folder / WEIGHTS_FILE).read_bytes()).hexdigest())


def bundled_checkpoints() -> list[str]:
    """Names of the checkpoints that come with the package."""
    folders = (files("textocvp") / "checkpoints").iterdir()
    return sorted(folder.name for folder in folders if (folder / CONFIG_FILE).is_file())


@contextmanager
def resolve_checkpoint(name: str | Path, **hub: Any) -> Iterator[Path]:
    """The folder of a checkpoint, for as long as the context lasts.

    Args:
        name: a bundled name, else a folder, else the id `owner/name` of a repository on the Hugging Face hub.
        hub: as in `huggingface_hub.snapshot_download`.

    Raises:
        CheckpointError: if there is none of these; the message lists the bundled ones.
    """
    name, bundled = str(name), bundled_checkpoints()
    if name in bundled:
        with as_file(files("textocvp") / "checkpoints" / name) as folder:
            yield folder
        return
    if Path(name).is_dir():
        yield Path(name)
        return
    allowed = (
        f"Bundled checkpoints: {', '.join(bundled) or 'none'}. Else give a folder that contains {CONFIG_FILE} and "
        f"{WEIGHTS_FILE}, or the id owner/name of a repository on the Hugging Face hub that does."
    )
    if name.count("/") != 1 or name.startswith((".", "/", "~")):
        raise CheckpointError(f"unknown checkpoint {name!r}. {allowed}")
    try:
        fetched = snapshot_download(name, allow_patterns=[CONFIG_FILE, WEIGHTS_FILE, f"{TEXT_FOLDER}/*"], **hub)
    # The hub client raises many kinds: no such repository, no network, not a valid id, no access.
    except Exception as error:
        raise CheckpointError(
            f"unknown checkpoint {name!r}: it is no folder here, and fetching it from the Hugging Face hub failed: "
            f"{type(error).__name__}: {error}. {allowed}"
        ) from error
    yield Path(fetched)


def read_json(folder: Path) -> dict[str, Any]:
    """The settings in `config.json` of the checkpoint in `folder`, whatever its architecture.

    Raises:
        CheckpointError: if there is no readable `config.json` there.
    """
    settings = _read_config_file(folder)
    settings.pop(HASH, None)
    return settings


def _read_config_file(folder: Path) -> dict[str, Any]:
    path = folder / CONFIG_FILE
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CheckpointError(
            f"{folder} is no checkpoint: there is no {CONFIG_FILE}; it must contain {CONFIG_FILE} and {WEIGHTS_FILE}"
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error
    if not isinstance(data, dict):
        raise CheckpointError(f"{path} is damaged: it must hold one JSON object, not a {type(data).__name__}")
    return data


def read_config(folder: Path) -> ModelConfig:
    """The configuration of the checkpoint in `folder`.

    Raises:
        CheckpointError: as `read_json`, or if it is of another architecture, or a field is unknown, missing or has a
            value that is not allowed.
    """
    data = read_json(folder)
    if data.get("architecture") == "mage-vqvae":
        way = f"`textocvp train mage --vqvae {folder}` makes a MAGE of it"
        raise CheckpointError(f"{folder} holds a VQ-VAE, which imagines nothing: {way}")
    if "architecture" in data:
        way = "load it with textocvp.protocols.load_model"
        raise CheckpointError(f"{folder} holds a {data['architecture']!r} model, which has no slots: {way}")
    try:
        return ModelConfig.from_dict(data)
    except ValueError as error:
        raise CheckpointError(f"{folder / CONFIG_FILE}: {error}") from error


def load_checkpoint(folder: Path, build_model: Callable[[], M]) -> M:
    """The model that `build_model` makes, with the weights of the checkpoint in `folder`, in evaluation mode.

    Sizes that do not fit the weights allocate nothing: if the model would be far larger than those, it is made without
    memory, for the message.

    Raises:
        CheckpointError: if the file is missing or damaged, the tensors are not exactly the model's in name, shape and
            kind of number, or not those that `config.json` has the hash of; or a ValueError of `build_model`.
    """
    path = folder / WEIGHTS_FILE
    try:
        try:
            with _NoLarger(path.stat().st_size if path.exists() else 0):
                model = build_model()
        except _TooLargeError:
            with torch.device("meta"):
                model = build_model()
        found = _read_weights(folder, model.state_dict())
    except CheckpointError:
        raise
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{folder / CONFIG_FILE}: {error}") from error
    model.load_state_dict(found)
    return model.eval()


class _TooLargeError(Exception):
    """A tensor is made that the weights cannot fill."""


class _NoLarger(TorchFunctionMode):
    """Lets all calls together make no more numbers than a file of so many bytes has, and a few million.

    PyTorch's meta device makes none at all, but it imports a compiler, which takes seconds.
    """

    slack = 4_000_000  # numbers

    def __init__(self, size: int) -> None:
        super().__init__()
        self.left = size + self.slack

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in _FACTORIES:
            sizes = args[0] if args and isinstance(args[0], Sequence) else args
            self.left -= math.prod(size for size in sizes if isinstance(size, int) and size)
            if self.left < 0:
                raise _TooLargeError
        return func(*args, **(kwargs or {}))


_FACTORIES = {torch.empty, torch.zeros, torch.ones, torch.rand, torch.randn, torch.full, torch.arange, torch.linspace}


def _read_weights(folder: Path, wanted: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of a checkpoint, if they are what is wanted; errors as `load_checkpoint`."""
    path, stated = folder / WEIGHTS_FILE, _read_config_file(folder).get(HASH)
    try:
        content = path.read_bytes()
        found = load(content)
    except FileNotFoundError:
        raise CheckpointError(f"{path.parent} is no checkpoint: there is no {path.name}") from None
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error
    if lacking := wanted.keys() - found.keys():
        raise CheckpointError(f"{path} lacks {_listed(sorted(lacking))}")
    if other := found.keys() - wanted.keys():
        raise CheckpointError(f"{path} has what the model does not: {_listed(sorted(other))}")
    for name, tensor in wanted.items():
        if _kind(found[name]) != _kind(tensor):
            has, needs = _described(found[name]), _described(tensor)
            raise CheckpointError(f"{path}: tensor {name!r} is {has}, the model's is {needs}")
    # Checkpoints of the first days have none.
    if stated is not None and (has := hashlib.sha256(content).hexdigest()) != stated:
        raise CheckpointError(f"{path} is damaged: its SHA-256 is {has}, and {CONFIG_FILE} says {stated}")
    return found


def write_checkpoint(folder: Path, model: nn.Module, config: Mapping[str, Any]) -> None:
    """Write `config.json` and `model.safetensors` into `folder`, which is made if it is not there.

    An old checkpoint there stays as it is until the new files are whole.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # Copies, because safetensors refuses tensors that share memory, as views of a fused projection do.
    tensors = {name: tensor.cpu().contiguous().clone() for name, tensor in model.state_dict().items()}
    with replacing(folder / WEIGHTS_FILE) as new:
        new.write_bytes(save(tensors, metadata={"format": "pt"}))
    write_config(folder, config)


def swap_in(new: Path, folder: Path) -> None:
    """Move the files of a checkpoint over those in `folder`, `config.json` last; a card that is there stays."""
    paths = sorted((p for p in new.rglob("*") if p.is_file()), key=lambda p: p.name == CONFIG_FILE)
    for path in paths:
        place = folder / path.relative_to(new)
        if path.name == "README.md" and place.exists():
            continue
        place.parent.mkdir(parents=True, exist_ok=True)
        path.replace(place)


def write_config(folder: Path, config: Mapping[str, Any]) -> None:
    """Write settings and the hash of the weights there into `config.json`; an old one stays whole until it is."""
    content = {**config, HASH: hashlib.sha256((folder / WEIGHTS_FILE).read_bytes()).hexdigest()}
    replace_text(folder / CONFIG_FILE, json.dumps(content, indent=2) + "\n")


def _kind(tensor: Tensor) -> tuple[torch.Size, bool]:
    # Weights may be stored in a shorter float; integers and floats must not be mixed up.
    return tensor.shape, tensor.is_floating_point()


def _described(tensor: Tensor) -> str:
    return f"{tuple(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"


def _listed(names: list[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"tensor{'s' if len(names) > 1 else ''} {', '.join(map(repr, names[:most]))}{more}"
