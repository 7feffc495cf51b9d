"""From imagined rollouts to robot actions: ground -> score -> plan -> act.

    from planning import Controller, Goal, InstructionPlanner, PinholeCamera, run_episode

    env = gym.make("PutBlockInBowl-v0", control="primitive")
    world_model = WorldModel.from_pretrained()
    planner = InstructionPlanner(world_model)
    result = run_episode(env, planner, Goal.parse(obs["instruction"]), seed=0)

Judging rollouts without a robot (the predicted study):

    camera = PinholeCamera.from_info(info["camera"])
    instruction = Instruction.parse(text)                       # block colour, bowl colour
    rollout = world_model.rollout(obs, [text] * n)
    groundings = ground(rollout, camera)                             # one a rollout, or pass one for all
    trace = measure_rollout(rollout, groundings, instruction)        # distances in pixels, (B, T)
    success_B = Judge()(trace)

Nothing here reads the simulator's state, except `ground_privileged`, whose name says so.
"""

from planning.camera import PinholeCamera
from planning.controller import Controller, PickAndPlace
from planning.goals import Goal, Instruction, Thing
from planning.grounding import AppearanceGrounder, Grounding, GroundingError, ground
from planning.loop import Attempt, EpisodeResult, run_episode
from planning.planners import Candidate, Imagines, InstructionPlanner, Plan, Planner, RandomPlanner
from planning.privileged import PrivilegedGrounder, ground_privileged
from planning.progress import goal_reached
from planning.random_sequences import RandomSequencePlanner
from planning.scores import (
    CarryScore,
    Judge,
    PlacementScore,
    Score,
    Trace,
    WeightedSum,
    arm_block_distance,
    block_bowl_distance,
    measure,
    measure_rollout,
)
from planning.sequences import SequencePlanner
from planning.thresholds import THRESHOLDS, Thresholds

__all__ = [
    "THRESHOLDS",
    "AppearanceGrounder",
    "Attempt",
    "Candidate",
    "CarryScore",
    "Controller",
    "EpisodeResult",
    "Goal",
    "Grounding",
    "GroundingError",
    "Imagines",
    "Instruction",
    "InstructionPlanner",
    "Judge",
    "PickAndPlace",
    "PinholeCamera",
    "PlacementScore",
    "Plan",
    "Planner",
    "PrivilegedGrounder",
    "RandomPlanner",
    "RandomSequencePlanner",
    "Score",
    "SequencePlanner",
    "Thing",
    "Thresholds",
    "Trace",
    "WeightedSum",
    "arm_block_distance",
    "block_bowl_distance",
    "goal_reached",
    "ground",
    "ground_privileged",
    "measure",
    "measure_rollout",
    "run_episode",
]
