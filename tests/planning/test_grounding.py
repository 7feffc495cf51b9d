import numpy as np
import pytest
import torch

from planning import (
    AppearanceGrounder,
    Goal,
    GroundingError,
    PinholeCamera,
    Thing,
    goal_reached,
    ground,
    ground_privileged,
)
from planning.grounding import COLORS, ROBOT_COLOR, color_distance, hard_masks
from tests.planning.conftest import thing
from tests.planning.oracle import ARM, BACKGROUND, OracleWorldModel
from textocvp.rollout import Rollout

BLACK = np.zeros((1, 64, 64, 3), np.uint8)


def with_slots(parsed: Rollout, slots: torch.Tensor) -> Rollout:
    return Rollout(slots, (), parsed.image_size, parsed.layout, parsed.renderer)


def test_every_thing_is_found_whatever_its_slot(
    oracle: OracleWorldModel, objects, camera: PinholeCamera
) -> None:
    for seed in range(5):
        parsed = oracle.parse(BLACK, seed=seed)
        grounding = AppearanceGrounder(camera)(parsed)
        assert set(grounding.things) == {Thing(item["color"], item["kind"]) for item in objects}
        layer_K = parsed.slots[0, 0, :, 3]
        assert [layer_K[k] for k in grounding.background] == [BACKGROUND]
        assert [layer_K[k] for k in grounding.arm] == [ARM]
        for thing_, slots in grounding.things.items():
            expected = torch.tensor(COLORS[thing_.color]) * 0.92
            torch.testing.assert_close(parsed.colors[0, 0, slots[0]], expected)
    assert grounding.blocks == ("green", "red")
    assert grounding.bowls == ("blue", "gray", "white")
    assert len(grounding.instructions) == 6


def test_missing_things_are_named(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    grounding = ground(oracle.parse(BLACK), camera)[0]
    with pytest.raises(GroundingError, match=r"no pink bowl is seen; seen: .*green block"):
        grounding.find(Thing("pink", "bowl"))


@pytest.mark.parametrize("light", [0.75, 0.9, 1.0])
def test_colours_are_told_apart_in_any_light(light: float) -> None:
    seen = light * np.array([*COLORS.values(), ROBOT_COLOR])
    cost = np.stack([color_distance(seen, color) for color in (*COLORS.values(), ROBOT_COLOR)], axis=1)
    wrong = np.flatnonzero(cost.argmin(1) != np.arange(len(cost)))
    assert [list(COLORS)[k] for k in wrong] == []


def test_two_slots_on_one_object_are_one_thing(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    parsed = oracle.parse(BLACK)
    bowl = ground(parsed, camera)[0].find(Thing("blue", "bowl"))[0]
    spare = int((parsed.presence[0, 0] < 0.5).nonzero()[0])
    slots = parsed.slots.clone()
    slots[..., spare, :] = slots[..., bowl, :]  # the shaded half of the bowl, a little to the right
    slots[..., [bowl, spare], 9] /= 2
    slots[..., bowl, 7] -= 4 / 32
    slots[..., spare, 7] += 4 / 32
    slots[..., spare, 4:7] = (slots[..., spare, 4:7] + 1) * 0.85 - 1
    grounding = ground(with_slots(parsed, slots), camera)[0]
    assert grounding.find(Thing("blue", "bowl")) == tuple(sorted((bowl, spare)))


def test_a_far_fragment_does_not_take_a_name(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    parsed = oracle.parse(BLACK)
    before = ground(parsed, camera)[0]
    red = before.find(Thing("red", "block"))[0]
    spare = int((parsed.presence[0, 0] < 0.5).nonzero()[0])
    slots = parsed.slots.clone()
    slots[..., spare, :] = slots[..., red, :]
    slots[..., spare, 7:9] = torch.tensor([0.0, 0.8])
    slots[..., spare, 9:11] *= 0.5
    after = ground(with_slots(parsed, slots), camera)[0]
    assert after.things == before.things


def test_language_overrules_the_kind(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    grounding = ground(oracle.parse(BLACK), camera)[0]
    told = grounding.told([Thing("gray", "block"), Thing("pink", "bowl")])
    assert told.find(Thing("gray", "block")) == grounding.find(Thing("gray", "bowl"))
    assert "gray" not in told.bowls and "pink" not in told.bowls


def test_privileged_agrees_where_appearance_is_right(
    oracle: OracleWorldModel, objects, camera: PinholeCamera
) -> None:
    parsed = oracle.parse(BLACK, seed=3)
    seen = ground(parsed, camera)[0]
    winner = parsed.masks[0, 0].argmax(0)
    truth = torch.zeros_like(winner)
    truth[torch.isin(winner, torch.tensor(seen.arm))] = 1
    for i, item in enumerate(objects):
        truth[winner == seen.find(Thing(item["color"], item["kind"]))[0]] = 2 + i
    assert ground_privileged(parsed, truth.numpy(), objects) == [seen]
    with pytest.raises(ValueError, match="segmentation is"):
        ground_privileged(parsed, truth.numpy()[:32], objects)


def test_goal_reached_by_sight(objects, camera: PinholeCamera) -> None:
    goal = Goal.parse("put the red block in the blue bowl")
    oracle = OracleWorldModel(lambda: objects, camera)

    def reached() -> bool:
        parsed = oracle.parse(BLACK)
        return goal_reached(parsed, ground(parsed, camera)[0], goal)

    assert not reached()
    objects[0] = thing("block", "red", 0.60, -0.10) | {"position": (0.61, -0.11, 0.035)}
    assert reached()
    for x, y in ((0.60 + 0.11, -0.10), (0.60 - 0.11, -0.10), (0.60, -0.20), (0.42, 0.08)):
        objects[0] = thing("block", "red", x, y)
        assert not reached()


def test_masks_become_hard_where_they_are() -> None:
    masks = torch.rand(2, 5, 3, 8, 8)
    assert torch.equal(hard_masks(masks).float().argmax(-3), masks.argmax(-3))
    # A model on another device gives masks that are there.
    elsewhere = hard_masks(torch.empty(2, 5, 3, 8, 8, device="meta"))
    assert elsewhere.device.type == "meta" and elsewhere.dtype == torch.bool
