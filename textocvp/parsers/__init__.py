"""From frames to slots: one file a parser, and the table that names them."""

from textocvp.parsers.base import Parsed, ParserConfig, SceneParser, to_frames
from textocvp.parsers.holistic import HolisticParser
from textocvp.parsers.placed import PlacedParser
from textocvp.parsers.savi import SaviParser
from textocvp.parsers.votes import VotesParser

PARSERS: dict[str, type[SceneParser]] = {
    "placed": PlacedParser,  # slots with explicit colour, place and size: the parser that ships
    "savi": SaviParser,  # published: slots are unexplained vectors
    "holistic": HolisticParser,  # no slots, one vector a frame: Non-OC
    "votes": VotesParser,  # slots as in `placed`, found by a network that has learned to see
}


def build_parser(config: ParserConfig) -> SceneParser:
    """The parser that `config.kind` names, with random weights."""
    return PARSERS[config.kind](config)
