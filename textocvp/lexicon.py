"""A public dictionary from colour names to RGB: what lets a text encoder understand colours nobody ever
captioned.

Three public palettes, asked in this order, so that a plain name means the colour people put on plots:
Tableau 10 (the 2016 palette), the CSS4 colour names, and the 949 names of the XKCD colour survey (the last
two from matplotlib). A name may have several words ("light blue").
"""

from __future__ import annotations

from functools import cache

from matplotlib.colors import CSS4_COLORS, XKCD_COLORS, to_rgb

# Tableau's 2016 categorical palette, which matplotlib lacks (its `tab:` colours are the older one). Tableau
# calls # #76b7b2 teal; captions of tabletop scenes call it cyan. It goes by both names.
TABLEAU_10 = {
    "blue": "#4e79a7",
    "orange": "#f28e2b",
    "red": "#e15759",
    "teal": "#76b7b2",
    "cyan": "#76b7b2",
    "green": "#59a14f",
    "yellow": "#edc948",
    "purple": "#b07aa1",
    "pink": "#ff9da7",
    "brown": "#9c755f",
    "gray": "#bab0ac",
    "grey": "#bab0ac",
}


@cache
def palette() -> dict[tuple[str, ...], tuple[float, float, float]]:
    """Colour name, as a tuple of lower-case words, to RGB in 0..1.

    Names that are no words ("blue/green") are left out.
    """
    xkcd = {name.removeprefix("xkcd:"): value for name, value in XKCD_COLORS.items()}
    merged = {**xkcd, **CSS4_COLORS, **TABLEAU_10}  # later palettes win
    return {tuple(name.split()): to_rgb(value) for name, value in merged.items() if "/" not in name}


@cache
def longest_name() -> int:
    """Words in the longest colour name."""
    return max(map(len, palette()))


def color_of(name: str) -> tuple[float, float, float] | None:
    """RGB in 0..1 of a colour name, case ignored; None if no palette has it."""
    return palette().get(tuple(name.lower().split()))
