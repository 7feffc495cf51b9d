import numpy as np
import pytest
import torch

from planning import (
    AppearanceGrounder,
    Goal,
    GroundingError,
    Instruction,
    Palette,
    PinholeCamera,
    SegmentationGrounder,
    Thing,
    ground,
    ground_by_segmentation,
    unmet,
)
from planning.grounding import TABLETOP, color_distance
from planning.masks import hard_masks
from tests.planning.conftest import thing
from tests.planning.oracle import ARM, BACKGROUND, COLORS, PALETTE, PALETTE_INFO, OracleWorldModel
from textocvp.rollout import Rollout

BLACK = np.zeros((1, 64, 64, 3), np.uint8)


def with_slots(parsed: Rollout, slots: torch.Tensor) -> Rollout:
    return Rollout(slots, (), parsed.image_size, parsed.layout, parsed.renderer)


def test_every_thing_is_found_whatever_its_slot(oracle: OracleWorldModel, objects, camera: PinholeCamera) -> None:
    for seed in range(5):
        parsed = oracle.parse(BLACK, seed=seed)
        grounding = AppearanceGrounder(camera, PALETTE)(parsed)
        assert set(grounding.things) == {Thing(item["color"], item["kind"]) for item in objects}
        layer_K = parsed.slots[0, 0, :, 3]
        assert [layer_K[k] for k in grounding.background] == [BACKGROUND]
        assert [layer_K[k] for k in grounding.arm] == [ARM]
        for thing_, slots in grounding.things.items():
            expected = torch.tensor(COLORS[thing_.color]) * 0.92
            torch.testing.assert_close(parsed.colors[0, 0, slots[0]], expected)
    assert [thing_.color for thing_ in grounding.of_kind("block")] == ["green", "red"]
    assert [thing_.color for thing_ in grounding.of_kind("bowl")] == ["blue", "gray", "white"]
    assert len(grounding.instructions("in")) == 6


