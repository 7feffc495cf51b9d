"""From frames to slots: one file a parser, and the table that names them.

A `SceneParser` is an encoder, an initializer (first frame), a corrector (every frame) and a transition (between
frames): slot attention for video (SAVi; TextOCVP section 3.1). Which parts those are is the subclass's business.
"""

from __future__ import annotations

from textocvp.config import ParserConfig
from textocvp.parsers.base import Parsed, SceneParser, to_frames
from textocvp.parsers.holistic import HolisticParser
from textocvp.parsers.placed import PlacedParser
from textocvp.parsers.savi import SaviParser

__all__ = ["PARSERS", "Parsed", "SceneParser", "build_parser", "to_frames"]

PARSERS: dict[str, type[SceneParser]] = {
    "slot_attention": SaviParser,
    "placed": PlacedParser,
    "holistic": HolisticParser,
}


def build_parser(config: ParserConfig) -> SceneParser:
    """The parser that `config.corrector` names.

    Raises:
        ValueError: if there is no such corrector, or it does not fit the layout.
    """
    if config.encoder != "conv" and config.corrector != "slot_attention":
        raise ValueError(
            f"parser.encoder {config.encoder!r} needs parser.corrector=slot_attention, not {config.corrector!r}"
        )
    if config.corrector not in PARSERS:
        raise ValueError(f"unknown parser.corrector {config.corrector!r}; known: {', '.join(PARSERS)}")
    return PARSERS[config.corrector](config)  # type: ignore[call-arg]
