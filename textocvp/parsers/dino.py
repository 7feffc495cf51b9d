"""The frozen image encoder of the published CLIPort models: DINOv2 (Oquab et al. 2023), through transformers."""

from torch import Tensor, nn

from textocvp.parsers.frozen import FrozenEncoder
from textocvp.pretrained import PretrainedFiles, read_model

DINO_HUB_ID = "facebook/dinov2-base"  # ViT-B/14, 768 wide

# What DINOv2 was trained with: RGB in 0..1 minus the mean, divided by the deviation (ImageNet's).
IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)


def normalized(frames_N3HW: Tensor) -> Tensor:
    """Frames in -1..1 as DINOv2 wants them."""
    mean, std = (frames_N3HW.new_tensor(values)[:, None, None] for values in (IMAGE_MEAN, IMAGE_STD))
    return ((frames_N3HW + 1) / 2 - mean) / std


class DinoEncoder(FrozenEncoder):
    """DINOv2's patches in its last layer.

    Frames of other sizes than DINOv2's own 518x518 get its position codes interpolated, as published.

    Args:
        weights: a folder with `config.json` and `model.safetensors`, or a hub id; empty for facebook/dinov2-base.
        others: as `FrozenEncoder`.
    """

    def _read(self) -> tuple[nn.Module, str]:
        from transformers import Dinov2Config, Dinov2Model  # takes seconds, and only this needs them

        settings = (f"{self.part}.encoder_weights", f"{self.part}.encoder_fingerprint")
        files = PretrainedFiles("the image encoder", *settings, DINO_HUB_ID)
        folder = files.folder(self.weights)
        found = files.fingerprint(folder, self.fingerprint)
        architecture = files.architecture(folder, Dinov2Config)
        self._check_sizes(architecture.hidden_size, architecture.patch_size, str(folder))
        return read_model(Dinov2Model, folder), found

    def _encode(self, backbone: nn.Module, frames_N3HW: Tensor) -> Tensor:
        states = backbone(pixel_values=normalized(frames_N3HW)).last_hidden_state
        return states[:, 1:]  # without the class token
