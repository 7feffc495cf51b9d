"""The parser of Non-OC, the baseline without objects: a frame is one slot (TextOCVP, TMLR 2026, section 4).

Convolutions and an average pooling make one vector of each frame. All that follows is the same as for many slots.
"""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn
from torch.nn import functional as F

from textocvp.layers import PositionCode, init_relu_
from textocvp.parsers.base import Generators, Parsed, ParserConfig, SceneParser
from textocvp.slots import SlotLayout


@dataclass(frozen=True)
class HolisticConfig(ParserConfig):
    """Options of `HolisticParser`."""

    kind: Literal["holistic"] = "holistic"
    num_slots: int = 1
    layout: SlotLayout = SlotLayout(content=256, explicit=False)
    encoder_channels: int = 32  # width of the first convolution
    pool_cells: int = 1  # cells along a side of the frame whose features are averaged; published: 1

    def __post_init__(self) -> None:
        self._check_layout(explicit=False)  # one slot has no one place
        if self.num_slots != 1:
            raise ValueError(f"parser.kind 'holistic' has 1 slot, not parser.num_slots = {self.num_slots}")
        if not 1 <= self.pool_cells <= self.image_size // 8:
            raise ValueError(
                f"parser.pool_cells must be 1 to {self.image_size // 8}, the features of a frame of "
                f"{self.image_size} pixels, not {self.pool_cells}"
            )


class HolisticParser(SceneParser):
    """Frames to one slot each: four convolutions that halve the frame three times, average pooling, a linear layer.

    Features get a code of their place before they are pooled, so that the average can say what is where. With more
    than one cell (`pool_cells`) the slot is a linear function of the cells' averages.
    """

    Config = HolisticConfig
    config: HolisticConfig

    def __init__(self, config: HolisticConfig) -> None:
        super().__init__(config)
        channels, wide = config.encoder_channels, 2 * config.encoder_channels
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, channels, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(channels, wide, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(wide, wide, 3, stride=2, padding=1),
        )
        self.position = PositionCode(wide)
        self.mix = nn.Sequential(nn.ReLU(), nn.Conv2d(wide, 2 * wide, 3, padding=1), nn.ReLU())
        self.slot = nn.Linear(2 * wide * config.pool_cells**2, config.layout.dim)
        init_relu_(self)

    def forward(self, frames_BT3HW: Tensor, *, num_slots: int | None = None, generator: Generators = None) -> Parsed:
        """See `SceneParser`. Nothing is drawn at random, so `generator` is not used.

        Raises:
            ValueError: if more than one slot is asked for.
        """
        if num_slots not in (None, 1):
            raise ValueError(f"parser.kind 'holistic' sees a frame as one slot; it cannot use {num_slots}")
        B, T = frames_BT3HW.shape[:2]
        features_NChw = self.mix(self.position(self.convolutions(frames_BT3HW.flatten(0, 1))))
        pooled_NCpp = F.adaptive_avg_pool2d(features_NChw, self.config.pool_cells)
        slots_BT1D = self.slot(pooled_NCpp.flatten(1)).unflatten(0, (B, T))[:, :, None]
        return Parsed(slots_BT1D, features_NChw.new_ones(B, T, 1, *features_NChw.shape[-2:]))
