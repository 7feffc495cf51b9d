"""The colours of the tabletop: how things look, and which colours captions may name."""

from typing import Any, Literal

RGB = tuple[int, int, int]
ColorSplit = Literal["seen", "unseen", "all"]

COLORS: dict[str, RGB] = {
    "blue": (78, 121, 167),
    "green": (89, 169, 79),
    "red": (255, 87, 89),
    "brown": (156, 117, 95),
    "cyan": (118, 183, 178),
    "gray": (186, 176, 172),
    "yellow": (237, 201, 72),
    "pink": (255, 157, 167),
    "purple": (176, 122, 161),
    "white": (255, 255, 255),
    "orange": (242, 142, 43),
}
"""Object colours, name -> RGB in 0..255 (the palette of CLIPort's tasks)."""

# Colours that captions may name: of the train, val and test splits, and of the unseen-colour test (CLIPort's test
# palette). Distractors may have any colour.
SEEN: tuple[str, ...] = ("blue", "green", "red", "brown", "cyan", "gray", "yellow")
UNSEEN: tuple[str, ...] = ("blue", "green", "red", "pink", "purple", "white", "orange")
CAPTION_COLORS: dict[str, tuple[str, ...]] = {"seen": SEEN, "unseen": UNSEEN, "all": tuple(COLORS)}

# The colour of every link: a hue that no object has, so that "this pixel is my arm" never depends on the scene.
# One colour for all, because the world model should see one thing, not six.
ROBOT_RGB: RGB = (105, 72, 240)
TABLE_RGB: RGB = (47, 47, 47)
FLOOR_RGB: RGB = (239, 239, 239)


def palette(robot: RGB = ROBOT_RGB, table: RGB = TABLE_RGB) -> dict[str, Any]:
    """How things look, RGB in 0..255: `colors` (name -> colour of an object), `robot` and `table`."""
    return {"colors": dict(COLORS), "robot": robot, "table": table}
