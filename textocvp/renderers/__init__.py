"""From slots to frames and masks: one file a renderer, and the table that names them."""

from textocvp.renderers.base import Rendered, Renderer, RendererConfig, Seen
from textocvp.renderers.broadcast import BroadcastRenderer
from textocvp.renderers.carry import CarryRenderer
from textocvp.renderers.glimpse import GlimpseRenderer
from textocvp.renderers.patches import FeatureRenderer, PatchRenderer
from textocvp.renderers.recall import RecallRenderer
from textocvp.renderers.upsample import UpsampleRenderer
from textocvp.slots import SlotLayout

RENDERERS: dict[str, type[Renderer]] = {
    "glimpse": GlimpseRenderer,  # a small picture a slot, pasted at the slot's place: the renderer that ships
    "carry": CarryRenderer,  # the same, and what the first frame shows is copied from it
    "recall": RecallRenderer,  # drawn as by glimpse, and corrected by what was wrong about the first frame
    "patches": PatchRenderer,  # an MLP draws patch by patch
    "features": FeatureRenderer,  # published for CLIPort: the MLP redraws DINOv2's features
    "broadcast": BroadcastRenderer,  # published for CATER: spatial broadcast decoder
    "upsample": UpsampleRenderer,  # one slot is the whole frame: Non-OC
}


def build_renderer(config: RendererConfig, layout: SlotLayout, image_size: int) -> Renderer:
    """The renderer that `config.kind` names, with random weights; `image_size` is the frame's side in pixels."""
    return RENDERERS[config.kind](config, layout, image_size)  # type: ignore[call-arg, arg-type]
