"""One small scene, seen by the `close` camera, for all planning tests."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from planning import AppearanceGrounder, Instruction, PinholeCamera, Thing
from tests.planning.oracle import CAMERA_INFO, PALETTE, OracleWorldModel

torch.set_num_threads(1)  # tiny tensors: more threads only wait for each other


def thing(kind: str, color: str, x: float, y: float) -> dict[str, Any]:
    """An entry of `info["objects"]`: a standing block, or a bowl on its foot."""
    return {"kind": kind, "color": color, "position": (x, y, 0.029 if kind == "block" else 0.0)}


def put_in(block: str, bowl: str) -> Instruction:
    """The instruction that puts the block of one colour into the bowl of another."""
    return Instruction("in", Thing(block, "block"), Thing(bowl, "bowl"))


@pytest.fixture
def camera() -> PinholeCamera:
    return PinholeCamera.from_info(CAMERA_INFO)


@pytest.fixture
def grounder(camera: PinholeCamera) -> AppearanceGrounder:
    return AppearanceGrounder(camera, PALETTE)


@pytest.fixture
def objects() -> list[dict[str, Any]]:
    return [
        thing("block", "red", 0.45, -0.12),
        thing("block", "green", 0.62, 0.10),
        thing("bowl", "blue", 0.60, -0.10),
        thing("bowl", "gray", 0.42, 0.08),
        thing("bowl", "white", 0.66, 0.0),
    ]


@pytest.fixture
def oracle(objects: list[dict[str, Any]], camera: PinholeCamera) -> OracleWorldModel:
    return OracleWorldModel(lambda: objects, camera)