def test_missing_things_are_named(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    grounding = ground(oracle.parse(BLACK), camera, PALETTE)[0]
    with pytest.raises(GroundingError, match=r"no pink bowl is seen; seen: .*green block"):
        grounding.slots_of(Thing("pink", "bowl"))


@pytest.mark.parametrize("light", [0.75, 0.9, 1.0])
def test_colours_are_named_apart_in_any_light(light: float) -> None:
    seen = light * np.array([*COLORS.values(), PALETTE.robot])
    cost = np.stack([color_distance(seen, color) for color in (*COLORS.values(), PALETTE.robot)], axis=1)
    wrong = np.flatnonzero(cost.argmin(1) != np.arange(len(cost)))
    assert [list(COLORS)[k] for k in wrong] == []


def test_two_slots_on_one_object_are_one_thing(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    parsed = oracle.parse(BLACK)
    bowl = ground(parsed, camera, PALETTE)[0].slots_of(Thing("blue", "bowl"))[0]
    spare = int((parsed.presence[0, 0] < 0.5).nonzero()[0])
    slots = parsed.slots.clone()
    slots[..., spare, :] = slots[..., bowl, :]  # the shaded half of the bowl, a little to the right
    slots[..., [bowl, spare], 9] /= 2
    slots[..., bowl, 7] -= 4 / 32
    slots[..., spare, 7] += 4 / 32
    slots[..., spare, 4:7] = (slots[..., spare, 4:7] + 1) * 0.85 - 1
    grounding = ground(with_slots(parsed, slots), camera, PALETTE)[0]
    assert grounding.slots_of(Thing("blue", "bowl")) == tuple(sorted((bowl, spare)))


def test_a_far_fragment_does_not_take_a_name(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    parsed = oracle.parse(BLACK)
    before = ground(parsed, camera, PALETTE)[0]
    red = before.slots_of(Thing("red", "block"))[0]
    spare = int((parsed.presence[0, 0] < 0.5).nonzero()[0])
    slots = parsed.slots.clone()
    slots[..., spare, :] = slots[..., red, :]
    slots[..., spare, 7:9] = torch.tensor([0.0, 0.8])
    slots[..., spare, 9:11] *= 0.5
    after = ground(with_slots(parsed, slots), camera, PALETTE)[0]
    assert after.things == before.things


def test_language_overrules_the_kind(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    grounding = ground(oracle.parse(BLACK), camera, PALETTE)[0]
    named = grounding.with_kinds([Thing("gray", "block"), Thing("pink", "bowl")])
    assert named.slots_of(Thing("gray", "block")) == grounding.slots_of(Thing("gray", "bowl"))
    assert not {"gray", "pink"} & {thing_.color for thing_ in named.of_kind("bowl")}


def test_the_segmentation_agrees_where_appearance_is_right(
    oracle: OracleWorldModel, objects, camera: PinholeCamera
) -> None:
    parsed = oracle.parse(BLACK, seed=3)
    seen = ground(parsed, camera, PALETTE)[0]
    winner = parsed.masks[0, 0].argmax(0)
    truth = torch.zeros_like(winner)
    truth[torch.isin(winner, torch.tensor(seen.arm))] = 1
    objects = [{**item, "label": 9 - i} for i, item in enumerate(objects)]  # labels need not be in order
    for item in objects:
        truth[winner == seen.slots_of(Thing(item["color"], item["kind"]))[0]] = item["label"]
    assert ground_by_segmentation(parsed, truth.numpy(), objects) == [seen]
    info = {"segmentation": truth.numpy(), "objects": objects, "camera": vars(camera)}
    assert SegmentationGrounder.from_info(info)(parsed) == seen
    with pytest.raises(ValueError, match="segmentation is"):
        ground_by_segmentation(parsed, truth.numpy()[:32], objects)


def test_the_palette_of_info_decides_the_names(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    parsed = oracle.parse(BLACK)
    colors = dict(PALETTE_INFO["colors"])
    colors["crimson"] = colors.pop("red")
    info = {
        "camera": {"intrinsics": camera.intrinsics, "extrinsics": camera.extrinsics},
        "palette": {**PALETTE_INFO, "colors": colors},
    }
    grounding = AppearanceGrounder.from_info(info)(parsed)
    usual = ground(parsed, camera, PALETTE)[0]
    assert grounding.slots_of(Thing("crimson", "block")) == usual.slots_of(Thing("red", "block"))
    assert Thing("red", "block") not in grounding.things
    # A robot that looks like the white bowl takes the bowl for itself.
    others = {name: color for name, color in PALETTE.colors.items() if name != "white"}
    mistaken = Palette(others, robot=PALETTE.colors["white"], table=PALETTE.table)
    assert ground(parsed, camera, mistaken)[0].arm == usual.slots_of(Thing("white", "bowl"))


def test_what_programs_of_users_say_still_holds(oracle: OracleWorldModel, camera: PinholeCamera) -> None:
    """No palette, kinds told after grounding, colours as block and bowl, and a judge."""
    ask = Instruction.parse("put the red block in the blue bowl")
    assert (ask.block, ask.bowl) == ("red", "blue")
    parsed = oracle.parse(BLACK)
    assert ground(parsed, camera) == ground(parsed, camera, TABLETOP)
    (grounding,) = ground(parsed, camera, PALETTE)
    named = [Thing("gray", "block"), Thing("pink", "bowl")]
    assert grounding.told(named) == grounding.with_kinds(named) != grounding


def test_goal_reached_by_sight(objects, camera: PinholeCamera) -> None:
    goal = Goal.parse("put the red block in the blue bowl")
    oracle = OracleWorldModel(lambda: objects, camera)

    def reached() -> bool:
        parsed = oracle.parse(BLACK)
        return not unmet(parsed, ground(parsed, camera, PALETTE)[0], goal)

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
