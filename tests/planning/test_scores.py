from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from planning import Judge, Thresholds, Trace, measure, measure_rollout, score, succeeds
from planning.masks import contact_distance
from planning.relations import RELATIONS
from planning.scores import carry_score, placement_score
from tests.planning.conftest import put_in
from tests.planning.oracle import OracleWorldModel

LIMITS = Thresholds(contact_px=2.0, contact_frames=3, settle_frames=2)


def trace(arm: list[float], bowl: list[float], frames: tuple[int, ...] | None = None) -> Trace:
    contact_Bt, distance_Bt = torch.tensor([arm]).float(), torch.tensor([bowl]).float()
    return Trace(frames or tuple(range(len(arm))), contact_Bt, distance_Bt, torch.tensor([4.0]))


def test_contact_distance_equals_brute_force() -> None:
    rng = np.random.default_rng(0)
    arm = torch.from_numpy(rng.random((3, 5, 20, 24)) < 0.01)
    block = torch.from_numpy(rng.random((3, 5, 20, 24)) < 0.01)
    distance = contact_distance(arm, block)
    for index in np.ndindex(3, 5):
        a, b = np.argwhere(arm[index].numpy()), np.argwhere(block[index].numpy())
        expected = cdist(a, b).min() if len(a) and len(b) else np.inf
        assert distance[index].item() == pytest.approx(expected)


def test_unseen_things_are_infinitely_far() -> None:
    some, none = torch.ones(1, 1, 8, 8, dtype=torch.bool), torch.zeros(1, 1, 8, 8, dtype=torch.bool)
    for arm, block in ((some, none), (none, some), (none, none)):
        assert torch.isinf(contact_distance(arm, block)).all()
        assert torch.isinf(RELATIONS["in"].distance(arm, block)).all()


def test_centroid_distance_is_between_centroids() -> None:
    block, bowl = torch.zeros(1, 1, 16, 16, dtype=torch.bool), torch.zeros(1, 1, 16, 16, dtype=torch.bool)
    block[..., 2:4, 2:4] = True
    bowl[..., 5:9, 6:10] = True
    assert RELATIONS["in"].distance(block, bowl).item() == pytest.approx(np.hypot(5, 4))


def test_contact_counts_the_longest_run() -> None:
    assert trace([1, 9, 1, 1, 1, 9, 1, 1], [0] * 8).longest_contact(2).item() == 3
    assert trace([9, 9], [0, 0]).longest_contact(2).item() == 0
    # Looked at every second frame: 2, 4 and 6 hold, so 2..6 does.
    assert trace([9, 1, 1, 1, 9], [0] * 5, frames=(0, 2, 4, 6, 8)).longest_contact(2).item() == 5


def test_success_wants_both_the_carry_and_the_placement() -> None:
    criterion = partial(succeeds, limits=LIMITS)
    assert criterion(trace([9, 1, 1, 1, 9], [20, 20, 9, 3, 3])).all()
    assert not criterion(trace([9, 1, 1, 9, 1], [20, 20, 9, 3, 3])).any()  # never three frames in a row
    assert not criterion(trace([9, 1, 1, 1, 9], [20, 20, 9, 3, 5])).any()  # rolled out again
    assert not criterion(trace([9, 1, 1, 1, 9], [20, 20, 9, 5, 3])).any()  # only passing through
    assert not criterion(trace([9, 1, 1, 1, 9], [20, 20, 9, 3, float("inf")])).any()  # vanished


def test_scores_rank_nearer_and_longer_higher() -> None:
    near, far, lost = (([9.0] * 4, [9, 9, 1, 1]), ([9.0] * 4, [9, 9, 6, 6]), ([9.0] * 4, [9, 9, float("inf"), 9]))
    place = partial(placement_score, limits=LIMITS)
    assert place(trace(*near)) > 0 > place(trace(*far)) > place(trace(*lost))
    assert torch.isfinite(place(trace(*lost))).all()
    carry = partial(carry_score, limits=LIMITS)
    assert [carry(trace(arm, [0.0] * 5)).item() for arm in ([9.0] * 5, [9, 1, 9, 9, 9.0], [1.0] * 5)] == [
        pytest.approx(0),
        pytest.approx(1 / 3),
        pytest.approx(1),
    ]
    ended = trace([1.0] * 12, [0.0] * 12)  # held, and where it should be
    assert score(ended).item() == pytest.approx(1) and score(trace([9.0] * 12, [0.0] * 12)).item() == pytest.approx(0.8)


def test_traces_join_over_steps() -> None:
    joined = trace([9, 1, 1], [9, 9, 9]).then(trace([1, 9, 9], [9, 3, 3]), length=3)
    assert joined.frames == (0, 1, 2, 3, 4, 5)
    assert joined.longest_contact(2).item() == 3
    assert succeeds(joined, LIMITS).all() and torch.equal(Judge(LIMITS)(joined), succeeds(joined, LIMITS))


def test_measure_checks_shapes() -> None:
    mask = torch.ones(1, 2, 8, 8, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"\(B, t, H, W\)"):
        measure(mask, mask, mask[:, :1], ["in"])


def test_the_criterion_tells_the_instruction_from_every_other(oracle: OracleWorldModel, grounder) -> None:
    parsed = oracle.parse(np.zeros((1, 64, 64, 3), np.uint8))
    grounding = grounder(parsed)
    instructions = grounding.instructions("in")
    assert len(instructions) == 6
    rollout = oracle.rollout(parsed, [i.text for i in instructions])
    for wanted in instructions:
        verdict = succeeds(measure_rollout(rollout, grounding, wanted))
        assert [i for i, good in zip(instructions, verdict, strict=True) if good] == [wanted]
    each = measure_rollout(rollout, [grounding] * 6, instructions)
    assert succeeds(each).all()
    # The frames that a planner looks at lead to the same final distances.
    few = measure_rollout(rollout, grounding, instructions, frames=(0, 4, 8, 12, 16, 20, 23, 24))
    torch.testing.assert_close(few.distance_Bt[:, -1], each.distance_Bt[:, -1])
    with pytest.raises(ValueError, match="one or 6"):
        measure_rollout(rollout, [grounding] * 2, instructions)
    with pytest.raises(LookupError, match="no pink block"):
        measure_rollout(rollout, grounding, put_in("pink", "blue"))


def test_a_robot_out_of_sight_holds_nothing(oracle: OracleWorldModel, grounder) -> None:
    parsed = oracle.parse(np.zeros((1, 64, 64, 3), np.uint8))
    grounding = grounder(parsed)
    rollout = oracle.rollout(parsed, [i.text for i in grounding.instructions("in")])
    armless = measure_rollout(rollout, replace(grounding, arm=()), grounding.instructions("in"))
    assert torch.isinf(armless.contact_Bt).all() and not succeeds(armless).any()
