"""From slots to frames and masks: one file a renderer, and the table that names them."""

from __future__ import annotations

from textocvp.config import RendererConfig
from textocvp.renderers.base import Rendered, Renderer
from textocvp.renderers.broadcast import BroadcastRenderer
from textocvp.renderers.glimpse import GlimpseRenderer
from textocvp.renderers.patches import FeatureRenderer, PatchRenderer
from textocvp.renderers.upsample import UpsampleRenderer
from textocvp.slots import SlotLayout

__all__ = ["RENDERERS", "Rendered", "Renderer", "build_renderer"]

RENDERERS: dict[str, type[Renderer]] = {
    "broadcast": BroadcastRenderer,
    "glimpse": GlimpseRenderer,
    "patches": PatchRenderer,
    "features": FeatureRenderer,
    "upsample": UpsampleRenderer,
}


def build_renderer(config: RendererConfig, layout: SlotLayout, image_size: int) -> Renderer:
    """The renderer that `config.kind` names.

    Args:
        config: its kind and sizes.
        layout: what the numbers of one slot mean.
        image_size: side of the square frames it draws, in pixels.

    Raises:
        ValueError: if there is no such kind, or it does not fit the layout.
    """
    if config.kind not in RENDERERS:
        raise ValueError(f"unknown renderer.kind {config.kind!r}; known: {', '.join(RENDERERS)}")
    return RENDERERS[config.kind](config, layout, image_size)  # type: ignore[call-arg, arg-type]
