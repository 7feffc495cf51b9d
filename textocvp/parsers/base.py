"""From frames to slots: what every scene parser is.

The published ones have an encoder, an initializer (first frame), a corrector (every frame) and a transition (between
frames), see SAVi and TextOCVP section 3.1.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from textocvp.parsers.frozen import FrozenEncoder
from textocvp.slots import SlotLayout

Generators = torch.Generator | Sequence[torch.Generator] | None  # one for all clips, or one for each
MOST_SLOTS = 1000  # more would fill the memory before anything is seen


@dataclass(frozen=True)
class ParserConfig:
    """What every parser is built from; a subclass adds its own options and refuses values that make no sense."""

    kind: str  # a name in `textocvp.parsers.PARSERS`
    image_size: int = 64  # side of the square frame in pixels
    num_slots: int = 12  # K, background included; can be raised when the model is used
    layout: SlotLayout = SlotLayout(content=64)

    @property
    def features(self) -> tuple[int, int] | None:
        """Cells along a side and width of the frozen features that `Parsed` holds; None if there are none."""
        return None

    def _check_layout(self, explicit: bool) -> None:
        if self.layout.explicit != explicit:
            wanted = str(explicit).lower()
            raise ValueError(f"parser.kind {self.kind!r} needs parser.layout.explicit = {wanted}")

    def _check_slots(self, least: int, what: str) -> None:
        if not least <= self.num_slots <= MOST_SLOTS:
            allowed = f"{least} ({what}) to {MOST_SLOTS}"
            raise ValueError(f"parser.num_slots must be {allowed}, not {self.num_slots}")

    @staticmethod
    def _check_heads(width: int, heads: int) -> None:
        if width % heads:
            raise ValueError(f"parser.transition_heads = {heads} does not divide the transition's width {width}")


@dataclass
class Parsed:
    """What a parser found."""

    slots_BTKD: Tensor  # the corrected slots of every frame
    attention_BTKHW: Tensor  # what each slot covers, at feature resolution; sums to 1 over the slots
    # What the transition expected of frames 1 to T-1 before it saw them; None if slots have no place to expect.
    expected_BTKD: Tensor | None = None
    # What a frozen encoder saw, of L patches row by row: reconstructed features are compared with it.
    features_BTLF: Tensor | None = None


class SceneParser(nn.Module):
    """Frames to slots. Subclasses set `Config` and write `forward`; one that is `taught` also `lesson_loss`."""

    Config: ClassVar[type[ParserConfig]]
    taught: ClassVar[bool] = False
    config: ParserConfig

    def __init__(self, config: ParserConfig) -> None:
        super().__init__()
        self.config, self.layout = config, config.layout
        self.frozen: FrozenEncoder | None = None  # a frozen image encoder, which is no part of the checkpoint

    @abstractmethod
    def forward(self, frames_BT3HW: Tensor, *, num_slots: int | None = None, generator: Generators = None) -> Parsed:
        """Parse clips.

        Args:
            frames_BT3HW: frames in -1..1, of the size the parser was built for.
            num_slots: how many slots to use, background included; the configured number by default.
            generator: where initial slots are drawn from, on the frames' device; PyTorch's own by default. Or one for
                each clip, on any device: a clip's slots then do not depend on its neighbours.
        """
        raise NotImplementedError

    def lesson_loss(self, frames_N3HW: Tensor, labels_NHW: Tensor) -> Tensor:
        """What a parser that is taught gets wrong of single frames, a mean over them.

        Args:
            labels_NHW: 0 background, 1 robot, and one other number for each object of a frame.
        """
        raise NotImplementedError


def to_frames(clips: np.ndarray | Tensor, device: torch.device | str = "cpu") -> Tensor:
    """Clips (B, T, H, W, 3) uint8 as the model's frames (B, T, 3, H, W), float in -1..1."""
    return torch.as_tensor(clips).to(device).permute(0, 1, 4, 2, 3).float() / 127.5 - 1
