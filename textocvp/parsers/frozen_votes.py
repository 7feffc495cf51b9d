"""A frozen encoder that was trained here: the network of a parser of kind `votes`.

It stands where the paper has DINOv2: slot attention learns on features that tell one thing's pixels from another's.
"""

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from textocvp.layers import full_precision
from textocvp.parsers.frozen import FrozenEncoder
from textocvp.parsers.votes import REACH, VoteNetwork
from textocvp.pretrained import CONFIG_FILE, WEIGHTS_FILE, WeightsError

BUNDLED = Path(__file__).parent.parent / "checkpoints"
DEFAULT = "cater"
STRIDE = 2


class VotesEncoder(FrozenEncoder):
    """What the network knows at half resolution, normalised, and the means of what it says of each 2x2 pixels.

    The last six are the shares of background, objects and robot, in -1..1, and the votes, in units of `REACH`. All are
    as precise as float16: read from a cache they are the same.

    Args:
        weights: a checkpoint's folder, or the name of a bundled one; empty for `cater`.
        others: as `FrozenEncoder`.
    """

    def __init__(self, weights: str | Path = "", *, dim: int = 30, patch: int = STRIDE, **others: Any) -> None:
        super().__init__(weights, dim=dim, patch=patch, **others)

    def _read(self) -> tuple[nn.Module, str]:
        name = self.weights or DEFAULT
        folder = BUNDLED / name if (BUNDLED / name).is_dir() else Path(name)
        try:
            parser = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))["parser"]
            tensors = load_file(folder / WEIGHTS_FILE)
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            raise WeightsError(
                f"{self.part}.encoder_weights: {name!r} is no checkpoint that can be read ({error}); the encoder "
                "'votes' takes the folder of one whose parser is 'votes', or the name of such a bundled one"
            ) from error
        if parser.get("kind") != "votes":
            raise WeightsError(
                f"{self.part}.encoder_weights: the parser of {name!r} is no 'votes', but {parser['kind']!r}"
            )
        channels, full = parser["channels"], parser["channels_full"]
        self._check_sizes(channels + 6, STRIDE, str(folder))
        network = VoteNetwork([channels * times for times in (1, 2, 3, 4)], full)
        own = {key: tensors[f"parser.network.{key}"].float().contiguous() for key in network.state_dict()}
        # Of this network alone: another predictor beside it is the same encoder.
        digest = sha256(b"".join(own[key].numpy().tobytes() for key in sorted(own))).hexdigest()
        if self.fingerprint not in ("", digest):
            raise WeightsError(
                f"{self.part}.encoder_fingerprint: this was made with another voting network ({self.fingerprint[:12]}) "
                f"than that of {folder} ({digest[:12]}); give its checkpoint in {self.part}.encoder_weights"
            )
        network.load_state_dict(own)
        return network, digest

    def _encode(self, backbone: nn.Module, frames_N3HW: Tensor) -> Tensor:
        assert isinstance(backbone, VoteNetwork)
        with full_precision(frames_N3HW.device):
            inner_NChw, fine_NCHW = backbone.look(frames_N3HW.float())
            logits_N3HW, votes_N3HW = backbone.say(inner_NChw, fine_NCHW)
            said_N6HW = torch.cat([2 * logits_N3HW.softmax(1) - 1, votes_N3HW / REACH], 1)
            said_NL6, inner_NLC = (x.flatten(2).transpose(1, 2) for x in (F.avg_pool2d(said_N6HW, STRIDE), inner_NChw))
            inner_NLC = F.layer_norm(inner_NLC, inner_NLC.shape[-1:])
        return torch.cat([inner_NLC, said_NL6], 2).half().float()
