"""The predicted study: do imagined rollouts show what the sentence says? (Paper, section 4.4.)"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from experiments.protocol.scenes import TestScene, draw, play
from experiments.protocol.workers import Worker
from planning import (
    Grounding,
    GroundingError,
    Imagines,
    Instruction,
    Judge,
    PinholeCamera,
    Trace,
    ground,
    measure_rollout,
)
from textocvp import Rollout

HORIZON = 24


@dataclass(frozen=True, eq=False)
class Verdicts:
    """One method on one scene, for its V instructions (original first) and S slot seeds.

    Attributes:
        success_SV: bool.
        miss_SV: distance in pixels between block and bowl over the last frames; inf where one is not seen.
    """

    success_SV: np.ndarray
    miss_SV: np.ndarray


@dataclass(frozen=True, eq=False)
class PredictedOutcome:
    """Everything that was judged in one scene.

    Attributes:
        scene, texts: the scene and its V instructions, original first.
        ours: imagined with the instruction. wrong_text: imagined with another instruction, judged for this
            one.
        copy_frame: the first frame repeated. true_frames: the parser on the frames of the expert's motion; S
            = 1.
        expert_V: whether the expert reached the goal, judged by the simulator.
        imagined_TV, true_TV: block to bowl distance in pixels over time for the first slot seed.
    """

    scene: TestScene
    texts: tuple[str, ...]
    ours: Verdicts
    wrong_text: Verdicts
    copy_frame: Verdicts
    true_frames: Verdicts
    expert_V: np.ndarray
    imagined_TV: np.ndarray
    true_TV: np.ndarray

    def verdicts(self, method: str) -> Verdicts:
        """By the name of its row in the table."""
        return {
            "ours": self.ours,
            "true frames": self.true_frames,
            "wrong text": self.wrong_text,
            "copy frame": self.copy_frame,
        }[method]


@dataclass(frozen=True)
class PredictedScene:
    """A unit of work: one scene, its original instruction and its variants, several slot-sampling seeds."""

    scene: TestScene
    variants: int
    slot_seeds: tuple[int, ...]

    def run(self, worker: Worker) -> PredictedOutcome:
        """Imagine, judge, and judge the controls."""
        env = worker.environment(self.scene)
        drawn = draw(env, self.scene, self.variants)
        obs, texts = drawn.observation, list(drawn.texts)
        instructions = [Instruction.parse(text) for text in texts]
        camera = PinholeCamera.from_info(drawn.info["camera"])
        judged: dict[str, list[tuple[Tensor, Tensor]]] = {"ours": [], "wrong text": [], "copy frame": []}
        first: Trace | None = None
        for seed in self.slot_seeds:
            rollout = worker.world_model.rollout(obs["rgb"], texts, horizon=HORIZON, seed=seed)
            grounding = _ground(rollout, camera, instructions)
            # Rolling the list by one scores the rollout of each instruction for its neighbour in the list.
            others = instructions[1:] + instructions[:1]
            trace = _trace(rollout, grounding, instructions)
            judged["ours"].append(_judge(trace))
            judged["wrong text"].append(_judge(_trace(rollout, grounding, others)))
            judged["copy frame"].append(_judge(_stand_still(trace)))
            first = first or trace
        true, expert = [], []
        for variant, instruction in enumerate(instructions):
            played = play(env, drawn, variant)
            expert.append(played.success)
            parsed = worker.world_model.parse(played.frames, seed=self.slot_seeds[0])
            true.append(_trace(parsed, _ground(parsed, camera, [instruction]), [instruction]))
        verdicts = {name: _stack(parts) for name, parts in judged.items()}
        assert first is not None
        return PredictedOutcome(
            scene=self.scene,
            texts=tuple(texts),
            ours=verdicts["ours"],
            wrong_text=verdicts["wrong text"],
            copy_frame=verdicts["copy frame"],
            true_frames=_stack([tuple(torch.cat(column) for column in zip(*map(_judge, true), strict=True))]),
            expert_V=np.array(expert),
            imagined_TV=first.block_bowl_Bt.T.numpy(),
            true_TV=_same_length([trace.block_bowl_Bt[0] for trace in true]),
        )


def imagine_and_judge(
    world_model: Imagines, rgb_HW3: np.ndarray, camera: PinholeCamera, texts: Sequence[str], seed: int
) -> tuple[Rollout, Verdicts, Verdicts]:
    """Imagine one scene with V instructions and one slot seed.

    Returns:
        the rollouts, one an instruction; the verdicts of each on its own instruction; and those on the next one of the
        list, for which it was not imagined. Both (1, V).
    """
    instructions = [Instruction.parse(text) for text in texts]
    parsed = world_model.parse(rgb_HW3[None], seed=seed)
    rollout = world_model.rollout(parsed, list(texts), horizon=HORIZON, seed=seed)
    grounding = _ground(rollout, camera, instructions)
    ours, wrong = (
        _stack([_judge(_trace(rollout, grounding, asked))])
        for asked in (instructions, instructions[1:] + instructions[:1])
    )
    return rollout, ours, wrong


def judge_rollout(rollout: Rollout, camera: PinholeCamera, text: str) -> bool:
    """Whether a rollout or a parsed film of a whole episode (B = 1) shows what the sentence says."""
    instruction = Instruction.parse(text)
    success_B, _ = _judge(_trace(rollout, _ground(rollout, camera, [instruction]), [instruction]))
    return bool(success_B[0])


def _ground(rollout: Rollout, camera: PinholeCamera, instructions: list[Instruction]) -> Grounding | None:
    """By appearance, on the first frame, which all rollouts of a batch share."""
    try:
        grounding = ground(rollout.select(0), camera)[0]
    except GroundingError:
        return None
    return grounding.told([thing for i in instructions for thing in (i.block_thing, i.bowl_thing)])


def _trace(rollout: Rollout, grounding: Grounding | None, instructions: list[Instruction]) -> Trace:
    """The trace of each rollout for its instruction. What cannot be found in the picture is nowhere near."""
    length = rollout.slots.shape[1]
    rollout.decode_masks(range(length))  # all at once; the selections below find them decoded
    traces = []
    for b, instruction in enumerate(instructions):
        try:
            if grounding is None:
                raise GroundingError
            traces.append(measure_rollout(rollout.select(b), grounding, instruction))
        except GroundingError:
            nowhere = torch.full((1, length), torch.inf)
            traces.append(Trace(tuple(range(length)), nowhere, nowhere))
    return Trace(
        traces[0].frames,
        torch.cat([trace.arm_block_Bt for trace in traces]),
        torch.cat([trace.block_bowl_Bt for trace in traces]),
    )


def _stand_still(trace: Trace) -> Trace:
    """The trace of the first frame repeated."""
    shape = trace.arm_block_Bt.shape
    return Trace(
        trace.frames, trace.arm_block_Bt[:, :1].expand(shape), trace.block_bowl_Bt[:, :1].expand(shape)
    )


def _judge(trace: Trace) -> tuple[Tensor, Tensor]:
    judge = Judge()
    return judge(trace), trace.block_bowl_Bt[:, -judge.thresholds.settle_frames :].mean(1)


def _stack(parts: Sequence[Sequence[Tensor]]) -> Verdicts:
    success, miss = zip(*parts, strict=True)
    return Verdicts(torch.stack(success).numpy(), torch.stack(miss).numpy())


def _same_length(distances: list[Tensor]) -> np.ndarray:
    """Curves of different lengths as (T, V), the shorter ones held at their last value."""
    length = max(len(one) for one in distances)
    return np.stack([np.pad(one.numpy(), (0, length - len(one)), mode="edge") for one in distances], axis=1)
