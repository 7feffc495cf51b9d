"""The named sizes of MAGE, from "Make It Move" (CVPR 2022), section 4 and its published configuration.

Those of MAGE-DINO are from TextOCVP (TMLR 2026), appendix.
"""

from textocvp.baselines.mage.axial import AxialConfig
from textocvp.baselines.mage.model import MageConfig
from textocvp.baselines.mage.text import PublishedTextConfig
from textocvp.baselines.mage.vqvae import VQVAEConfig
from textocvp.presets import TABLETOP_COLORS, TABLETOP_REWRITES, TABLETOP_WORDS
from textocvp.text.words import WordsConfig

PUBLISHED_TEXT = PublishedTextConfig(vocabulary=TABLETOP_WORDS + TABLETOP_COLORS, rewrites=TABLETOP_REWRITES)

MAGE_PRESETS: dict[str, MageConfig] = {
    # The published sizes at 64x64.
    "mage": MageConfig(name="mage", text=PUBLISHED_TEXT),
    # For two CPU cores: VQ-VAE in minutes, the transformer in tens of minutes, at the episodes' 25 frames. Without
    # `copy` most of that time goes into learning that the table does not move.
    "mage-small": MageConfig(
        name="mage-small",
        vqvae=VQVAEConfig(channels=64, code_dim=64),
        text=WordsConfig(vocabulary=TABLETOP_WORDS, rewrites=TABLETOP_REWRITES),
        axial=AxialConfig(dim=128, heads=4, hidden=256, frames=25, patch=2, copy=True),
    ),
    # The paper's MAGE-DINO at its own sizes (CLIPort, 336x336: 24x24 patches, one seed frame and 19 predicted).
    "mage-dino": MageConfig(
        name="mage-dino", vqvae=VQVAEConfig(image_size=336, encoder="dinov2", channels=1024), text=PUBLISHED_TEXT
    ),
}


def mage_preset(name: str) -> MageConfig:
    """The preset of that name. The message of a KeyError lists those that exist."""
    if name not in MAGE_PRESETS:
        raise KeyError(f"unknown MAGE preset {name!r}; known: {', '.join(sorted(MAGE_PRESETS))}")
    return MAGE_PRESETS[name]
