"""What the runtime study times: models of several forms, each cut into the same phases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from planning import Grounding, Instruction, Judge, Trace, WeightedSum, measure_rollout
from planning.planners import watched_frames
from planning.scores import CarryScore, PlacementScore
from planning.thresholds import THRESHOLDS
from textocvp.baselines.mage import Mage, MageVideoModel, mage_preset
from textocvp.config import ModelConfig
from textocvp.model import TextOCVP
from textocvp.presets import preset
from textocvp.protocols import VideoModel
from textocvp.rollout import Rollout
from textocvp.world_model import WorldModel

Phase = Literal["encode", "predict", "decode", "all"]
Work = Callable[[], object]
CANDIDATES = 30
STEPS = 24


@dataclass(frozen=True)
class Cell:
    """One measurement.

    Attributes:
        phase: `encode` one observed frame; `predict`: read the sentences and imagine slots or codes; `decode`: draw
            them; `all`: from observed frames to imagined ones.
        frames: how many are imagined (1 for `encode`).
        batch: scenes at once.
        threads: of PyTorch.
    """

    phase: Phase
    frames: int
    batch: int
    threads: int


@dataclass(frozen=True, eq=False)
class Subject:
    """Something to time.

    Attributes:
        name, note: of its row.
        work: the work of a cell; None for what it cannot do or is not asked.
        heavy: whether it takes so long that a first look leaves out its large cells.
    """

    name: str
    note: str
    work: Callable[[Cell], Work | None]
    heavy: bool = False


@dataclass(frozen=True)
class Scenes:
    """What all subjects look at.

    Attributes:
        images_BHW3: as many observed scenes as the largest batch, uint8. texts: their instructions.
    """

    images_BHW3: np.ndarray
    texts: tuple[str, ...]


def slot_subject(
    name: str,
    note: str,
    world_model: WorldModel,
    scenes: Scenes,
    phases: tuple[Phase, ...],
    drawn: int | None = None,
) -> Subject:
    """A model with slots, in its phases. What comes before a phase is computed once and not timed.

    Args:
        drawn: the most frames of all scenes together that it is asked to draw; None for any number.
    """
    model = world_model.model
    longest = world_model.longest_horizon

    def work(cell: Cell) -> Work | None:
        if cell.phase not in phases or (longest is not None and cell.frames > longest):
            return None
        if cell.phase in ("decode", "all") and drawn is not None and cell.frames * cell.batch > drawn:
            return None
        images, texts = scenes.images_BHW3[: cell.batch], list(scenes.texts[: cell.batch])
        if cell.phase == "encode":
            return lambda: world_model.parse(images[:, None])
        if cell.phase == "all":
            return lambda: world_model.imagine(images, texts, horizon=cell.frames)
        seed_B1KD = world_model.parse(images[:, None]).slots

        @torch.no_grad()
        def predict() -> object:
            return model.predictor.rollout(seed_B1KD, model.text(texts), cell.frames)

        if cell.phase == "predict":
            return predict
        # Slots of the observation will do: what slots hold does not change what drawing them costs.
        slots_BTKD = seed_B1KD.expand(-1, cell.frames, -1, -1)
        layout, renderer = model.parser.layout, model.renderer
        return lambda: Rollout(slots_BTKD, tuple(texts), world_model.image_size, layout, renderer).frames

    return Subject(name, note, work, heavy=drawn is not None)


def mage_subject(name: str, note: str, video: MageVideoModel, scenes: Scenes) -> Subject:
    """MAGE in the same phases: frames to codes, sentences and codes to the codes to come, codes to frames."""
    model, longest = video.model, video.longest_horizon

    def work(cell: Cell) -> Work | None:
        if cell.frames > longest:
            return None
        images, texts = scenes.images_BHW3[: cell.batch], list(scenes.texts[: cell.batch])
        if cell.phase == "all":
            return lambda: video.imagine(images, texts, horizon=cell.frames)
        frames_B3HW = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 127.5 - 1
        with torch.no_grad():
            seen_B1hw = model.vqvae.encode(frames_B3HW)[:, None]
        # Codes of the observation will do: which codes they are does not change what drawing them costs.
        codes_Nhw = seen_B1hw.expand(-1, cell.frames, -1, -1).flatten(0, 1)

        @torch.no_grad()
        def phase() -> object:
            if cell.phase == "encode":
                return model.vqvae.encode(frames_B3HW)
            if cell.phase == "decode":
                return model.vqvae.decode(codes_Nhw)
            return model.axial.imagine(seen_B1hw, model.text(texts), cell.frames)

        return phase

    return Subject(name, note, work, heavy=True)


def untrained_mage() -> MageVideoModel:
    """MAGE at the small preset's sizes with random weights."""
    torch.manual_seed(0)
    return MageVideoModel(Mage(mage_preset("mage-small")))


def whole_subject(name: str, note: str, model: VideoModel, scenes: Scenes) -> Subject:
    """A model that is timed from observed frames to imagined ones only."""

    def work(cell: Cell) -> Work | None:
        longest = model.longest_horizon
        if cell.phase != "all" or (longest is not None and cell.frames > longest):
            return None
        images, texts = scenes.images_BHW3[: cell.batch], list(scenes.texts[: cell.batch])
        return lambda: model.imagine(images, texts, horizon=cell.frames)

    return Subject(name, note, work)


def published_form(world_model: WorldModel) -> WorldModel:
    """The same model with its predictor in the published form of the same sizes: a window of 10 frames, attention in
    both directions, computed again at every step.

    Its weights are those of the causal form as far as they fit, which is good for timing and nothing else.
    """
    config = world_model.model.config
    window = replace(config.predictor, attention="window", window=10, age_encoding="learned")
    return _with_predictor(world_model.model, replace(config, predictor=window))


def paper_models() -> tuple[WorldModel, WorldModel]:
    """The paper's TextOCVP-SAVi at its own sizes, with random weights: published window, and frame-causal with a
    cache.
    """
    config = preset("savi-cater")
    torch.manual_seed(0)
    window = WorldModel(TextOCVP(config))
    causal = replace(config.predictor, attention="causal", window=STEPS)
    return window, _with_predictor(window.model, replace(config, predictor=causal))


def _with_predictor(model: TextOCVP, config: ModelConfig) -> WorldModel:
    other = TextOCVP(config)
    weights = {name: tensor for name, tensor in model.state_dict().items() if name != "predictor.ages"}
    other.load_state_dict(weights, strict=False)
    return WorldModel(other)


def planning_query(
    world_model: WorldModel,
    image_HW3: np.ndarray,
    ground: Callable[[Rollout], Grounding],
    pair: Instruction,
    texts: tuple[str, ...],
) -> Work:
    """What a planner asks for once: parse the picture, find the things in it, imagine 30 candidates for 24 frames,
    draw the masks that the scorer looks at, score and judge.

    Args:
        ground: which slot is which thing, in a parsed observation.
        pair: the goal.
        texts: the candidates' sentences; repeated until there are 30.

    Raises:
        GroundingError: when it is run, if the goal's things are not seen.
    """
    score = WeightedSum((PlacementScore(), CarryScore()), (0.8, 0.2))
    candidates = [texts[i % len(texts)] for i in range(CANDIDATES)]
    frames = watched_frames(STEPS + 1, THRESHOLDS.settle_frames, 3)

    def query() -> object:
        parsed = world_model.parse(image_HW3[None])
        grounding = ground(parsed)
        rollout = world_model.rollout(parsed, candidates, horizon=STEPS)
        trace: Trace = measure_rollout(rollout, grounding, pair, frames=frames)
        return score(trace), Judge()(trace)

    return query
