"""The parser that ships: slots that know their colour, place and size.

Every frame is shared out among the slots by colour and place, a competition (softmax over slots) like that of slot
attention, with keys and queries that are explicit instead of learned: the colour features of a pixel and of a slot,
and how far the pixel lies from the slot in units of the slot's size (Invariant Slot Attention, Biza et al. 2023).
What is learned is the content: a slot's pixels, read in the slot's own coordinates, update it through a GRU and a
residual MLP (Locatello et al. 2020), and a transformer block carries the slots to the next frame (SAVi, Kipf et al.
2022). The learned part never sees hue, only masks and luminance, so the content is exactly the same when the colour
channels of the video are permuted: that is what lets training recolour whole scenes in slot space.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from textocvp.crop import crop
from textocvp.layers import pixel_grid
from textocvp.parsers.base import Generators, Parsed, ParserConfig, SceneParser
from textocvp.parsers.clustering import ClusterInitializer, color_features, squared_distances
from textocvp.slots import PRESENCE_BACKGROUND, SlotState, moments


@dataclass(frozen=True)
class CropConfig(ParserConfig):
    """Options of `PlacedCorrector`."""

    crop_cells: int = 24  # side in cells of the canonical picture in which the corrector reads a slot
    crop_extent: float = 2.6  # how many standard deviations that picture reaches to each side
    hidden: int = 256  # width of the corrector's fully connected layers

    def __post_init__(self) -> None:
        self._check_layout(explicit=True)


@dataclass(frozen=True)
class PlacedConfig(CropConfig):
    """Options of `PlacedParser`."""

    kind: Literal["placed"] = "placed"
    transition_heads: int = 4  # of the transformer block between frames
    transition_hidden: int = 128

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_slots(2, "a background and a thing")
        self._check_heads(2 * self.layout.content, self.transition_heads)


class PlaceAttention(nn.Module):
    """Which slot each pixel belongs to, by colour and place."""

    color_weight = 240.0  # of a squared colour-feature distance in the logits
    background_distance = 0.12  # squared colour-feature distance beyond which a pixel is background
    # Of the place term log(1 + d^2): heavy-tailed, so that a thing that moved is still found.
    place_weight = 12.0
    # How far a thing may move between frames without cost, added to three times its scale.
    search_radius = 0.08

    @torch.no_grad()
    def forward(self, frames: Tensor, state: SlotState) -> Tensor:
        """Attention (B, K, H, W), summing to 1 over the slots, of frames (B, 3, H, W) for slots (B, K)."""
        B, _, H, W = frames.shape
        colors_BNC = color_features(frames.flatten(2).transpose(1, 2).float())
        distance_BKN = squared_distances(color_features(state.color.float()), colors_BNC)
        logits_BKN = -self.color_weight * distance_BKN

        # Squared offset in units of the slot's size, added up from its two axes: far cheaper than a grid of vectors.
        reach_BK2 = 3 * state.scale + self.search_radius
        grid_HW2 = pixel_grid(H, W, device=frames.device)
        dx_BKW = (grid_HW2[0, :, 0] - state.position[..., :1]) / reach_BK2[..., :1]
        dy_BKH = (grid_HW2[:, 0, 1] - state.position[..., 1:]) / reach_BK2[..., 1:]
        offset_BKHW = dx_BKW.square()[:, :, None, :] + dy_BKH.square()[..., None]
        place_BKN = -self.place_weight * torch.log1p(offset_BKHW).flatten(2)

        things_BKN = (logits_BKN + place_BKN).masked_fill(state.is_unused, float("-inf"))
        furthest = torch.full_like(logits_BKN, -self.color_weight * self.background_distance)
        background_BKN = torch.logaddexp(logits_BKN, furthest)
        attention_BKN = torch.where(state.is_background, background_BKN, things_BKN).softmax(dim=1)
        return attention_BKN.view(B, -1, H, W)


class PlacedCorrector(nn.Module):
    """Updates the slots from one frame: attention, explicit state from its moments, content through a GRU."""

    min_pixels = 3.0  # a slot that gets less than this is hidden; it keeps what it had

    def __init__(self, config: CropConfig) -> None:
        super().__init__()
        content = config.layout.content
        self.cells, self.extent = config.crop_cells, config.crop_extent
        self.attend = PlaceAttention()
        self.values = nn.Sequential(
            nn.Linear(2 * self.cells**2, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, content),
        )
        self.gru = nn.GRUCell(content, content)
        self.mlp = nn.Sequential(
            nn.LayerNorm(content), nn.Linear(content, config.hidden), nn.ReLU(), nn.Linear(config.hidden, content)
        )

    def forward(self, frames: Tensor, state: SlotState, attention: Tensor | None = None) -> tuple[SlotState, Tensor]:
        """The corrected slots and the attention (B, K, H, W) for frames (B, 3, H, W)."""
        if attention is None:  # given on the first frame: the clusters themselves
            attention = self.attend(frames, state)
        seen = state.is_thing & (attention.sum((2, 3))[..., None] >= self.min_pixels)
        position, scale = moments(attention)
        position = torch.where(seen, position, state.position)
        scale = torch.where(seen, scale, state.scale)

        values_BKC = self.values(self._crops(frames, attention, position, scale, state.color).flatten(2))
        B, K, C = values_BKC.shape
        content = self.gru(values_BKC.reshape(B * K, C), state.content.reshape(B * K, C)).view(B, K, C)
        content = content + self.mlp(content)
        content = torch.where(seen, content, state.content)
        return SlotState(content, state.color, position, scale, state.presence), attention

    def _crops(self, frames: Tensor, attention: Tensor, position: Tensor, scale: Tensor, color: Tensor) -> Tensor:
        luminance_B1HW = ((frames + 1) / 2).mean(1, keepdim=True)
        own_BK11 = ((color + 1) / 2).mean(-1)[..., None, None]
        shading_BKHW = attention * (luminance_B1HW / own_BK11.clamp_min(0.05) - 1).clamp(-1, 2)
        parts = [crop(x[:, :, None], position, scale, self.cells, self.extent) for x in (attention, shading_BKHW)]
        return torch.cat(parts, dim=2)


class PlacedTransition(nn.Module):
    """One transformer block between frames; starts as "nothing changes"."""

    def __init__(self, config: PlacedConfig) -> None:
        super().__init__()
        content = config.layout.content
        width = 2 * content
        self.inputs = nn.Linear(content + 5, width)
        sizes = (width, config.transition_heads, config.transition_hidden)
        self.block = nn.TransformerEncoderLayer(*sizes, dropout=0.0, batch_first=True, norm_first=True)
        self.outputs = nn.Linear(width, content + 4)
        nn.init.zeros_(self.outputs.weight)
        nn.init.zeros_(self.outputs.bias)

    def forward(self, state: SlotState) -> SlotState:
        """Where the slots (B, K) are expected in the next frame."""
        tokens = torch.cat([state.content, state.position, state.scale.log(), state.presence], dim=-1)
        unused = state.is_unused[..., 0]
        change = self.outputs(self.block(self.inputs(tokens), src_key_padding_mask=unused))
        content, position, log_scale = change.split([state.content.shape[-1], 2, 2], dim=-1)
        moves = state.is_thing
        return SlotState(
            torch.where(moves, state.content + content, state.content),
            state.color,
            torch.where(moves, state.position + position, state.position),
            torch.where(moves, state.scale * log_scale.exp(), state.scale),
            state.presence,
        )


class PlacedParser(SceneParser):
    """Clusters on the first frame, then transition and correction on every later one."""

    Config = PlacedConfig
    config: PlacedConfig

    def __init__(self, config: PlacedConfig) -> None:
        super().__init__(config)
        self.initializer = ClusterInitializer()
        self.corrector = PlacedCorrector(config)
        self.transition = PlacedTransition(config)

    def forward(self, frames_BT3HW: Tensor, *, num_slots: int | None = None, generator: Generators = None) -> Parsed:
        """See `SceneParser.forward`. Nothing is drawn at random: `generator` changes nothing."""
        state, attention = self.first(frames_BT3HW[:, 0], num_slots or self.config.num_slots)
        slots, attentions, expectations = [state.join()], [attention], []
        for t in range(1, frames_BT3HW.shape[1]):
            expected = self.transition(state)
            state, attention = self.corrector(frames_BT3HW[:, t], expected)
            slots.append(state.join())
            attentions.append(attention)
            expectations.append(expected.join())
        slots_BTKD = torch.stack(slots, 1)
        expected_BTKD = torch.stack(expectations, 1) if expectations else slots_BTKD[:, 1:]
        return Parsed(slots_BTKD, torch.stack(attentions, 1), expected_BTKD)

    def first(self, frames: Tensor, num_slots: int) -> tuple[SlotState, Tensor]:
        """The slots of the first frames (B, 3, H, W), and their attention (B, K, H, W)."""
        clusters = self.initializer(frames, num_slots)
        B, K = clusters.presence.shape
        weights_BKN = clusters.masks.flatten(2) / clusters.masks.sum((2, 3))[..., None].clamp_min(1)
        color = weights_BKN @ frames.flatten(2).transpose(1, 2)
        position, scale = moments(clusters.masks)
        presence = clusters.presence[..., None].clone()
        presence[:, 0] = PRESENCE_BACKGROUND
        content = frames.new_zeros(B, K, self.layout.content)
        state = SlotState(content, color, position, scale, presence)
        # The canvas fills the frame, an unused slot sits in its middle: constants, nothing to learn there.
        state.position = torch.where(state.is_thing, position, torch.zeros_like(position))
        state.scale = torch.where(state.is_thing, scale, torch.full_like(scale, 0.5))
        return self.corrector(frames, state, clusters.masks)
