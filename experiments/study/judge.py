"""Do imagined rollouts show what the sentence says? Judged on their masks (paper, section 4.4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from experiments.study.methods import HORIZON
from planning import (
    THRESHOLDS,
    AppearanceGrounder,
    Grounding,
    GroundingError,
    Instruction,
    Trace,
    measure_rollout,
    succeeds,
)
from textocvp import Rollout, WorldModel


@dataclass(frozen=True, eq=False)
class Verdicts:
    """One method on one scene, for its V instructions (original first) and S slot seeds."""

    success_SV: np.ndarray  # bool
    miss_SV: np.ndarray  # distance in pixels between block and bowl over the last frames; inf where one is not seen


def find_things(rollout: Rollout, ground: AppearanceGrounder, instructions: Sequence[Instruction]) -> Grounding | None:
    """Which slot is what, by appearance on the first frame, which all rollouts of a batch share; None if unclear."""
    try:
        grounding = ground(rollout.select(0))
    except GroundingError:
        return None
    return grounding.with_kinds([thing for one in instructions for thing in one.things])


def trace(rollout: Rollout, grounding: Grounding | None, instructions: Sequence[Instruction]) -> Trace:
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
            traces.append(Trace(tuple(range(length)), nowhere, nowhere, torch.zeros(1)))
    return Trace(
        traces[0].frames,
        torch.cat([one.contact_Bt for one in traces]),
        torch.cat([one.distance_Bt for one in traces]),
        torch.cat([one.within_B for one in traces]),
    )


def first_frame(traced: Trace) -> Trace:
    """The trace of the first frame repeated."""
    contact_Bt, distance_Bt = (its_Bt[:, :1].expand_as(its_Bt) for its_Bt in (traced.contact_Bt, traced.distance_Bt))
    return replace(traced, contact_Bt=contact_Bt, distance_Bt=distance_Bt)


def judge(traced: Trace) -> tuple[Tensor, Tensor]:
    """Success (V,) and miss (V,) of each rollout; see `Verdicts`."""
    return succeeds(traced), traced.distance_Bt[:, -THRESHOLDS.settle_frames :].mean(1)


def stack(judged: Sequence[Sequence[Tensor]]) -> Verdicts:
    """The verdicts of S slot seeds, each (success, miss)."""
    success, miss = zip(*judged, strict=True)
    return Verdicts(torch.stack(success).numpy(), torch.stack(miss).numpy())


def judge_rollout(rollout: Rollout, ground: AppearanceGrounder, text: str) -> bool:
    """Whether a rollout or a parsed video of a whole episode (B = 1) shows what the sentence says."""
    instruction = Instruction.parse(text)
    success_B, _ = judge(trace(rollout, find_things(rollout, ground, [instruction]), [instruction]))
    return bool(success_B[0])


def imagine_and_trace(
    world_model: WorldModel, seen: Rollout | np.ndarray, ground: AppearanceGrounder, texts: Sequence[str], seed: int
) -> tuple[Rollout, Trace, Trace]:
    """Imagine one scene, parsed (B = T = 1) or as a picture (H, W, 3), with V instructions and one slot seed.

    Returns:
        the rollouts, one an instruction; the traces of each for its own instruction; and those for the next one of the
        list, for which it was not imagined.
    """
    instructions = [Instruction.parse(text) for text in texts]
    rollout = world_model.rollout(seen, list(texts), horizon=HORIZON, seed=seed)
    grounding = find_things(rollout, ground, instructions)
    ours, wrong = (trace(rollout, grounding, asked) for asked in (instructions, instructions[1:] + instructions[:1]))
    return rollout, ours, wrong
