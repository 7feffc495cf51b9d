"""A frozen encoder that was trained here: the network of a parser of kind `votes`.

It stands where the paper has DINOv2: slot attention learns on features that tell one thing's pixels from another's.
"""

import json
import math
from hashlib import sha256
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from textocvp.layers import full_precision, pixel_grid
from textocvp.parsers.clustering import ClusterInitializer, Clusters
from textocvp.parsers.frozen import FrozenEncoder
from textocvp.parsers.votes import OBJECT, SIZE_UNIT, VoteNetwork, count_votes
from textocvp.pretrained import CONFIG_FILE, WEIGHTS_FILE, WeightsError

BUNDLED = Path(__file__).parent.parent / "checkpoints"
DEFAULT = "cater"
STRIDE = 2
SIZE_SPREAD = 10.0  # of the sizes that are voted for
WIDTH = 9
PEAK_RADIUS = 1.5  # places within which there is no second thing


class VotesEncoder(FrozenEncoder):
    """What the network says of each 2x2 pixels, and their colour: nine numbers, about -1..1.

    Shares of background, object and robot; where the centre of the thing is, (x, y), and its size, 0 where there is no
    thing; red, green, blue. So all pixels of a thing say the same, and those of its twin another place. All are as
    precise as float16: read from a cache they are the same.

    Args:
        weights: a checkpoint's folder, or the name of a bundled one; empty for `cater`.
        others: as `FrozenEncoder`.
    """

    def _read(self) -> tuple[nn.Module, str]:
        name = self.weights or DEFAULT
        folder = BUNDLED / name if (BUNDLED / name).is_dir() else Path(name)
        try:
            parser = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))["parser"]
            tensors, kind = load_file(folder / WEIGHTS_FILE), parser["kind"]
            if kind == "votes":
                network = VoteNetwork(parser["channels"], parser["channels_full"])
                own = {key: tensors[f"parser.network.{key}"].float().contiguous() for key in network.state_dict()}
                network.load_state_dict(own)
        except (OSError, RuntimeError, ValueError, KeyError, TypeError, SafetensorError) as error:
            raise WeightsError(
                f"{self.part}.encoder_weights: {name!r} is no checkpoint that can be read ({error}); the encoder "
                "'votes' takes the folder of one whose parser is 'votes', or the name of such a bundled one"
            ) from error
        if kind != "votes":
            raise WeightsError(f"{self.part}.encoder_weights: the parser of {name!r} is no 'votes', but {kind!r}")
        self._check_sizes(WIDTH, STRIDE, str(folder))
        # Of this network alone: another predictor beside it is the same encoder.
        digest = sha256(b"".join(own[key].numpy().tobytes() for key in sorted(own))).hexdigest()
        if self.fingerprint not in ("", digest):
            raise WeightsError(
                f"{self.part}.encoder_fingerprint: this was made with another voting network ({self.fingerprint[:12]}) "
                f"than that of {folder} ({digest[:12]}); give its checkpoint in {self.part}.encoder_weights"
            )
        return network, digest

    def _encode(self, backbone: nn.Module, frames_N3HW: Tensor) -> Tensor:
        assert isinstance(backbone, VoteNetwork)
        with full_precision(frames_N3HW.device):
            logits_N3HW, votes_N3HW = backbone(frames_N3HW.float())
            shares_N3HW = logits_N3HW.softmax(1)
            H, W = frames_N3HW.shape[-2:]
            # From each pixel to the centre, in pixels: as a place of the frame, and the size beside it.
            offset_N2HW = votes_N3HW[:, :2] * votes_N3HW.new_tensor([2 / W, 2 / H])[:, None, None]
            center_N2HW = pixel_grid(H, W, device=votes_N3HW.device).permute(2, 0, 1) + offset_N2HW
            thing_N3HW = torch.cat([center_N2HW, votes_N3HW[:, 2:] / SIZE_SPREAD], 1) * shares_N3HW[:, OBJECT, None]
            features_N9HW = torch.cat([2 * shares_N3HW - 1, thing_N3HW, frames_N3HW], 1)
            return F.avg_pool2d(features_N9HW, STRIDE).flatten(2).transpose(1, 2).half().float()


class VotedClusters(ClusterInitializer):
    """Clusters of the places that vote for the same centre, of the features of `VotesEncoder`."""

    @torch.no_grad()
    def forward(self, features: Tensor, num_slots: int) -> Clusters:
        """Divide the places of features (B, `WIDTH`, h, w): the background, then the things, the clearest first."""
        _, _, h, w = features.shape
        side = features.new_tensor([w / 2, h / 2])[:, None, None]
        masks_BKhw = features.new_zeros(len(features), num_slots, h, w)
        for features_9hw, masks_Khw in zip(features.float(), masks_BKhw, strict=True):
            shares_3hw = (features_9hw[:3] + 1) / 2
            thing_3hw = features_9hw[3:6] / shares_3hw[OBJECT].clamp_min(0.1)
            offset_2hw = (thing_3hw[:2] - pixel_grid(h, w, device=features.device).permute(2, 0, 1)) * side
            size_1hw = SIZE_SPREAD * thing_3hw[2:] - SIZE_UNIT * math.log(STRIDE)  # of a radius in places
            votes_3hw = torch.cat([offset_2hw, size_1hw])
            ballot = count_votes(shares_3hw, votes_3hw, num_slots - 1, min_votes=1.0, peak_radius=PEAK_RADIUS)
            if len(ballot.peaks_P3):
                masks_Khw[1 + ballot.elect(ballot.peaks_P3), ballot.y_L, ballot.x_L] = 1
            masks_Khw[0] = 1 - masks_Khw[1:].sum(0)
        return Clusters(masks_BKhw, (masks_BKhw.sum((2, 3)) > 0).to(features.dtype))
