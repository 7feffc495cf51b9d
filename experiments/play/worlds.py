"""The worlds to play in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from experiments.play.cater import Cater
from experiments.play.links import Link
from experiments.play.tabletop import Tabletop
from textocvp import Rollout


class World(Protocol):
    """A simulator with one scene.

    Attributes:
        horizon: frames of a film after the first; None for as many as the model looks ahead.
        families: kinds of scenes that a link can ask for.
        link: brings the scene back as it is now.
        rgb: the scene as the camera sees it (H, W, 3) uint8.
        task: the sentence that the scene was made for, or "".
    """

    horizon: int | None
    link: Link
    rgb: np.ndarray
    task: str

    @property
    def families(self) -> Sequence[str]: ...

    def show(self, link: Link) -> None:
        """Build the scene of a link. Refused or ValueError where it cannot be: then the last one stays."""

    def things(self) -> list[dict[str, Any]]:
        """Of each thing its "name" and "color", where it is "at" in the picture (x, y), and at what "height"."""

    def sentences(self, picture: Rollout | None) -> list[str]:
        """That can be said of the scene, or of a person's own picture, parsed."""

    def names(self, rollout: Rollout, own_picture: bool) -> dict[int, str]:
        """Of the slots (B = 1) that hold something."""

    def read(self, text: str) -> Any:
        """What a sentence asks for, as `act` takes it. Refused or ValueError for what is no sentence here."""

    def act(self, wish: Any, rollout: Rollout) -> np.ndarray:
        """Carry out what was read, where it was imagined so (B = 1); the true frames (T, H, W, 3)."""

    def close(self) -> None:
        """Give the simulator back."""


@dataclass(frozen=True)
class Choice:
    """A world to choose: how it is made for an image size, and the checkpoint that knows it."""

    name: str
    make: Callable[[int], World]
    checkpoint: str


WORLDS = {
    one.name: one
    for one in (
        Choice("rearrange", partial(Tabletop, "envs:RearrangeBlocks-v0"), "tabletop-small"),
        Choice("tabletop", partial(Tabletop, "envs:PutBlockInBowl-v0"), "tabletop-small"),
        Choice("cliport", partial(Tabletop, "envs:PutBlockInBowl-v0", scene="cliport"), "cliport"),
        Choice("cater", Cater, "cater"),
    )
}
