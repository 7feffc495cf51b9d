"""Both training stages of TextOCVP, and how they are measured while they train."""
