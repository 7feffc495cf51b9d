"""MAGE, the holistic baseline: a VQ-VAE turns frames into codes, an axial transformer predicts the codes to come.

"Make It Move: Controllable Image-to-Video Generation with Text Descriptions" (Hu et al., CVPR 2022), without its
random part, as TextOCVP (TMLR 2026) compares itself with it.
"""
