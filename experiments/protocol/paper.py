"""The paper's own figures (TextOCVP, TMLR 2026), to stand beside ours in the same layout.

Measured on CLIPort at 336x336, on renderings of another camera, with LPIPS on AlexNet: their order and their distances
compare with ours, their height does not.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperFigures:
    """One row: a model on one kind of scene, over 9 and over 19 frames.

    Attributes:
        ssim, lpips, jedi: at 9 and at 19 frames; None where the paper gives none.
        ssim_drop, lpips_drop: relative to the test set, 0.01 for 1 %.
    """

    method: str
    ssim: tuple[float, float]
    lpips: tuple[float, float]
    jedi: tuple[float | None, float | None] = (None, None)
    ssim_drop: tuple[float | None, float | None] = (None, None)
    lpips_drop: tuple[float | None, float | None] = (None, None)


PAPER_LENGTHS = (9, 19)
MAGE, OURS = "paper, MAGE-DINO", "paper, TextOCVP"
CLIPORT = {
    "test": (
        PaperFigures(MAGE, (0.940, 0.931), (0.064, 0.075), (2.11, 2.59)),
        PaperFigures(OURS, (0.950, 0.931), (0.062, 0.078), (1.36, 2.23)),
    ),
    "unseen_colors": (
        PaperFigures(MAGE, (0.935, 0.924), (0.076, 0.087), ssim_drop=(0.005, 0.007), lpips_drop=(0.19, 0.16)),
        PaperFigures(
            OURS, (0.946, 0.927), (0.066, 0.083), ssim_drop=(0.004, None), lpips_drop=(0.064, 0.064)
        ),
    ),
    "more_objects": (
        PaperFigures(
            MAGE, (0.929, 0.920), (0.088, 0.094), ssim_drop=(0.012, 0.012), lpips_drop=(0.375, 0.253)
        ),
        PaperFigures(
            OURS, (0.936, 0.921), (0.076, 0.090), ssim_drop=(0.015, 0.011), lpips_drop=(0.226, 0.154)
        ),
    ),
}
