"""Frozen pretrained weights (DINOv2, T5, MiniLM): where they are, which they are, and what to do if they are missing.

They are never part of our checkpoints, which refer to them by a name and a fingerprint. They are never made up.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from huggingface_hub import snapshot_download

if TYPE_CHECKING:  # importing transformers takes seconds, and most models need none of it
    from transformers import PretrainedConfig, PreTrainedModel

CONFIG_FILE, WEIGHTS_FILE, TOKENIZER_FILE = "config.json", "model.safetensors", "tokenizer.json"

M = TypeVar("M", bound="PreTrainedModel")


class WeightsError(ValueError):
    """Pretrained weights are missing, damaged, or others than a checkpoint was made with; the message says which."""


@dataclass(frozen=True)
class PretrainedFiles:
    """The files of a pretrained encoder, and how messages name them."""

    what: str  # the encoder, for example "the image encoder"
    setting: str  # the field of the configuration that says where the files are
    fingerprint_setting: str  # the field that says which weights they are
    hub_id: str  # the repository to take where `setting` is empty
    files: tuple[str, ...] = (CONFIG_FILE, WEIGHTS_FILE)  # all but `config.json` count for the fingerprint

    def folder(self, name: str = "") -> Path:
        """The folder of that name, or the one into which the repository `name` of the Hugging Face hub was fetched.

        Raises:
            WeightsError: if there is neither, or a file is missing; the message says what to download.
        """
        name = name or self.hub_id
        folder = Path(name)
        if not folder.is_dir():
            # What to fetch where there is a network: a name that looks like a path is no repository.
            wanted = self.hub_id if folder.is_absolute() or name.count("/") != 1 else name
            try:
                folder = Path(snapshot_download(name, allow_patterns=list(self.files)))
            # The hub client raises many kinds: no such repository, no network, not a valid id, no access.
            except Exception as error:
                raise WeightsError(
                    f"{self.what}: the weights {name!r} are no folder here, and fetching them from the Hugging Face "
                    f"hub failed ({type(error).__name__}: {error}). Where there is a network: hf download {wanted} "
                    f"{' '.join(self.files)} --local-dir FOLDER; then set {self.setting}=FOLDER"
                ) from error
        missing = [file for file in self.files if not (folder / file).is_file()]
        if missing:
            needs = f"it must contain {', '.join(self.files)}"
            raise WeightsError(f"{self.what}: {folder} lacks {', '.join(missing)}; {needs}")
        return folder

    def fingerprint(self, folder: Path, wanted: str = "") -> str:
        """The hash of the weights in `folder`; a WeightsError if another is `wanted`."""
        digest = hashlib.sha256()
        for name in self.files:
            if name != CONFIG_FILE:
                with (folder / name).open("rb") as file:
                    while part := file.read(1 << 22):
                        digest.update(part)
        found = digest.hexdigest()
        if wanted not in ("", found):
            raise WeightsError(
                f"{self.fingerprint_setting}: this was made with other weights of {self.what} ({wanted[:12]}) than "
                f"those in {folder} ({found[:12]}); give those in {self.setting}"
            )
        return found

    def architecture(self, folder: Path, kind: type[PretrainedConfig]) -> PretrainedConfig:
        """The architecture in `folder`/config.json; a WeightsError if it is damaged or of another kind."""
        path = folder / CONFIG_FILE
        try:
            data: Any = json.loads(path.read_text(encoding="utf-8"))
            found = data["model_type"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WeightsError(f"{path} is missing or damaged: {type(error).__name__}: {error}") from error
        if found != kind.model_type:
            needs = f"{self.what} reads models of the type {kind.model_type!r}"
            raise WeightsError(f"{needs}, {path} is of the type {found!r}")
        return kind.from_dict(data)


def read_model(kind: type[M], folder: Path, **options: Any) -> M:
    """The model in `folder`, in float32, without what else the file holds (a decoder, a head).

    Raises:
        WeightsError: if the file is damaged, or a tensor is missing or of another shape.
    """
    path = folder / WEIGHTS_FILE
    options |= dict(local_files_only=True, use_safetensors=True, ignore_mismatched_sizes=True)
    # Through transformers, which knows under which names its older versions stored the tensors.
    try:
        with _quiet():
            loaded: Any = kind.from_pretrained(folder, output_loading_info=True, **options)
            model, report = loaded
    # It raises many kinds, one for every way in which a file can be damaged.
    except Exception as error:
        raise WeightsError(f"{path} is missing or damaged: {type(error).__name__}: {error}") from error
    # It would leave these at random.
    if report["missing_keys"]:
        name = min(report["missing_keys"])
        raise WeightsError(f"{path} lacks the tensor {name!r} {tuple(model.state_dict()[name].shape)}")
    if report["mismatched_keys"]:
        name = min(key if isinstance(key, str) else key[0] for key in report["mismatched_keys"])  # transformers 4, 5
        wanted = tuple(model.state_dict()[name].shape)
        raise WeightsError(f"{path} has in another shape the tensor {name!r} {wanted}")
    return model.float()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep transformers from reporting what is checked here anyway."""
    from transformers.utils import logging

    verbosity, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bars:
            logging.enable_progress_bar()
