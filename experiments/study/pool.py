"""Work units on several processes, with results in order."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol, TypeVar

import gymnasium as gym
import torch
from joblib import Parallel, delayed

from experiments.study.scenes import StudyScene
from textocvp.protocols import LoadModel
from textocvp.world_model import WorldModel

Out = TypeVar("Out", covariant=True)


@dataclass
class Worker:
    """What a unit of work may use, made once a process."""

    world_model: WorldModel  # the study's own
    _environments: dict[Any, gym.Env[Any, Any]] = field(default_factory=dict)
    _models: dict[LoadModel, Any] = field(default_factory=dict)

    def model(self, load: LoadModel | None) -> Any:
        """Another model, as a baseline; the study's own for None. `load` must be hashable."""
        if load is None:
            return self.world_model
        if load not in self._models:
            self._models[load] = load()
        return self._models[load]

    def environment(self, scene: StudyScene, record: bool = True) -> gym.Env[Any, Any]:
        """The environment of a scene. Building it takes longer than resetting it, so it is kept."""
        key = scene.env_id, scene.steps, scene.look, scene.image_size, record
        if key not in self._environments:
            self._environments[key] = scene.make(record)
        return self._environments[key]


class Unit(Protocol[Out]):
    """A unit of work: data that can be sent to another process, and what to do there."""

    def run(self, worker: Worker) -> Out:
        """Do the work. Must depend on nothing but the unit and the checkpoint."""


@dataclass(frozen=True)
class Pool:
    """Runs units on `processes` processes with one thread each, so that rounding is the same for any number."""

    load: LoadModel  # makes the world model, once in each process
    processes: int  # at least 1; with 1 everything runs in this process

    def run(self, units: Sequence[Unit[Out]]) -> Iterator[Out]:
        """The results, in the order of the units, as they become ready."""
        if self.processes == 1 or not units:
            yield from (_run(self.load, unit) for unit in units)
        else:
            parallel = Parallel(n_jobs=self.processes, return_as="generator", pre_dispatch=2 * self.processes)
            yield from parallel(delayed(_run)(self.load, unit) for unit in units)


@lru_cache(maxsize=1)
def _worker(load: LoadModel) -> Worker:
    torch.set_num_threads(1)
    return Worker(load())


def _run(load: LoadModel, unit: Unit[Out]) -> Out:
    with warnings.catch_warnings():
        # What a user must hear about one sentence or picture, a study says in its figures, about hundreds.
        warnings.simplefilter("ignore", UserWarning)
        return unit.run(_worker(load))
