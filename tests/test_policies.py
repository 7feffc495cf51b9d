"""Every block of docs/policies.md runs, in order, and does what the page says."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs" / "policies.md"
NEEDED = {"sb3": "stable_baselines3", "moviepy": "moviepy"}
BLOCKS = re.findall(r"^```python ?(\w*)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def run(names: dict[str, Any], mark: str) -> dict[str, Any]:
    """Run the blocks with this mark in the namespace, which they share."""
    for found, block in BLOCKS:
        if found == mark:
            exec(compile(block, f"{PAGE.name}: {mark or 'plain'}", "exec", dont_inherit=True), names)
    return names


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the blocks define that need nothing else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("page"))
        found = run({}, "")
        found["film"] = iio.imread("film.mp4")
    return found


def test_only_blocks_that_are_run() -> None:
    marks = re.findall(r"^```(\w.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert set(marks) == {"python", *(f"python {mark}" for mark in NEEDED)}


def test_the_plain_blocks(names: dict[str, Any]) -> None:
    assert names["film"].shape == (25, 256, 256, 3)
    assert names["observation"]["goal"].shape == (2, 120) and names["info"]["target"].shape == (2, 1, 2)
    env = gym.make("PutBlockInBowl-v0", observations="goal", image_size=16)
    assert names["success_rate"](env, names["linear"], range(20_000, 20_004)) == 1
    env.close()


@pytest.mark.parametrize("mark", NEEDED)
def test_blocks_that_need_more(
    names: dict[str, Any], mark: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if find_spec(NEEDED[mark]) is None:
        pytest.skip(f"{NEEDED[mark]} is not installed")
    monkeypatch.chdir(tmp_path)
    after = run(dict(names), mark)
    if mark == "sb3":
        assert after["model"].replay_buffer.size() == 110
        action = after["model"].predict(after["env"].reset(seed=0)[0], deterministic=True)[0]
        assert after["env"].action_space.contains(action) and np.isfinite(action).all()
    else:
        (film,) = (tmp_path / "films").glob("*.mp4")
        # moviepy is given 25, as tests/envs/test_other_hands.py counts; version 2.2 wrote 24 of them.
        assert len(iio.imread(film)) in (24, 25)
