"""Links: a query string that brings a scene back."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any, cast
from urllib.parse import parse_qsl, urlencode

MOST_ACTS = 100  # pick-and-places that a link repeats


class Refused(Exception):
    """What a person asked for and cannot have; the sentence is shown in the page."""


@dataclass(frozen=True)
class Link:
    """All that makes a scene: what the query string of a link says."""

    seed: int = 0
    family: str = ""  # of a random scene of the world "rearrange"
    layout: tuple[tuple[str, str, float, float, float, float], ...] = ()  # kind, colour, x, y, z and yaw
    acts: tuple[tuple[float, ...], ...] = ()  # pick-and-places since then

    def query(self) -> str:
        """As a query string."""
        said = {"seed": str(self.seed), "family": self.family}
        said |= {"layout": ";".join(",".join(map(str, item)) for item in self.layout)}
        said |= {"acts": ";".join(",".join(map(str, act)) for act in self.acts)}
        return urlencode({name: value for name, value in said.items() if value}, safe=",;")

    @classmethod
    def parse(cls, query: str) -> Link:
        """The inverse of `query`; what else the link says is left alone. Refused for what is no link."""
        said = dict(parse_qsl(query.removeprefix("?"), keep_blank_values=True))
        try:
            items = [item.split(",") for item in said.get("layout", "").split(";") if item]
            layout = tuple((kind, color, *map(float, rest)) for kind, color, *rest in items)
            acts = tuple(tuple(map(float, act.split(","))) for act in said.get("acts", "").split(";") if act)
        except ValueError:
            layout, acts = ((),), ()
        if not (all(len(item) == 6 for item in layout) and all(map(_is_act, acts))):
            raise Refused("the link is damaged: its layout or its acts cannot be read")
        if len(acts) > MOST_ACTS:
            raise Refused(f"the link repeats {len(acts)} acts; at most {MOST_ACTS} are")
        return cls(read_seed(said.get("seed", "0")), said.get("family", ""), cast(Any, layout), acts)


def read_seed(text: str) -> int:
    """A seed as a person types it."""
    text = text.strip()
    if not (text.isascii() and text.isdigit() and len(text) < 20):
        raise Refused(f"the seed must be a whole number of at least 0 and less than 20 digits, not {text!r}")
    return int(text)


def _is_act(act: tuple[float, ...]) -> bool:
    return len(act) == 4 and all(map(isfinite, act))
