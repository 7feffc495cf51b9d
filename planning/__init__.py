"""From imagined rollouts to robot actions: ground -> score -> plan -> act.

    env = gym.make("PutBlockInBowl-v0", control="primitive")
    obs, info = env.reset(seed=0)
    planner = BeamPlanner(WorldModel.from_pretrained())
    result = run_episode(env, planner, Goal.parse(obs["instruction"]), seed=0)

Scoring rollouts without a robot:

    instruction = Instruction.parse(text)
    rollout = world_model.rollout(obs, [text] * n)
    grounding = AppearanceGrounder.from_info(info)(rollout)
    success_B = succeeds(measure_rollout(rollout, grounding, instruction))

Nothing here reads the simulator's state, except `SegmentationGrounder` and `ground_by_segmentation`.
"""

from collections.abc import Callable
from functools import partial

from torch import Tensor

from .camera import PinholeCamera, View
from .controller import Controller, LiteralController, PickAndPlace
from .grounding import (
    AppearanceGrounder,
    Grounder,
    Grounding,
    GroundingError,
    Palette,
    SegmentationGrounder,
    ground,
    ground_by_segmentation,
)
from .language import AnyGoal, Goal, Instruction, PictureGoal, Thing
from .loop import Attempt, EpisodeResult, run_episode
from .planners import BeamPlanner, Candidate, Imagines, Plan, Planner, RandomPlanner, observe, watched_frames
from .relations import RELATIONS, THRESHOLDS, Relation, Thresholds
from .scores import Trace, measure, measure_rollout, score, succeeds, unmet
from .search import (
    AnySentencePlanner,
    BelievingPlanner,
    Foresees,
    LiteralPlanner,
    SearchPlanner,
    Wanted,
    places,
    seen_supports,
)

InstructionPlanner = BeamPlanner
"""What the planner of goals of one instruction was called when it stood alone: programs of users say it."""


def Judge(limits: Thresholds = THRESHOLDS) -> Callable[[Trace], Tensor]:
    """What `succeeds` was when it was a class: programs of users say `Judge()(trace)`."""
    return partial(succeeds, limits=limits)


__all__ = [
    "RELATIONS", "THRESHOLDS", "AnyGoal", "AnySentencePlanner", "AppearanceGrounder", "Attempt", "BeamPlanner",
    "BelievingPlanner", "Candidate", "Controller", "EpisodeResult", "Foresees", "Goal", "Grounder", "Grounding",
    "GroundingError", "Imagines", "Instruction", "InstructionPlanner", "Judge", "LiteralController", "LiteralPlanner",
    "Palette", "PickAndPlace", "PictureGoal", "PinholeCamera", "Plan", "Planner", "RandomPlanner", "Relation",
    "SearchPlanner", "SegmentationGrounder", "Thing", "Thresholds", "Trace", "View", "Wanted", "ground",
    "ground_by_segmentation", "measure", "measure_rollout", "observe", "places", "run_episode", "score",
    "seen_supports", "succeeds", "unmet", "watched_frames",
]  # fmt: skip
