"""Where things are on the table: the frame of the world, the workspace, and the sizes of objects.

World frame: metres, z up, the table top is z = 0, the robot stands at the origin and looks along +x.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace


@dataclass(frozen=True)
class Box2:
    """An axis-aligned rectangle on the table, in metres."""

    x: tuple[float, float]
    y: tuple[float, float]

    def contains(self, x: float, y: float) -> bool:
        return self.x[0] <= x <= self.x[1] and self.y[0] <= y <= self.y[1]

    def shrunk(self, margin: float) -> Box2:
        """The part of it that is at least ``margin`` away from its edge."""
        return Box2((self.x[0] + margin, self.x[1] - margin), (self.y[0] + margin, self.y[1] - margin))

    def __str__(self) -> str:
        return f"x in [{self.x[0]}, {self.x[1]}], y in [{self.y[0]}, {self.y[1]}] (metres)"


WORKSPACE = Box2(x=(0.25, 0.75), y=(-0.25, 0.25))
"""Where a primitive may pick and place.

CLIPort's workspace is twice as wide. In a 64x64 image of that, a block would be 3 pixels wide; ours is cut so
that it fills the `close` camera with blocks of at least 7 pixels.
"""

SPAWN = Box2(x=(0.345, 0.705), y=(-0.16, 0.16))
"""Where the centres of objects lie at the start: whole bowls stay in the `close` view, clear of the resting
arm."""

TABLE = Box2(x=(-0.2, 1.1), y=(-0.75, 0.75))
"""The table top."""


BLOCK_MASS, BOWL_MASS = 0.02, 0.2
"""In kilograms, at any size."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of the objects in metres.

    By default they are those of the paper's published frames: 6 cm blocks and 14 cm bowls (CLIPort's own are
    4 cm and 11.4 cm).
    """

    block: float = 0.058
    """Edge of a block."""
    bowl_radius: float = 0.069
    """Outer radius at the rim."""
    bowl_inner_radius: float = 0.064
    """Inner radius at the rim."""
    bowl_floor_radius: float = 0.048
    """Inner radius at the floor: wider than half a block's diagonal, so that a block can lie flat."""
    bowl_foot_radius: float = 0.052
    """Outer radius where the bowl stands on the table."""
    bowl_height: float = 0.046
    bowl_floor: float = 0.006
    """Thickness of the floor."""

    def scaled(self, factor: float) -> Sizes:
        """All of them times ``factor``."""
        return Sizes(**{name: value * factor for name, value in asdict(self).items()})

    def resized(self, block: float, bowl: float) -> Sizes:
        """Blocks of edge ``block``, and bowls of diameter ``bowl`` in the same proportions."""
        scaled = self.scaled(bowl / (2 * self.bowl_radius))
        return replace(scaled, block=block)

    def footprint(self, kind: str) -> float:
        """Radius in metres of the smallest upright cylinder around an object."""
        return self.bowl_radius if kind == "bowl" else self.block * 0.5**0.5


SIZES: dict[str, Sizes] = {"paper": Sizes(), "cliport": Sizes().resized(block=0.04, bowl=0.114)}
"""As in the paper's published frames, and as in CLIPort itself."""
