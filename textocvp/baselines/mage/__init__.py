"""MAGE, the holistic baseline: a VQ-VAE turns frames into codes, an axial transformer predicts the next codes.

"Make It Move: Controllable Image-to-Video Generation with Text Descriptions" (Hu et al., CVPR 2022), without its
random part, as TextOCVP (TMLR 2026) compares itself with it.
"""

from textocvp.baselines.mage.model import Mage, MageConfig, MageVideoModel
from textocvp.baselines.mage.presets import MAGE_PRESETS, mage_preset
