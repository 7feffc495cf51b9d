"""What every model and every control imagines of one scene, beside what really happened."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from experiments.study.methods import Model
from experiments.study.pool import Worker
from experiments.study.scenes import SampledScene, StudyScene, play_expert, sample_scene, wrong_text
from textocvp import Rollout

Video = TypeVar("Video", np.ndarray, Tensor)


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """A scene and what the expert did in it."""

    sampled: SampledScene  # the scene
    text: str  # the instruction that the expert carried out
    wrong_text: str  # another one
    frames_THW3: np.ndarray  # uint8, the first observation included
    segmentations_THW: np.ndarray  # see `ExpertEpisode`

    @property
    def frames_T3HW(self) -> Tensor:
        """The frames in 0..1."""
        return to_tensor(self.frames_THW3)


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a method makes of a scene."""

    method: str  # its key
    # in 0..1, the redrawn first one included. Fewer than asked for where a model cannot look as far.
    frames_T3HW: Tensor
    rollout: Rollout | None = None  # its slots, where it has any (B = 1)


def predict(
    worker: Worker,
    scene: StudyScene,
    models: Sequence[Model],
    *,
    horizon: int,
    seed: int,
    controls: bool = True,
    variant: int = 0,
    variants: int = 0,
) -> tuple[GroundTruth, list[Prediction]]:
    """Let everybody imagine a scene, and then the expert carry out its instruction.

    Args:
        models: the others that imagine it.
        horizon: how many frames to look ahead.
        seed: of the slots.
        controls: whether `true frames` (parser and renderer on the real frames), `wrong text` (ours with another
            sentence) and `copy frame` (the first real frame repeated) are wanted.
        variant: which of the scene's instructions.
        variants: how many it has beside its own.

    Returns:
        what happened; the predictions of ours, the others and the controls, in the order of a table.
    """
    env = worker.environment(scene)
    sampled = sample_scene(env, scene, variants)
    text, wrong = sampled.texts[variant], wrong_text(sampled)
    ours, seen = worker.world_model, sampled.observation["rgb"]
    both = ours.rollout(seen, [text, wrong], horizon=reach(ours, horizon), seed=seed)
    right, other = both.select(0), both.select(1)
    predictions = [Prediction("ours", right.frames[0], right)]
    predictions += [_predict_one(worker, model, seen, text, horizon, seed) for model in models]
    played = play_expert(env, sampled, variant)
    # What comes after the end of an episode is its last frame, because the arm has come to rest: in the simulator 16
    # further frames differ from it by less than .2 of 255 grey levels in the mean. A test checks it.
    frames, segmentations = (hold_last(its, horizon + 1) for its in (played.frames, played.segmentations))
    truth = GroundTruth(sampled, text, wrong, frames, segmentations)
    if controls:
        parsed = ours.parse(played.frames, seed=seed)
        predictions += [
            Prediction("true frames", hold_last(parsed.frames[0], horizon + 1), parsed),
            Prediction("wrong text", other.frames[0], other),
            Prediction("copy frame", hold_last(truth.frames_T3HW[:1], horizon + 1)),
        ]
    return truth, predictions


def _predict_one(worker: Worker, model: Model, seen: np.ndarray, text: str, horizon: int, seed: int) -> Prediction:
    made = worker.model(model.load)
    ahead = reach(made, horizon)
    if not model.slots:
        return Prediction(model.key, made.imagine(seen, [text], horizon=ahead, seed=seed)[0].float().cpu())
    rollout = made.rollout(seen, [text], horizon=ahead, seed=seed)
    return Prediction(model.key, rollout.frames[0], rollout)


def slots_of(worker: Worker, prediction: Prediction, seed: int) -> Rollout:
    """The slots of a prediction: its own, or for a model without slots what our parser sees in its frames (B = 1)."""
    if prediction.rollout is not None:
        return prediction.rollout
    return worker.world_model.parse(to_uint8(prediction.frames_T3HW), seed=seed)


def to_uint8(frames_T3HW: Tensor) -> np.ndarray:
    """Frames in 0..1 as (T, H, W, 3) uint8."""
    return (frames_T3HW * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


def hold_last(frames: Video, count: int) -> Video:
    """The first so many frames; where there are fewer, the last one stands still."""
    return frames[np.minimum(np.arange(count), len(frames) - 1)]


def to_tensor(frames_THW3: np.ndarray) -> Tensor:
    """The inverse of `to_uint8`."""
    return torch.from_numpy(frames_THW3).permute(0, 3, 1, 2).float() / 255


def reach(model: Any, horizon: int) -> int:
    """So many frames, or as many as the model can imagine at once."""
    return min(horizon, model.longest_horizon or horizon)
