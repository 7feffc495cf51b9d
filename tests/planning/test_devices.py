"""Apple's GPUs have no float64: what is read off a rollout is on the CPU before it is asked for."""

import pytest
import torch

from planning import Controller, PinholeCamera
from tests.planning.conftest import put_in
from tests.planning.oracle import OracleWorldModel
from tests.planning.test_search import RGB


def test_float64_is_asked_for_on_the_cpu_only(
    oracle: OracleWorldModel, camera: PinholeCamera, grounder, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = put_in("red", "blue")
    rollout = oracle.rollout(oracle.parse(RGB[None]), [said.text])
    grounding = grounder(rollout)
    moved: set[int] = set()
    cpu, double = torch.Tensor.cpu, torch.Tensor.double

    def watched_cpu(tensor: torch.Tensor) -> torch.Tensor:
        result = cpu(tensor)
        moved.add(id(result))
        return result

    def watched_double(tensor: torch.Tensor) -> torch.Tensor:
        assert id(tensor) in moved
        return double(tensor)

    monkeypatch.setattr(torch.Tensor, "cpu", watched_cpu)
    monkeypatch.setattr(torch.Tensor, "double", watched_double)
    assert Controller(camera).act(rollout, grounding, said).place == pytest.approx((0.60, -0.10), abs=0.01)
