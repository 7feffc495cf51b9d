"""Shared environments: a PyBullet client costs time, and every reset rebuilds the world from nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import pytest

import envs  # noqa: F401  (registers the environments)


@pytest.fixture(scope="package")
def make() -> Iterator[Callable[..., gym.Env[Any, Any]]]:
    """`gym.make` that remembers: the same arguments give the same environment, closed at the end."""
    made: dict[str, gym.Env[Any, Any]] = {}

    def remember(env_id: str = "PutBlockInBowl-v0", **arguments: Any) -> gym.Env[Any, Any]:
        key = repr((env_id, sorted(arguments.items())))
        if key not in made:
            made[key] = gym.make(env_id, **arguments)
        return made[key]

    yield remember
    for env in made.values():
        env.close()
